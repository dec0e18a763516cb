"""A record as tables and as a picture: every task and method, then the suites."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Self

import matplotlib
import numpy as np

from wpt_agents.files.archive import replacing
from wpt_agents.zoo.report.record import Line, place
from wpt_agents.zoo.report.tables import interval_text, markdown_table, number
from wpt_agents.zoo.result import Variant
from wpt_agents.zoo.statistics import Scores, bootstrap, mean, mean_interval

matplotlib.use("Agg")  # no display
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

COLOURS = {"wpt": "#0072b2", "kickstart": "#d55e00"}
OTHERS = "#777777"


@dataclass(frozen=True)
class Cell:
    """The scores of one method on one task or benchmark, with a 95 % interval."""

    scores: tuple[float, ...]
    mean: float
    low: float | None
    high: float | None

    @classmethod
    def of(cls, scores: Sequence[float]) -> Self:
        """Return the mean over seeds with Student's t interval."""
        return cls(tuple(scores), *mean_interval(scores))

    def __str__(self) -> str:
        interval = f" ({interval_text(self.low, self.high)})" if self.low is not None else ""
        return number(self.mean) + interval


class Key(NamedTuple):
    """What a cell is about."""

    method: str
    preset: Variant
    frames: int


def by_task(lines: Iterable[Line]) -> dict[tuple[str, str], dict[Key, Cell]]:
    """Return the cells of each suite and task."""
    scores: dict[tuple[str, str], dict[Key, list[float]]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        scores[line.suite, line.task][Key(line.method, line.preset, line.frames)].append(line.score)
    return {
        task: {key: Cell.of(values) for key, values in methods.items()}
        for task, methods in scores.items()
    }


class Means(NamedTuple):
    """The mean score of a method on a suite, and its number of tasks."""

    tasks: int
    cell: Cell


def by_suite(lines: Sequence[Line]) -> dict[str, dict[str, Means]]:
    """Return method -> suite -> mean score, and "both" for a method with runs of two suites.

    A method with another budget than that of `wpt` on the suite bears it in its name, "scratch, 3x
    frames"; where `wpt` has several presets or budgets, the smallest one bears none.
    """
    usual = usual_budgets(lines)
    groups: dict[str, dict[str, dict[str, list[float]]]] = {}
    for line in lines:
        frames, preset = usual.get(line.suite, (1, line.preset))
        ratio = line.frames / frames
        name = line.method if ratio in (0, 1) else f"{line.method}, {ratio:.3g}x frames"
        if line.preset != (preset if line.frames else preset.playing):
            name += f", {line.preset}"
        suites = groups.setdefault(name, {})
        suites.setdefault(line.suite, defaultdict(list))[line.task].append(line.score)
    return {method: _means(groups[method]) for method in sorted(groups, key=place)}


def usual_budgets(lines: Sequence[Line]) -> dict[str, tuple[int, Variant]]:
    """Return the smallest budget and preset of `wpt` on each suite, or of others if it has none."""
    usual: dict[str, tuple[bool, int, Variant]] = {}
    for line in lines:
        if line.frames:
            here = line.method != "wpt", line.frames, line.preset
            usual[line.suite] = min(usual.get(line.suite, here), here)
    return {suite: (frames, preset) for suite, (_, frames, preset) in usual.items()}


def _means(groups: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, Means]:
    """Return the mean over the tasks of each suite, and over two; with bootstrap intervals."""
    means: dict[str, Means] = {}
    strata: dict[str, list[np.ndarray]] = {}
    for suite, tasks in groups.items():
        strata[suite] = [np.array(scores) for scores in tasks.values()]
        means[suite] = Means(len(tasks), _cell(strata[suite], mean))
    if len(strata) == 2:
        every = [scores for scores_of_tasks in strata.values() for scores in scores_of_tasks]
        ends = [0, *np.cumsum([len(scores_of_tasks) for scores_of_tasks in strata.values()])]

        def both(scores: Scores) -> np.ndarray:
            return np.mean([mean(scores[a:b]) for a, b in pairwise(ends)], 0)

        means["both"] = Means(len(every), _cell(every, both))
    return means


def _cell(strata: Sequence[np.ndarray], statistic: Callable[[Scores], np.ndarray]) -> Cell:
    low = None
    high = None
    if all(len(stratum) > 1 for stratum in strata):  # a single seed would seem to be certain
        low, high = map(float, bootstrap(statistic, strata))
    scores = tuple(float(s) for stratum in strata for s in stratum)
    return Cell(scores, float(statistic(strata)), low, high)


TASK_HEADINGS = (
    *("task", "method", "preset", "frames", "score (95 % by t)", "of each seed", "mean return"),
)
SUITE_HEADINGS = ("suite", "method", "tasks", "runs", "mean score (95 %, bootstrap)")


def markdown(lines: Sequence[Line]) -> str:
    """Return a table of every task and method, then one of the suites."""
    earned: dict[tuple[str, Key], list[float]] = defaultdict(list)
    for line in lines:
        earned[line.task, Key(line.method, line.preset, line.frames)].append(line.return_)
    rows = []
    for (_, task), methods in by_task(lines).items():
        for key, cell in methods.items():
            names = [task, key.method, str(key.preset), f"{key.frames:,}"]
            seeds = " ".join(map(number, cell.scores))
            mean_return = float(np.mean(earned[task, key]))
            rows.append([*names, str(cell), seeds, number(mean_return)])
    suites = [
        [suite, method, str(tasks), str(len(cell.scores)), str(cell)]
        for method, means in by_suite(lines).items()
        for suite, (tasks, cell) in means.items()
    ]
    return markdown_table(TASK_HEADINGS, rows) + "\n" + markdown_table(SUITE_HEADINGS, suites)


def draw(path: Path, lines: Sequence[Line]) -> None:
    """Draw a panel for each task: the seeds of each method as dots, their mean as a stroke."""
    tasks = by_task(lines)
    columns = min(4, len(tasks))
    height = -(-len(tasks) // columns)
    figure, panels = plt.subplots(
        height, columns, figsize=(3.1 * columns, 2.6 * height), squeeze=False, layout="constrained"
    )
    for panel, ((suite, task), methods) in zip(panels.flat, tasks.items(), strict=False):
        shown = {key: cell for key, cell in methods.items() if not key.method.endswith("last")}
        _draw_panel(panel, task.removeprefix(f"{suite}-"), shown)
    for panel in panels.flat[len(tasks) :]:
        panel.remove()
    figure.supxlabel("score, 0 to 100\na dot per seed, a stroke at their mean", fontsize=9)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    plt.close(figure)


def _draw_panel(panel: Axes, title: str, cells: Mapping[Key, Cell]) -> None:
    for at, (key, cell) in enumerate(cells.items()):
        colour = COLOURS.get(key.method, OTHERS)
        panel.plot(cell.scores, [at] * len(cell.scores), "o", ms=5, color=colour, alpha=0.7)
        panel.plot([cell.mean] * 2, [at - 0.3, at + 0.3], color=colour, lw=2)
    panel.set_yticks(range(len(cells)), row_names(cells), fontsize=7.5)
    panel.set(xlim=(-4, 104), title=title)
    panel.title.set_fontsize(9)
    panel.invert_yaxis()
    panel.grid(axis="x", lw=0.4)
    panel.spines[["top", "right"]].set_visible(False)


def row_names(keys: Iterable[Key]) -> list[str]:
    """Return the methods; one of several presets or budgets with what tells these apart."""
    keys = list(keys)
    presets: dict[str, set[frozenset[str]]] = defaultdict(set)
    budgets: dict[str, set[int]] = defaultdict(set)
    for method, preset, frames in keys:
        presets[method].add(frozenset(preset.words))
        budgets[method].add(frames)
    names = []
    for method, preset, frames in keys:
        common = frozenset.intersection(*presets[method])
        changes = [word for word in preset.words if word not in common]
        budget = [f"{frames:,} frames"] if len(budgets[method]) > 1 else []
        names.append(", ".join([",\n".join([method, *changes]), *budget]))
    return names
