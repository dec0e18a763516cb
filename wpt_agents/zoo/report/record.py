"""The record: one CSV line a task, method and seed, small enough for a repository, and its table.

Run folders are large and die with their machine; what they found is kept here. A record grows:
lines of runs that are gone stay, lines of the same run are replaced.
"""

import csv
import io
import shlex
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import matplotlib
import numpy as np

from wpt_agents.files.archive import replacing
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.report.aggregates import BEST_RETURN
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.tables import interval_text, markdown_table, number
from wpt_agents.zoo.statistics import bootstrap, mean, mean_interval

matplotlib.use("Agg")  # no display
from matplotlib import pyplot as plt

UNTRAINED = ("nothing", "random")


@dataclass(frozen=True)
class Line:
    """What one policy of one run came to.

    :param method: the run's method for the policy that it ends with; otherwise the policy's name
    :param score: 0 to 100 as in the paper: the return / 10, or the share of successes x 100
    :param hours: of the whole run, shared stages that it had to make included
    """

    suite: str
    task: str
    method: str
    seed: int
    preset: str
    frames: int
    score: float
    return_: float
    success: float | None
    hours: float
    commit: str
    command: str

    @property
    def run(self) -> tuple[str, str, str, int, int]:
        """What no other line is of."""
        return self.task, self.method, self.preset, self.frames, self.seed


COLOURS = {"wpt": "#0072b2", "kickstart": "#d55e00"}
WPT_CLONES = [  # methods whose prior actor is wpt's, if they have one
    name for name, m in METHODS.items() if m.pretrained and "retrieval" not in m.wpt
]
ORDER = (  # in which methods are told: the simplest first, then the paper's ablation, ours
    *("nothing", "random", "prior actor", "scratch", "pretrain-only", "no-guidance"),
    *("no-rehearsal", "random-retrieval", "no-pretrain", "wpt", "kickstart"),
)
COLUMNS = [field.name.rstrip("_") for field in fields(Line)]


def lines_of(runs: Iterable[Finished]) -> list[Line]:
    """The lines of run folders; untrained policies once a task and seed."""
    last = sorted(runs, key=lambda run: run.result["method"] == "wpt")  # whose clone is told of
    found = {line.run: line for run in last for line in _lines(run.result)}
    return sorted(found.values(), key=_order)


def _lines(result: Mapping[str, Any]) -> Iterator[Line]:
    for policy, score in result["scores"].items():
        success = score["success_rate"] if result["metric"] == "success" else None
        yield Line(
            result["suite"],
            result["task"],
            _method(policy, result["method"]),
            result["seed"],
            played(result["preset"]) if policy in UNTRAINED else result["preset"],
            0 if policy in UNTRAINED else result["frames"],
            round(100 * (score["mean"] / BEST_RETURN if success is None else success), 2),
            round(score["mean"], 2),
            success,
            round(sum(result["seconds"].values()) / 3600, 4),
            result.get("commit") or "unknown",
            command(result),
        )


def played(preset: str) -> str:
    """What of a preset's name tells how policies are played that learn nothing."""
    name, *changes = shlex.split(preset)
    return shlex.join([name, *(c for c in changes if c.startswith(("env.", "evaluate.")))])


def _method(policy: str, method: str) -> str:
    """'wpt', 'wpt, last', 'prior actor', 'prior actor, no-pretrain', 'random'."""
    if policy in UNTRAINED:
        return policy
    name = policy.replace("WPT", method)
    return name if policy.startswith("WPT") or method in WPT_CLONES else f"{name}, {method}"


def command(result: Mapping[str, Any]) -> str:
    """What does the run again, wherever it is typed."""
    preset, *changes = shlex.split(result["preset"])
    words = [*("python -m wpt_agents.zoo run --suite".split()), result["suite"]]
    words += ["--tasks", result["task"], "--method", result["method"], "--preset", preset]
    seed = result["seed"]
    words += ["--frames", str(result["frames"]), "--seeds", f"{seed}-{seed}"]
    for change in changes:
        words += ["--data", change[5:]] if change.startswith("data=") else ["--set", change]
    return shlex.join(words)


