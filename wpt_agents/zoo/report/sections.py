"""The page's sections: what stands in its tables and figures."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from wpt_envs.tasks import TASKS

from wpt_agents.zoo.plan.methods import ABLATION
from wpt_agents.zoo.report import aggregates, figures
from wpt_agents.zoo.report.aggregates import (
    STATISTICS,
    Estimate,
    Experiment,
    Reference,
    score_of,
)
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.tables import POLICIES, interval_text
from wpt_agents.zoo.statistics import (
    bootstrap,
    mean,
    mean_interval,
    performance_profile,
    resamplable,
)

Scores = dict[str, list[float]]  # task -> normalised scores of its runs
TITLES = {3: "Meta-World", 4: "Meta-World, continued", 5: "DMControl"}
SUITES = {"dmc": "DMControl", "metaworld": "Meta-World", "robotics": "Gymnasium-Robotics"}
BASELINES = {
    "dreamer-v3": "Dreamer v3",
    "drq-v2": "DrQ v2",
    "wpt": "WPT",
    "ncrl": "WPT (ICLR 2026)",
}
OFFICIAL = {  # what the authors of these published, on eight tasks of Table 5
    "dreamer-v3-official": "Dreamer v3, its authors",
    "drq-v2-official": "DrQ v2, its authors",
    "mrq-official": "MR.Q, its authors",
}
THRESHOLDS = np.linspace(0, 1, 51)


class Names:
    """What experiments are called: by method, and by budget too where there are several."""

    def __init__(self, experiments: Iterable[Experiment]) -> None:
        self.budgets: dict[str, set[str]] = defaultdict(set)
        each = sorted(set(experiments), key=aggregates.order)
        for one in each:
            self.budgets[one.suite].add(one.budget)
        self.all = list(dict.fromkeys(map(self, each)))

    def __call__(self, one: Experiment) -> str:
        """The name of one."""
        several = len(self.budgets[one.suite]) > 1
        return f"{one.method} ({one.budget})" if several else one.method


def headline(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each suite and budget: on how many tasks WPT's interval lies above another policy's.

    Tasks with a single seed have no interval and do not count; `against` is empty if all are such.
    """
    tables: dict[tuple[str, str, int], dict[str, dict[tuple[str, str], dict[int, float]]]] = {}
    for result in results:
        about = result["suite"], result["preset"], result["frames"]
        task = tables.setdefault(about, {}).setdefault(result["task"], {})
        for policy in result["scores"]:
            whose = "" if policy in POLICIES else result["method"]
            task.setdefault((whose, policy), {})[result["seed"]] = score_of(result, policy)
    others = {"random policy": ("", "random"), "prior actor": ("wpt", "prior actor")}
    others |= {"same, from scratch": ("scratch", "WPT")}
    told = []
    for (suite, preset, frames), tasks in tables.items():
        against = []
        for name, other in others.items():
            pairs = [
                (list(t["wpt", "WPT"].values()), list(t[other].values()))
                for t in tasks.values()
                if {("wpt", "WPT"), other} <= t.keys()
            ]
            pairs = [pair for pair in pairs if min(map(len, pair)) > 1]
            if pairs:
                higher = sum(above(ours, theirs) for ours, theirs in pairs)
                lower = sum(above(theirs, ours) for ours, theirs in pairs)
                against.append({"name": name, "above": higher, "below": lower, "of": len(pairs)})
        if any(("wpt", "WPT") in t for t in tasks.values()):
            told.append(
                {"suite": SUITES[suite], "preset": preset, "frames": frames, "against": against}
            )
    return told


