"""Aggregates over the tasks of a suite: normalised scores, and the paper's numbers."""

import csv
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.presets import preset_folder
from wpt_agents.zoo.result import Result, Variant
from wpt_agents.zoo.statistics import (
    bootstrap,
    iqm,
    mean,
    median,
    optimality_gap,
    probability_of_improvement,
    resamplable,
)

PAPER_BUDGET = 150_000  # simulator frames
BEST_RETURN = 1000.0  # maximum return of a DMControl episode; success rates are already normalised
STATISTICS = {"mean": mean, "median": median, "IQM": iqm, "optimality gap": optimality_gap}
Estimate = tuple[float, float | None, float | None]  # value, and its 95 % interval if there is one


@dataclass(frozen=True, order=True)
class Experiment:
    """An experiment: the runs of one method, preset variant and budget on a suite."""

    suite: str
    variant: Variant
    frames: int
    method: str

    @classmethod
    def of(cls, result: Result) -> "Experiment":
        """Return the experiment that a run belongs to."""
        return cls(result.suite, result.variant, result.frames, result.method)

    @property
    def budget(self) -> str:
        """Return the label, for example 'demo, 8,000 frames'."""
        return f"{self.variant}, {self.frames:,} frames"


@dataclass(frozen=True)
class Reference:
    """The paper's score of a method on a task; "mean" and "median" count as tasks."""

    table: int
    suite: str
    task: str
    method: str
    samples: int
    score: float | None
    source: str


@cache
def references() -> tuple[Reference, ...]:
    """Return every number of the paper's Tables 3 to 5, and of the baselines by their authors.

    The method `ncrl` is WPT in the ICLR 2026 version of the paper. The files `table*.csv` are the
    paper's tables; `official.csv` holds curves that the authors of DrQ-v2, DreamerV3 and MR.Q
    published, of tasks in Table 5.
    """
    references = []
    folder = preset_folder() / "references"
    for path in (*sorted(folder.glob("table*.csv")), folder / "official.csv"):
        table = 5 if path.stem == "official" else int(path.stem[-1])
        with open(path, newline="", encoding="utf-8") as file:
            rows = [SimpleNamespace(**row) for row in csv.DictReader(file)]
        for row in rows:
            score = float(row.score) if row.score else None
            samples = int(row.samples)
            references.append(
                Reference(table, row.suite, row.task, row.method, samples, score, row.source)
            )
    return tuple(references)


def paper_tasks(suite: str, method: str = "") -> set[str]:
    """Return the tasks of a suite for which the paper has scores: of a method, "" for any."""
    return {
        row.task
        for row in references()
        if row.suite == suite
        and row.task not in STATISTICS
        and method in ("", row.method)
        and row.score is not None
    }


def printed_scores(suite: str, method: str, samples: int) -> dict[str, float]:
    """Return the paper's scores of a method by task, in the units of its tables."""
    return {
        row.task: row.score
        for row in references()
        if (row.suite, row.method, row.samples) == (suite, method, samples)
        and row.task not in STATISTICS
        and row.score is not None
    }


def normalised(score: float, metric: str) -> float:
    """Return a score normalised to a maximum of 1."""
    return score if metric == "success" else score / BEST_RETURN


def by_experiment(results: Iterable[Result]) -> dict[Experiment, dict[str, list[float]]]:
    """Return the normalised scores of the runs, by experiment and task, in the order of seeds."""
    groups: dict[Experiment, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for result in sorted(results, key=lambda result: result.seed):
        score = normalised(result.counted(), result.metric)
        groups[Experiment.of(result)][result.task].append(score)
    return {one: dict(groups[one]) for one in sorted(groups, key=order)}


def order(one: Experiment) -> tuple[str, Variant, int, int]:
    """Return the place of an experiment; methods are in the order of METHODS, unknown ones last."""
    names = list(METHODS)
    place = names.index(one.method) if one.method in names else len(names)
    return one.suite, one.variant, one.frames, place


def aggregate(tasks: Mapping[str, Sequence[float]]) -> dict[str, Estimate]:
    """Return each of STATISTICS over a suite's tasks, with stratified bootstrap intervals."""
    scores = [np.array(runs) for runs in tasks.values()]
    return {name: estimate(statistic, scores) for name, statistic in STATISTICS.items()}


def estimate(statistic: Any, *groups: Sequence[np.ndarray]) -> Estimate:
    """Return a statistic and its 95 % interval, which is None if the runs are not `resamplable`."""
    value = float(statistic(*groups))
    if not all(map(resamplable, groups)):
        return value, None, None
    low, high = bootstrap(statistic, *groups)
    return value, float(low), float(high)


def improvement(
    ours: Mapping[str, Sequence[float]], theirs: Mapping[str, Sequence[float]]
) -> tuple[Estimate, int] | None:
    """Return the probability that ours beats theirs over common tasks, and their number."""
    common = [task for task in ours if task in theirs]
    if not common:
        return None
    groups = [[np.array(group[task]) for task in common] for group in (ours, theirs)]
    return estimate(probability_of_improvement, *groups), len(common)


@dataclass(frozen=True)
class Aggregate:
    """The paper's normalised mean and median over some tasks.

    :param tasks: the number of tasks
    """

    mean: float
    median: float
    tasks: int


def paper_aggregate(
    suite: str, tasks: Iterable[str], method: str, samples: int
) -> Aggregate | None:
    """Return the paper's mean and median over these tasks, None if it has no score for any."""
    names = set(tasks)
    best = BEST_RETURN if suite == "dmc" else 1.0
    printed = printed_scores(suite, method, samples)
    scores = [score / best for task, score in printed.items() if task in names]
    if not scores:
        return None
    return Aggregate(float(np.mean(scores)), float(np.median(scores)), len(scores))


def misprint(row: Reference) -> float | None:
    """Return the correct mean or median of the rows above, if the printed one differs."""
    if row.task not in STATISTICS or row.score is None:
        return None
    scores = list(printed_scores(row.suite, row.method, row.samples).values())
    right = float(np.mean(scores) if row.task == "mean" else np.median(scores))
    rounding = 0.006 if row.suite == "dmc" else 0.0006  # half a unit of the last printed digit
    return None if abs(right - row.score) <= rounding else right
