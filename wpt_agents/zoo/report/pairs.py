"""Compare two policies of a record task by task: wins, mean difference, and sign test."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from wpt_agents.zoo.report.evidence import Evidence, evidence
from wpt_agents.zoo.report.numbers import interval_text, number
from wpt_agents.zoo.report.record import Line
from wpt_agents.zoo.report.tables import markdown_table
from wpt_agents.zoo.statistics import bootstrap, mean, sign_test

PAPER_WPT = "the paper's WPT"
PAIRS = (
    *(("wpt+", "prior actor"), ("wpt+", "scratch"), ("wpt+", "wpt"), ("wpt+", PAPER_WPT)),
    *(("wpt", "prior actor"), ("wpt", "scratch")),
)
EQUAL = 1e-6  # scores are rounded to two decimals, so means may differ by rounding errors


@dataclass(frozen=True)
class Pair:
    """The differences between two policies, in points, one for each common task.

    :param differences: the first policy's mean over the seeds that both have, minus the second's
    """

    suite: str
    first: str
    second: str
    differences: tuple[float, ...]

    @property
    def above(self) -> int:
        """The number of tasks on which the first policy has the higher score."""
        return sum(difference > EQUAL for difference in self.differences)

    @property
    def below(self) -> int:
        """The number of tasks on which the first policy has the lower score."""
        return sum(difference < -EQUAL for difference in self.differences)

    @property
    def interval(self) -> tuple[float | None, float | None]:
        """The 95 % bootstrap interval of the mean difference over tasks, None below three tasks."""
        if len(self.differences) < 3:
            return None, None
        low, high = bootstrap(mean, [np.array(self.differences)])
        return round(float(low), 6) + 0.0, round(float(high), 6) + 0.0  # no "-0.00"

    @property
    def cells(self) -> list[str]:
        """The row of a table, in the order of `HEADINGS`."""
        n = len(self.differences)
        counts = [n, self.above, n - self.above - self.below, self.below]
        middle = f"{number(fmean(self.differences))} ({interval_text(*self.interval)})"
        p = f"{sign_test(self.above, self.below):.2g}"
        return [self.suite, self.first, self.second, *map(str, counts), middle, p]


HEADINGS = (
    *("suite", "policy", "against", "tasks", "above", "equal", "below"),
    *("mean difference (95 %, bootstrap over tasks)", "p, sign test"),
)


def pairs(lines: Sequence[Line]) -> list[Pair]:
    """Return the comparisons that the record has a task for, on each suite and on all together."""
    suites = evidence(lines)
    compared = []
    for first, second in PAIRS:
        by_suite = [pair for one in suites if (pair := compare(one, first, second))]
        compared += by_suite
        if len(by_suite) > 1:
            every = tuple(d for pair in by_suite for d in pair.differences)
            compared.append(Pair("all", first, second, every))
    return compared


def compare(one: Evidence, first: str, second: str) -> Pair | None:
    """Compare two policies on a suite, None if no task has both."""
    ours = last_scores(one, first)
    if second == PAPER_WPT:
        theirs = one.paper["wpt"]
        differences = [fmean(ours[task].values()) - theirs[task] for task in ours if task in theirs]
    else:
        others = last_scores(one, second)
        common = {task: ours[task].keys() & others[task].keys() for task in ours if task in others}
        differences = [
            fmean(ours[task][seed] - others[task][seed] for seed in seeds)
            for task, seeds in common.items()
            if seeds
        ]
    return Pair(one.suite, first, second, tuple(differences)) if differences else None


def last_scores(one: Evidence, method: str) -> dict[str, Mapping[int, float]]:
    """Return task -> seed -> score of the last policies.

    In a record, the final policy has the name of the method. It is the last policy, unless the run
    kept the best one; then the last one is named "METHOD, last".
    """
    last = one.scores.get(f"{method}, last", {})
    return {
        task: {**seeds, **last.get(task, {})} for task, seeds in one.scores.get(method, {}).items()
    }


def markdown(lines: Sequence[Line]) -> str:
    """Return the comparisons as a table, "" if there are none."""
    rows = [pair.cells for pair in pairs(lines)]
    if not rows:
        return ""
    return (
        "## Pairs\n\n"
        "Only last policies with the unchanged preset and the usual budget are compared, on each "
        "task by the mean over the seeds that both have; the paper gives means alone. The prior "
        "actor is the one in the record, which another method may have cloned. Every task counts "
        "the same. The interval says how much other tasks would change the mean, not other seeds; "
        f"the sign test leaves out equal tasks.\n\n{markdown_table(HEADINGS, rows)}"
    )