def _order(line: Line) -> tuple[str, str, int, str, str, int, int]:
    place = _place(line.method)
    return line.suite, line.task, place, line.method, line.preset, line.frames, line.seed


def _place(method: str) -> int:
    """Where a method is told; "wpt, last" where "wpt" is, unknown ones at the end."""
    name = method.split(",")[0]
    return ORDER.index(name) if name in ORDER else len(ORDER)


def update(path: Path, lines: Iterable[Line]) -> list[Line]:
    """Writes `lines` into the record at `path`, whole or not at all, and returns all it holds."""
    before = read(path) if path.exists() else []
    every = sorted({line.run: line for line in [*before, *lines]}.values(), key=_order)
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(asdict(line).values() for line in every)
    with replacing(path) as temporary:
        temporary.write_text(file.getvalue())
    return every


def read(path: Path) -> list[Line]:
    """The lines of a record.

    :raises ValueError: a file that is no record, or is damaged
    """
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    try:
        return [_parse(row) for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is no record of runs ({error}); its columns are {', '.join(COLUMNS)}"
        ) from None


def _parse(row: Mapping[str, str]) -> Line:
    kinds: dict[str, Any] = {"seed": int, "frames": int, "score": float, "return": float}
    kinds |= {"hours": float, "success": lambda text: float(text) if text else None}
    return Line(*(kinds.get(name, str)(row[name]) for name in COLUMNS))


@dataclass(frozen=True)
class Cell:
    """One method on one task or benchmark, over its seeds; the interval is of 95 %."""

    scores: tuple[float, ...]
    mean: float
    low: float | None
    high: float | None

    @classmethod
    def of(cls, scores: Sequence[float]) -> Self:
        """The mean over seeds with Student's t interval."""
        return cls(tuple(scores), *mean_interval(scores))

    def __str__(self) -> str:
        around = f" ({interval_text(self.low, self.high)})" if self.low is not None else ""
        return number(self.mean) + around


Key = tuple[str, str, int]  # method, preset, frames


