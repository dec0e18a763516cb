"""The page's headline: WPT's wins and losses against other policies, and the mean score."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from wpt_agents.zoo.report import aggregates
from wpt_agents.zoo.report.aggregates import PAPER_BUDGET, Experiment
from wpt_agents.zoo.report.names import policy_name
from wpt_agents.zoo.result import PRIOR_ACTOR, RANDOM, Result, Variant
from wpt_agents.zoo.statistics import mean, mean_interval

SUITES = {"dmc": "DMControl", "metaworld": "Meta-World", "robotics": "Gymnasium-Robotics"}
OURS = "wpt"
COMPARED = {  # a policy's label on the page, and its `policy_name`
    "random policy": RANDOM,
    "prior actor": PRIOR_ACTOR,
    "same, from scratch": "scratch",
}

Policies = dict[str, dict[int, float]]  # name -> seed -> score


def suite_title(suite: str) -> str:
    """Return the title of a suite; a suite that was added has its name as title."""
    return SUITES.get(suite, suite)


@dataclass(frozen=True)
class Comparison:
    """The number of tasks on which WPT's interval lies above or below another policy's."""

    policy: str
    above: int
    below: int
    tasks: int


@dataclass(frozen=True)
class Headline:
    """WPT against other policies on a suite; `against` is empty if no task has three seeds."""

    suite: str
    preset: Variant
    frames: int
    against: list[Comparison] = field(default_factory=list)


def headlines(results: Sequence[Result]) -> list[Headline]:
    """Compare WPT with other policies, on each suite, preset and budget.

    Tasks with fewer than three seeds have no interval and do not count.
    """
    groups: dict[tuple[str, Variant, int], dict[str, Policies]] = {}
    for result in results:
        group = groups.setdefault((result.suite, result.variant, result.frames), {})
        task = group.setdefault(result.task, {})
        for policy in result.scores:
            name = policy_name(result, policy)
            if name == PRIOR_ACTOR and result.method != OURS:
                continue  # other methods have the same prior actor with other seeds
            task.setdefault(name, {})[result.seed] = result.counted(policy)
    return [
        Headline(suite_title(suite), preset, frames, compare(list(tasks.values())))
        for (suite, preset, frames), tasks in groups.items()
        if any(OURS in task for task in tasks.values())
    ]


def compare(tasks: Sequence[Policies]) -> list[Comparison]:
    """Compare WPT with each of COMPARED, on tasks with at least three seeds of both."""
    comparisons = []
    for title, name in COMPARED.items():
        pairs = [
            (list(task[OURS].values()), list(task[name].values()))
            for task in tasks
            if OURS in task and name in task
        ]
        pairs = [pair for pair in pairs if min(map(len, pair)) > 2]
        if pairs:
            higher = sum(above(ours, theirs) for ours, theirs in pairs)
            lower = sum(above(theirs, ours) for ours, theirs in pairs)
            comparisons.append(Comparison(title, higher, lower, len(pairs)))
    return comparisons


def above(one: Sequence[float], other: Sequence[float]) -> bool:
    """Return whether one interval over seeds, by Student's t, lies above the other."""
    _, low, _ = mean_interval(one)
    _, _, high = mean_interval(other)
    return low is not None and high is not None and low > high


@dataclass(frozen=True)
class BothSuites:
    """The mean of the two suites' means, ours and the paper's over the same tasks."""

    method: str
    preset: Variant
    ours: float
    paper: float | None


def both_suites(results: Sequence[Result]) -> list[BothSuites]:
    """Return the paper's aggregate for each preset and method that has runs of both suites.

    Tasks without a score in the paper do not count: of the method, or of any if it has none there.
    """
    runs: dict[tuple[str, Variant], dict[str, Mapping[str, list[float]]]] = defaultdict(dict)
    every = aggregates.by_experiment(results).items()
    for one, tasks in sorted(every, key=_largest_budget_first):  # keeps the smallest budget
        printed = aggregates.paper_tasks(one.suite, one.method) or aggregates.paper_tasks(one.suite)
        if common := {task: scores for task, scores in tasks.items() if task in printed}:
            runs[one.method, one.variant][one.suite] = common
    means = []
    for (method, preset), suites in runs.items():
        if not {"dmc", "metaworld"} <= suites.keys():
            continue
        pairs = [(suite, suites[suite]) for suite in ("dmc", "metaworld")]
        ours = [float(mean([np.array(runs) for runs in tasks.values()])) for _, tasks in pairs]
        papers = [aggregates.paper_aggregate(*pair, method, PAPER_BUDGET) for pair in pairs]
        theirs = [aggregate.mean for aggregate in papers if aggregate is not None]
        paper = float(np.mean(theirs)) if len(theirs) == len(pairs) else None
        means.append(BothSuites(method, preset, float(np.mean(ours)), paper))
    return means


def _largest_budget_first(item: tuple[Experiment, object]) -> int:
    return -item[0].frames