def above(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether one's interval over seeds, by Student's t, lies above the other's."""
    (_, low, _), (_, _, high) = mean_interval(one), mean_interval(other)
    return low is not None and high is not None and low > high


def both_suites(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The paper's aggregate, for each preset and method that has runs of both of its suites."""
    found: dict[tuple[str, str], dict[str, Scores]] = defaultdict(dict)
    every = aggregates.by_experiment(results).items()
    for one, tasks in sorted(every, key=lambda item: -item[0].frames):  # the least budget stays
        found[one.method, one.preset][one.suite] = tasks
    told = []
    for (method, preset), suites in found.items():
        if not {"dmc", "metaworld"} <= suites.keys():
            continue
        pairs = [(suite, suites[suite]) for suite in ("dmc", "metaworld")]
        ours = [float(mean([np.array(runs) for runs in tasks.values()])) for _, tasks in pairs]
        theirs = [aggregates.paper_aggregate(*pair, method, 150_000) for pair in pairs]
        paper = float(np.mean([each["mean"] for each in theirs])) if all(theirs) else None
        told.append({"method": method, "preset": preset, "ours": np.mean(ours), "paper": paper})
    return told


def suite(suite: str, runs: Sequence[Finished], names: Names) -> dict[str, Any]:
    """Aggregates, comparisons and figures of one suite."""
    found = {
        one: tasks
        for one, tasks in aggregates.by_experiment(run.result for run in runs).items()
        if one.suite == suite
    }
    wanted = [row for row in TASKS.values() if row.suite == suite and row.in_paper]
    rows = [
        {
            "name": names(one),
            "budget": one.budget,
            "tasks": len(tasks),
            "runs": sum(map(len, tasks.values())),
            "estimates": aggregates.aggregate(tasks),
            "paper": aggregates.paper_aggregate(suite, tasks, one.method, 150_000),
        }
        for one, tasks in found.items()
    ]
    return {
        "name": SUITES[suite],
        "names": list(dict.fromkeys(map(names, found))),
        "all_names": names.all,
        "of": len(wanted),
        "rows": rows,
        "paper": paper_rows(suite, {task for tasks in found.values() for task in tasks}),
        "improvements": improvements(found, names),
        "profile": profile(suite, found, names),
        "ablation": ablation(suite, found, names),
        "curves": curves(suite, runs, names),
    }


def paper_rows(suite: str, tasks: set[str]) -> list[dict[str, Any]]:
    """The paper's aggregates over the tasks that were run, a row a method."""
    found = [
        (name, aggregates.paper_aggregate(suite, tasks, method, 150_000))
        for method, name in BASELINES.items()
    ]
    return [{"name": name} | values for name, values in found if values]


def improvements(found: Mapping[Experiment, Scores], names: Names) -> list[dict[str, Any]]:
    """The probability that wpt improves on each other method of the same preset and budget."""
    told = []
    for one, theirs in found.items():
        wpt = Experiment(one.suite, one.preset, one.frames, "wpt")
        if one.method == "wpt" or wpt not in found:
            continue
        if compared := aggregates.improvement(found[wpt], theirs):
            told.append({"over": names(one), "estimate": compared[0], "tasks": compared[1]})
    return told


def profile(suite: str, found: Mapping[Experiment, Scores], names: Names) -> str:
    """The share of runs above each normalised score."""

    def shares(scores: Sequence[np.ndarray]) -> np.ndarray:
        return performance_profile(scores, THRESHOLDS)

    given = []
    for one, tasks in found.items():
        scores = [np.array(each) for each in tasks.values()]
        middle, known = shares(scores), resamplable(scores)
        ends = bootstrap(shares, scores, draws=2000) if known else (middle, middle)
        given.append(figures.Line(names(one), THRESHOLDS, (middle, *ends)))
    title = f"{SUITES[suite]}: performance profile"
    return figures.lines(
        title, "normalised score τ", "share of runs > τ", given, names.all, step=True
    )


def ablation(suite: str, found: Mapping[Experiment, Scores], names: Names) -> str:
    """Fig. 5: the mean with parts of the method on, over the tasks that all have."""
    budgets: dict[str, dict[str, tuple[str, Scores]]] = defaultdict(dict)
    for one, tasks in found.items():
        if one.method in ABLATION:
            budgets[one.budget][one.method] = names(one), tasks
    drawn = []
    for budget, methods in budgets.items():
        common = set.intersection(*(set(tasks) for _, tasks in methods.values()))
        if len(methods) < 2 or not common:
            continue
        values: dict[str, Estimate] = {}
        names_of = {ABLATION[method]: name for method, (name, _) in methods.items()}
        for method, part in ABLATION.items():
            if method in methods:
                scores = [np.array(s) for t, s in methods[method][1].items() if t in common]
                values[part] = aggregates.estimate(mean, scores)
        title = f"{SUITES[suite]}: ablation, {budget}"
        colours = [figures.colour_of(names_of[part], names.all) for part in values]
        y_label = f"normalised mean, tasks: {len(common)}"
        drawn.append(figures.bars(title, y_label, values, colours))
    return "".join(drawn)


def curves(suite: str, runs: Sequence[Finished], names: Names) -> list[str]:
    """A figure for each task: evaluations over frames, their mean and interval over seeds."""
    tasks: dict[str, dict[Experiment, list[tuple[np.ndarray, np.ndarray]]]] = {}
    for run in runs:
        if run.result["suite"] == suite and (evaluations := run.evaluations()):
            by = tasks.setdefault(run.result["task"], {})
            by.setdefault(run.experiment, []).append(evaluations)
    metrics = {run.result["task"]: run.result["metric"] for run in runs}
    drawn = []
    for task, experiments in tasks.items():
        given = [curve(names(one), seeds) for one, seeds in experiments.items()]
        y_label = "success rate" if metrics[task] == "success" else "return"
        drawn.append(figures.lines(task, "simulator frames", y_label, given, names.all))
    return drawn


def curve(label: str, seeds: Sequence[tuple[np.ndarray, np.ndarray]]) -> figures.Line:
    """The mean over seeds at the frames that all have reached, and its 95 % interval.

    The interval resamples the seeds' means; of one seed, its episodes.
    """
    reached = min(len(frames) for frames, _ in seeds)
    bands = []
    for at in range(reached):
        scores = [each[at] for _, each in seeds]
        strata = [np.array([s.mean() for s in scores])] if len(scores) > 1 else scores
        bands.append((mean(strata), *bootstrap(mean, strata, draws=2000)))
    middle, low, high = np.array(bands).reshape(-1, 3).T
    return figures.Line(label, seeds[0][0][:reached], (middle, low, high))


def paper_tables(runs: Sequence[Finished], names: Names) -> list[dict[str, Any]]:
    """Tables 3 to 5 with our numbers beside the paper's; only of suites that were run."""
    tables = []
    for number, title in TITLES.items():
        printed = [row for row in aggregates.references() if row.table == number]
        given = [run for run in runs if run.result["suite"] == printed[0].suite]
        if given:
            tables.append({"number": number, "title": title} | paper_table(printed, given, names))
    return tables


def paper_table(
    printed: Sequence[Reference], runs: Sequence[Finished], names: Names
) -> dict[str, Any]:
    """One of them. Tasks that were not run stand apart: in a report of one task, all but one."""
    cells: dict[tuple[str, str], list[Finished]] = defaultdict(list)
    for run in runs:
        cells[run.result["task"], names(run.experiment)].append(run)
    ours = list(dict.fromkeys(name for _, name in cells))
    tasks = list(dict.fromkeys(row.task for row in printed))
    columns = list(dict.fromkeys((row.method, row.samples) for row in reversed(printed)))
    names_of = BASELINES | OFFICIAL
    row = partial(table_row, printed=printed, columns=columns, ours=ours, cells=cells)
    shown = {*(task for task, _ in cells), *STATISTICS}
    rows = [row(task) for task in tasks if task in shown]
    return {
        "metric": "success rate" if printed[0].suite == "metaworld" else "return",
        "columns": [f"{names_of[method]} @ {samples_text(n)}" for method, n in columns],
        "ours": {name: shared_about(rows, place) for place, name in enumerate(ours)},
        "rows": rows,
        "not_run": [row(task) for task in tasks if task not in shown],
        "source": "; ".join(dict.fromkeys(row.source for row in printed)),
        "misprints": any(aggregates.misprint(row) is not None for row in printed),
    }


def table_row(
    task: str,
    printed: Sequence[Reference],
    columns: Sequence[tuple[str, int]],
    ours: Sequence[str],
    cells: Mapping[tuple[str, str], Sequence[Finished]],
) -> dict[str, Any]:
    """One task's numbers: the paper's, misprints marked, and ours with seeds and interval."""
    held = {(row.method, row.samples): row for row in printed if row.task == task}
    return {
        "task": task,
        "aggregate": task in STATISTICS,
        "paper": [
            (held[c].score, aggregates.misprint(held[c])) if c in held else (None, None)
            for c in columns
        ],
        "ours": [
            our_cell(cells.get((task, name), []))
            if task not in STATISTICS
            else our_aggregate(task, [r for (_, n), r in cells.items() if n == name])
            for name in ours
        ],
    }


def shared_about(rows: Sequence[Mapping[str, Any]], place: int) -> str:
    """Budget, seeds and commits of a column of ours, taken out of its cells if all agree."""
    cells = [cell for row in rows if (cell := row["ours"][place]) and cell["run"]]
    told = {cell["about"] for cell in cells}
    if len(told) > 1:
        return ""
    for cell in cells:
        cell["about"] = ""
    return told.pop() if told else ""


def our_aggregate(name: str, tasks: Sequence[Sequence[Finished]]) -> dict[str, Any] | None:
    """The mean or median over tasks of each task's mean over seeds, in the table's units."""
    scores = [np.array([aggregates.score_of(run.result) for run in runs]) for runs in tasks]
    return {"run": None, "mean": float(STATISTICS[name](scores)), "tasks": len(scores)}


def samples_text(samples: int) -> str:
    """150k, 1M."""
    return f"{samples // 1000}k" if samples < 10**6 else f"{samples // 10**6}M"


def our_cell(runs: Sequence[Finished]) -> dict[str, Any] | None:
    """Mean over seeds, its interval by Student's t, seeds, budget, commits; None without runs."""
    if not runs:
        return None
    scores = [aggregates.score_of(run.result) for run in runs]
    seeds = ", ".join(str(run.result["seed"]) for run in runs)
    commits = ", ".join(sorted({run.result.get("commit") or "unknown" for run in runs}))
    middle, low, high = mean_interval(scores)
    if runs[0].result["metric"] == "success" and low is not None and high is not None:
        low, high = max(low, 0.0), min(high, 1.0)
    return {
        "run": runs[0].name,
        "mean": middle,
        "interval": "one seed: no interval" if low is None else interval_text(low, high),
        "about": f"{runs[0].result['frames']:,} frames, seeds {seeds}, commit {commits}",
    }
