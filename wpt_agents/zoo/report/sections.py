"""The page's section about a suite: aggregates, comparisons, figures."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from wpt_envs.tasks import TASKS

from wpt_agents.zoo.numbers import evidence_text, span
from wpt_agents.zoo.plan.methods import ABLATION
from wpt_agents.zoo.report import aggregates, figures
from wpt_agents.zoo.report.aggregates import PAPER_BUDGET, Aggregate, Estimate, Experiment
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.headline import OURS, suite_title
from wpt_agents.zoo.report.names import is_added
from wpt_agents.zoo.statistics import bootstrap, mean, performance_profile, resamplable

Scores = dict[str, list[float]]  # task -> normalised scores of its runs
PRINTED = {  # the methods of the paper's tables, among them WPT
    "dreamer-v3": "DreamerV3",
    "drq-v2": "DrQ-v2",
    "wpt": "WPT",
    "ncrl": "WPT (ICLR 2026)",
}
THRESHOLDS = np.linspace(0, 1, 51)


class Names:
    """Names of experiments: the method, with the budget if a suite has several."""

    def __init__(self, experiments: Iterable[Experiment]) -> None:
        self.budgets: dict[str, set[str]] = defaultdict(set)
        ordered = sorted(set(experiments), key=aggregates.order)
        for one in ordered:
            self.budgets[one.suite].add(one.budget)
        self.all = list(dict.fromkeys(map(self, ordered)))

    def __call__(self, one: Experiment) -> str:
        """Return the name of an experiment."""
        several = len(self.budgets[one.suite]) > 1
        return f"{one.method} ({one.budget})" if several else one.method


@dataclass(frozen=True)
class MethodRow:
    """One experiment in the table of all tasks together.

    :param further: the number of tasks that are not in the paper, if others of the suite are
    """

    name: str
    budget: str
    tasks: int
    further: int
    runs: int
    estimates: Mapping[str, Estimate]
    paper: Aggregate | None


@dataclass(frozen=True)
class PaperRow:
    """One of the paper's methods over the tasks with runs."""

    name: str
    aggregate: Aggregate


@dataclass(frozen=True)
class Improvement:
    """The probability that a method improves on another, over the tasks in common."""

    method: str
    over: str
    estimate: Estimate
    tasks: int


@dataclass(frozen=True)
class Section:
    """The page's content about a suite; figures are SVG.

    :param names: of the suite's experiments
    :param all_names: of all experiments of the page, for the colours
    :param tasks: the number of the suite's tasks in the paper
    :param ablation_missing: the methods of Fig. 5 without runs
    :param evidence: from how many seeds and episodes the scores are
    :param episodes: the number of episodes in each evaluation of the learning curves
    """

    name: str
    names: Sequence[str]
    all_names: Sequence[str]
    tasks: int
    rows: Sequence[MethodRow]
    paper: Sequence[PaperRow]
    improvements: Sequence[Improvement]
    profile: str
    ablation: str
    ablation_missing: Sequence[str]
    evidence: str
    curves: Sequence[str]
    episodes: str


def section(suite: str, runs: Sequence[Finished], names: Names) -> Section:
    """Return the section about one suite."""
    of_suite = [run for run in runs if run.result.suite == suite]
    results = [run.result for run in of_suite]
    experiments = aggregates.by_experiment(results)
    return Section(
        name=suite_title(suite),
        names=list(dict.fromkeys(map(names, experiments))),
        all_names=names.all,
        tasks=sum(row.suite == suite and row.in_paper for row in TASKS.values()),
        rows=[method_row(one, tasks, names) for one, tasks in experiments.items()],
        paper=paper_rows(suite, {task for tasks in experiments.values() for task in tasks}),
        improvements=improvements(experiments, names),
        profile=profile(suite, experiments, names),
        ablation=ablation(suite, experiments, names),
        ablation_missing=[m for m in ABLATION if m not in {one.method for one in experiments}],
        evidence=evidence_text(results),
        curves=curves(of_suite, names),
        episodes=episodes_text(of_suite),
    )


def method_row(one: Experiment, tasks: Scores, names: Names) -> MethodRow:
    """Return the row of an experiment, with the paper's aggregate over the same tasks."""
    printed = aggregates.paper_tasks(one.suite)
    return MethodRow(
        name=names(one),
        budget=one.budget,
        tasks=len(tasks),
        further=len(tasks.keys() - printed) if printed else 0,
        runs=sum(map(len, tasks.values())),
        estimates=aggregates.aggregate(tasks),
        paper=aggregates.paper_aggregate(one.suite, tasks, one.method, PAPER_BUDGET),
    )


