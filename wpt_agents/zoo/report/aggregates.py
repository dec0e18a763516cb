"""All tasks of a suite together: normalised scores, their aggregates, the paper's beside them."""

import csv
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.presets import preset_folder
from wpt_agents.zoo.statistics import (
    bootstrap,
    iqm,
    mean,
    median,
    optimality_gap,
    probability_of_improvement,
    resamplable,
)

BEST_RETURN = 1000.0  # of a DMControl episode; a success rate is a share already
STATISTICS = {"mean": mean, "median": median, "IQM": iqm, "optimality gap": optimality_gap}
Estimate = tuple[float, float | None, float | None]  # value, and its 95 % interval if it has one


@dataclass(frozen=True, order=True)
class Experiment:
    """What is compared: runs of one method, preset and budget on a suite."""

    suite: str
    preset: str
    frames: int
    method: str

    @classmethod
    def of(cls, result: Mapping[str, Any]) -> "Experiment":
        """The experiment that a run belongs to."""
        return cls(result["suite"], result["preset"], result["frames"], result["method"])

    @property
    def budget(self) -> str:
        """'demo, 8,000 frames'."""
        return f"{self.preset}, {self.frames:,} frames"


@dataclass(frozen=True)
class Reference:
    """The paper's score of a method on a task, "mean" and "median" included as tasks."""

    table: int
    suite: str
    task: str
    method: str
    samples: int
    score: float | None
    source: str


@cache
def references() -> tuple[Reference, ...]:
    """Every number of the paper's Tables 3 to 5, and of both baselines as their authors ran them.

    The method `ncrl` is WPT as its ICLR 2026 version prints it. The files `table*.csv` are the
    paper's tables; `official.csv` holds curves that the authors of DrQ-v2, DreamerV3 and MR.Q
    published, of tasks in Table 5.
    """
    found = []
    folder = preset_folder() / "references"
    for path in (*sorted(folder.glob("table*.csv")), folder / "official.csv"):
        table = 5 if path.stem == "official" else int(path.stem[-1])
        with open(path, newline="") as file:
            for row in csv.DictReader(file):
                score = float(row["score"]) if row["score"] else None
                about = row["suite"], row["task"], row["method"], int(row["samples"])
                found.append(Reference(table, *about, score, row["source"]))
    return tuple(found)


def score_of(result: Mapping[str, Any], policy: str = "WPT") -> float:
    """What a run counts for: WPT's success rate if the task counts successes, else its return."""
    score = result["scores"][policy]
    return score["success_rate"] if result["metric"] == "success" else score["mean"]


def normalised(score: float, metric: str) -> float:
    """A score with 1 as the best to be had."""
    return score if metric == "success" else score / BEST_RETURN


def by_experiment(results: Iterable[Mapping[str, Any]]) -> dict[Experiment, dict[str, list[float]]]:
    """For each experiment and task, the normalised scores of its runs, by seed."""
    found: dict[Experiment, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for result in sorted(results, key=lambda result: result["seed"]):
        score = normalised(score_of(result), result["metric"])
        found[Experiment.of(result)][result["task"]].append(score)
    return {one: dict(found[one]) for one in sorted(found, key=order)}


def order(one: Experiment) -> tuple[str, str, int, int]:
    """The order that experiments are told in; methods as METHODS has them, wpt first."""
    return one.suite, one.preset, one.frames, list(METHODS).index(one.method)


def aggregate(tasks: Mapping[str, Sequence[float]]) -> dict[str, Estimate]:
    """Each of STATISTICS over a suite's tasks, with the stratified bootstrap's interval."""
    scores = [np.array(runs) for runs in tasks.values()]
    return {name: estimate(statistic, scores) for name, statistic in STATISTICS.items()}


def estimate(statistic: Any, *groups: Sequence[np.ndarray]) -> Estimate:
    """A statistic of scores and its 95 % interval, which it has not if a task has a single run."""
    value = float(statistic(*groups))
    if not all(map(resamplable, groups)):
        return value, None, None
    low, high = bootstrap(statistic, *groups)
    return value, float(low), float(high)


def improvement(
    ours: Mapping[str, Sequence[float]], theirs: Mapping[str, Sequence[float]]
) -> tuple[Estimate, int] | None:
    """The probability that ours beats theirs, over the tasks that both have, and their number."""
    common = [task for task in ours if task in theirs]
    if not common:
        return None
    groups = [[np.array(each[task]) for task in common] for each in (ours, theirs)]
    return estimate(probability_of_improvement, *groups), len(common)


def paper_aggregate(
    suite: str, tasks: Iterable[str], method: str, samples: int
) -> dict[str, float]:
    """The paper's mean and median over these tasks, normalised; empty if it has none of them."""
    wanted, best = set(tasks), BEST_RETURN if suite == "dmc" else 1.0
    scores = [
        row.score / best
        for row in references()
        if (row.suite, row.method, row.samples) == (suite, method, samples)
        and row.task in wanted
        and row.score is not None
    ]
    return {"mean": float(np.mean(scores)), "median": float(np.median(scores))} if scores else {}


def misprint(row: Reference) -> float | None:
    """What a printed mean or median should be by the rows above it, if they disagree."""
    if row.task not in ("mean", "median") or row.score is None:
        return None
    scores = [
        other.score
        for other in references()
        if (other.suite, other.method, other.samples) == (row.suite, row.method, row.samples)
        and other.task not in ("mean", "median")
        and other.score is not None
    ]
    right = float(np.mean(scores) if row.task == "mean" else np.median(scores))
    rounding = 0.006 if row.suite == "dmc" else 0.0006  # half of the last digit that is printed
    return None if abs(right - row.score) <= rounding else right
