"""A record as tables: every task and method, then the suites."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from wpt_envs.tasks import TASKS

from wpt_agents.zoo.numbers import ANY, PERCENT, Range, interval_text, number
from wpt_agents.zoo.record_lines import Line
from wpt_agents.zoo.report.record import place
from wpt_agents.zoo.report.tables import markdown_table
from wpt_agents.zoo.result import Variant
from wpt_agents.zoo.statistics import Scores, bootstrap, mean, mean_interval, resamplable

OURS = ("wpt+", "wpt")  # the main methods of a record


@dataclass(frozen=True)
class Cell:
    """The scores of one method on one task or benchmark, with a 95 % interval.

    :param possible: the range of the scores
    """

    scores: tuple[float, ...]
    mean: float
    low: float | None
    high: float | None
    possible: Range = ANY

    @classmethod
    def of(cls, scores: Sequence[float], possible: Range = ANY) -> Self:
        """Return the mean over seeds, with Student's t interval from three seeds on."""
        return cls(tuple(scores), *mean_interval(scores), possible)

    def __str__(self) -> str:
        if self.low is None:
            return number(self.mean)
        interval = interval_text(self.low, self.high, self.possible)
        return f"{number(self.mean)} ({interval})"


class Key(NamedTuple):
    """The identity of a cell."""

    method: str
    preset: Variant
    frames: int


def by_task(lines: Iterable[Line]) -> dict[tuple[str, str], dict[Key, Cell]]:
    """Return the cells of each suite and task."""
    scores: dict[tuple[str, str], dict[Key, list[float]]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        scores[line.suite, line.task][Key(line.method, line.preset, line.frames)].append(line.score)
    return {
        (suite, task): {key: Cell.of(values, _possible(suite)) for key, values in methods.items()}
        for (suite, task), methods in scores.items()
    }


def _possible(suite: str) -> Range:
    """Return the range of a suite's scores, which cuts off the ends of intervals."""
    metrics = {task.metric for task in TASKS.values() if task.suite == suite}
    return PERCENT if metrics == {"success"} else ANY


class Means(NamedTuple):
    """The mean score of a method on a suite, and its number of tasks."""

    tasks: int
    cell: Cell


def by_suite(lines: Sequence[Line]) -> dict[str, dict[str, Means]]:
    """Return method -> suite -> mean score, and "both" for a method with runs of two suites."""
    usual = usual_budgets(lines)
    groups: dict[str, dict[str, dict[str, list[float]]]] = {}
    for line in lines:
        name = column(line, *usual.get(line.suite, (1, line.preset)))
        suites = groups.setdefault(name, {})
        suites.setdefault(line.suite, defaultdict(list))[line.task].append(line.score)
    return {method: _means(groups[method]) for method in sorted(groups, key=place)}


def column(line: Line, frames: int, preset: Variant) -> str:
    """Return the method with unusual settings of its run: "scratch, 3x frames".

    A budget that this would round has its own number of frames, so that two do not share a column.
    Changed settings are always named, also if the record has no run of the unchanged preset.
    """
    ratio = f"{line.frames / frames:.3g}"
    exact = round(float(ratio) * frames) == line.frames
    budget = f"{ratio}x frames" if exact else f"{line.frames:,} frames"
    name = line.method if line.frames in (0, frames) else f"{line.method}, {budget}"
    usual = line.preset == (preset if line.frames else preset.playing) and not line.preset.changes
    return name if usual else f"{name}, {line.preset}"


def usual_budgets(lines: Sequence[Line]) -> dict[str, tuple[int, Variant]]:
    """Return the usual number of frames and preset of each suite that has trained policies.

    An unchanged preset comes before a changed one, then the methods `OURS` before others, then the
    smallest budget.
    """
    usual: dict[str, tuple[bool, bool, int, Variant]] = {}
    for line in lines:
        if line.frames:
            rank = bool(line.preset.changes), line.method not in OURS, line.frames, line.preset
            usual[line.suite] = min(usual.get(line.suite, rank), rank)
    return {suite: (frames, preset) for suite, (*_, frames, preset) in usual.items()}


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
    if resamplable(strata):
        low, high = map(float, bootstrap(statistic, strata))
    scores = tuple(float(s) for stratum in strata for s in stratum)
    return Cell(scores, float(statistic(strata)), low, high)


TASK_HEADINGS = (
    *("task", "method", "preset", "frames", "score (95 % over seeds)", "of each seed"),
    "mean return",
)
SUITE_HEADINGS = ("suite", "method", "tasks", "runs", "mean score (95 %, bootstrap)")
TASK_NOTE = (
    "Scores are from 0 to 100. In brackets is the 95 % interval over seeds by Student's t, from "
    "three seeds on; an end marked * is cut off at the limit of a success rate."
)
MIXED_NOTE = (
    "**The seeds of these rows began with different or unknown pre-trained models**, so their mean "
    "and their spread are not those of seeds alone. The first digits of the SHA-256 of each model:"
)
SUITE_NOTE = (
    "In brackets is the 95 % interval by a bootstrap over the seeds within each task. It needs two "
    "seeds of every task, or three if there is a single task."
)


def mixed_models(lines: Iterable[Line]) -> str:
    """Return a paragraph about rows whose seeds began with different models, "" without any."""
    models: dict[tuple[str, Key], dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        row = line.task, Key(line.method, line.preset, line.frames)
        models[row][line.model_hash or "unknown"].append(line.seed)
    items = [
        f"- {task}, {key.method}, {key.preset}, {key.frames:,} frames: "
        + "; ".join(f"{model} (seed {', '.join(map(str, seeds))})" for model, seeds in used.items())
        for (task, key), used in models.items()
        if len(used) > 1
    ]
    return f"{MIXED_NOTE}\n\n" + "\n".join(items) + "\n\n" if items else ""


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
    mixed = mixed_models(lines)
    suites = [
        [suite, method, str(tasks), str(len(cell.scores)), str(cell)]
        for method, means in by_suite(lines).items()
        for suite, (tasks, cell) in means.items()
    ]
    return (
        f"## Every run\n\n{TASK_NOTE}\n\n{markdown_table(TASK_HEADINGS, rows)}\n{mixed}"
        f"## Means over tasks\n\n{SUITE_NOTE}\n\n{markdown_table(SUITE_HEADINGS, suites)}"
    )