def by_task(lines: Iterable[Line]) -> dict[tuple[str, str], dict[Key, Cell]]:
    """(suite, task) -> (method, preset, frames) -> its cell."""
    found: dict[tuple[str, str], dict[Key, list[float]]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        found[line.suite, line.task][line.method, line.preset, line.frames].append(line.score)
    return {
        task: {key: Cell.of(scores) for key, scores in methods.items()}
        for task, methods in found.items()
    }


def by_suite(lines: Sequence[Line]) -> dict[str, dict[str, tuple[int, Cell]]]:
    """Method -> suite -> its number of tasks and their mean score; "both" if there are two suites.

    A method with another budget than wpt's on the suite bears it in its name: "scratch, 3x frames";
    where wpt has several presets or budgets, its least one is taken, and the others bear them too.
    """
    usual: dict[str, tuple[bool, int, str]] = {}
    for line in lines:
        if line.frames:  # others than wpt's count where a suite has none
            here = line.method != "wpt", line.frames, line.preset
            usual[line.suite] = min(usual.get(line.suite, here), here)
    groups: dict[str, dict[str, dict[str, list[float]]]] = {}
    for line in lines:
        _, frames, preset = usual.get(line.suite, (True, 1, line.preset))
        ratio = line.frames / frames
        name = line.method if ratio in (0, 1) else f"{line.method}, {ratio:.3g}x frames"
        alike = preset if line.frames else played(preset)
        name += f", {line.preset}" if line.preset != alike else ""
        suites = groups.setdefault(name, {})
        suites.setdefault(line.suite, defaultdict(list))[line.task].append(line.score)
    return {method: _means(groups[method]) for method in sorted(groups, key=_place)}


def _means(groups: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, tuple[int, Cell]]:
    """The mean over tasks of each suite, and over the two; the stratified bootstrap's intervals."""
    found: dict[str, tuple[int, Cell]] = {}
    strata: dict[str, list[np.ndarray]] = {}
    for suite, tasks in groups.items():
        strata[suite] = [np.array(scores) for scores in tasks.values()]
        found[suite] = len(tasks), _cell(strata[suite], mean)
    if len(strata) == 2:
        every = [scores for each in strata.values() for scores in each]
        ends = [0, *np.cumsum([len(each) for each in strata.values()])]

        def both(scores: Sequence[np.ndarray]) -> np.ndarray:
            return np.mean([mean(scores[a:b]) for a, b in pairwise(ends)], 0)

        found["both"] = len(every), _cell(every, both)
    return found


def _cell(strata: Sequence[np.ndarray], statistic: Any) -> Cell:
    low = high = None
    if all(len(stratum) > 1 for stratum in strata):  # a single seed would seem to be certain
        low, high = map(float, bootstrap(statistic, strata))
    scores = tuple(float(s) for stratum in strata for s in stratum)
    return Cell(scores, float(statistic(strata)), low, high)


def markdown(lines: Sequence[Line]) -> str:
    """Every task and method of a record, then the suites; no interval of single seeds."""
    earned: dict[tuple[str, str, str, int], list[float]] = defaultdict(list)
    for line in lines:
        earned[line.task, line.method, line.preset, line.frames].append(line.return_)
    returns = {key: float(np.mean(values)) for key, values in earned.items()}
    rows = [
        [
            *(task, method, preset, f"{frames:,}", str(cell), " ".join(map(number, cell.scores))),
            number(returns[task, method, preset, frames]),
        ]
        for (_, task), methods in by_task(lines).items()
        for (method, preset, frames), cell in methods.items()
    ]
    headings = (
        "task",
        "method",
        "preset",
        "frames",
        "score (95 % by t)",
        "of each seed",
        "mean return",
    )
    suites = [
        [suite, method, str(tasks), str(len(cell.scores)), str(cell)]
        for method, means in by_suite(lines).items()
        for suite, (tasks, cell) in means.items()
    ]
    return (
        markdown_table(headings, rows)
        + "\n"
        + markdown_table(
            ("suite", "method", "tasks", "runs", "mean score (95 %, bootstrap)"), suites
        )
    )


def draw(path: Path, lines: Sequence[Line]) -> None:
    """A panel a task: each method's seeds as dots, their mean as a stroke."""
    tasks = by_task(lines)
    columns = min(4, len(tasks))
    height = -(-len(tasks) // columns)
    figure, panels = plt.subplots(
        height, columns, figsize=(3.1 * columns, 2.6 * height), squeeze=False, layout="constrained"
    )
    for panel, ((suite, task), methods) in zip(panels.flat, tasks.items(), strict=False):
        shown = {key: cell for key, cell in methods.items() if not key[0].endswith("last")}
        for at, ((method, *_), cell) in enumerate(shown.items()):
            colour = COLOURS.get(method, "#777777")
            panel.plot(cell.scores, [at] * len(cell.scores), "o", ms=5, color=colour, alpha=0.7)
            panel.plot([cell.mean] * 2, [at - 0.3, at + 0.3], color=colour, lw=2)
        panel.set_yticks(range(len(shown)), _names(shown), fontsize=7.5)
        panel.set(xlim=(-4, 104), title=task.removeprefix(f"{suite}-"))
        panel.title.set_fontsize(9)
        panel.invert_yaxis()
        panel.grid(axis="x", lw=0.4)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in panels.flat[len(tasks) :]:
        panel.remove()
    figure.supxlabel("score, 0 to 100\na dot a seed, the stroke their mean", fontsize=9)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    plt.close(figure)


def _names(shown: Iterable[Key]) -> list[str]:
    """Methods; where one has several presets or budgets, with what tells these apart."""
    keys, presets, budgets = list(shown), defaultdict(set), defaultdict(set)
    for method, preset, frames in keys:
        presets[method].add(frozenset(shlex.split(preset)))
        budgets[method].add(frames)
    names = []
    for method, preset, frames in keys:
        common = frozenset.intersection(*presets[method])
        changes = [word for word in shlex.split(preset) if word not in common]
        budget = [f"{frames:,} frames"] if len(budgets[method]) > 1 else []
        names.append(", ".join([",\n".join([method, *changes]), *budget]))
    return names