def paper_rows(suite: str, tasks: set[str]) -> list[PaperRow]:
    """Return the aggregates of the paper's baselines over the tasks that were run."""
    rows = []
    for method, name in PRINTED.items():
        aggregate = aggregates.paper_aggregate(suite, tasks, method, PAPER_BUDGET)
        if method != OURS and aggregate is not None:
            rows.append(PaperRow(name, aggregate))
    return rows


def improvements(experiments: Mapping[Experiment, Scores], names: Names) -> list[Improvement]:
    """Compare wpt and added methods with each other one of the same preset and budget."""
    rows = []
    done: list[set[Experiment]] = [{one} for one in experiments]
    for first in sorted(experiments, key=lambda one: one.method != OURS):
        if first.method != OURS and not is_added(first.method):
            continue
        for second in experiments:
            alike = replace(second, method=first.method) == first
            if not alike or {first, second} in done:
                continue
            done.append({first, second})
            if compared := aggregates.improvement(experiments[first], experiments[second]):
                rows.append(Improvement(names(first), names(second), *compared))
    return rows


def profile(suite: str, experiments: Mapping[Experiment, Scores], names: Names) -> str:
    """Draw the share of runs above each normalised score."""

    def shares(scores: Sequence[np.ndarray]) -> np.ndarray:
        return performance_profile(scores, THRESHOLDS)

    lines = []
    for one, tasks in experiments.items():
        scores = [np.array(runs) for runs in tasks.values()]
        middle = shares(scores)
        ends = (middle, middle)
        if resamplable(scores):
            ends = bootstrap(shares, scores, draws=2000)
        lines.append(figures.Line(names(one), THRESHOLDS, (middle, *ends)))
    title = f"{suite_title(suite)}: performance profile"
    return figures.lines(
        title, "normalised score τ", "share of runs > τ", lines, names.all, step=True
    )


def ablation(suite: str, experiments: Mapping[Experiment, Scores], names: Names) -> str:
    """Draw Fig. 5 for each budget: the mean with parts of the method switched on."""
    budgets: dict[str, dict[Experiment, Scores]] = defaultdict(dict)
    for one, tasks in experiments.items():
        if one.method in ABLATION:
            budgets[one.budget][one] = tasks
    return "".join(
        draw_ablation(suite, budget, experiments_of, names)
        for budget, experiments_of in budgets.items()
    )


def draw_ablation(
    suite: str, budget: str, experiments: Mapping[Experiment, Scores], names: Names
) -> str:
    """Draw the means over the common tasks of all methods, if there are any."""
    common = set.intersection(*(set(tasks) for tasks in experiments.values()))
    if len(experiments) < 2 or not common:
        return ""
    by_method = {one.method: one for one in experiments}
    values: dict[str, Estimate] = {}
    colours = []
    for method, part in ABLATION.items():
        if method in by_method:
            one = by_method[method]
            scores = [np.array(s) for task, s in experiments[one].items() if task in common]
            values[part] = aggregates.estimate(mean, scores)
            colours.append(figures.colour_of(names(one), names.all))
    title = f"{suite_title(suite)}: ablation, {budget}"
    return figures.bars(title, f"normalised mean, tasks: {len(common)}", values, colours)


def curves(runs: Sequence[Finished], names: Names) -> list[str]:
    """Draw a figure for each task: evaluations over frames, their mean and range over seeds."""
    drawn = [task_curves(task, runs, names) for task in dict.fromkeys(r.result.task for r in runs)]
    return [figure for figure in drawn if figure is not None]


def episodes_text(runs: Sequence[Finished]) -> str:
    """Return the number of episodes in each evaluation during fine-tuning, "" without any."""
    evaluations = [run.evaluations() for run in runs]
    numbers = {scores.shape[1] for _, scores in filter(None, evaluations)}
    return span(numbers, "episode") if numbers else ""


def task_curves(task: str, runs: Sequence[Finished], names: Names) -> str | None:
    """Draw the curves of a task, one for each experiment; None if no run was evaluated."""
    experiments: dict[Experiment, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
    metric = ""
    for run in runs:
        if run.result.task == task and (evaluations := run.evaluations()):
            experiments[run.experiment].append(evaluations)
            metric = run.result.metric
    if not experiments:
        return None
    lines = [curve(names(one), seeds) for one, seeds in experiments.items()]
    y_label = "success rate" if metric == "success" else "return"
    return figures.lines(task, "simulator frames", y_label, lines, names.all)


def curve(label: str, seeds: Sequence[tuple[np.ndarray, np.ndarray]]) -> figures.Line:
    """Return the mean over seeds at the frames that all have reached, lowest and highest seed.

    :param seeds: of each seed the frames (N,) and the scores (N, episodes)
    """
    reached = min(len(frames) for frames, _ in seeds)
    means = np.array([scores[:reached].mean(1) for _, scores in seeds])
    return figures.Line(label, seeds[0][0][:reached], (means.mean(0), means.min(0), means.max(0)))
