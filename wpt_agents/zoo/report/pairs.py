"""Compare two policies of a record task by task: wins, mean difference, and sign test."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

from wpt_agents.zoo.numbers import interval_text, number
from wpt_agents.zoo.record_lines import Line
from wpt_agents.zoo.report.evidence import GAP, Evidence, evidence, task_interval
from wpt_agents.zoo.report.names import MEANINGS, is_added
from wpt_agents.zoo.report.tables import markdown_table
from wpt_agents.zoo.result import PRIOR_ACTOR
from wpt_agents.zoo.statistics import sign_test

PAPER_WPT = "the paper's WPT"
PAIRS = (
    *(("wpt+", PRIOR_ACTOR), ("wpt+", "scratch"), ("wpt+", "scratch, 3x frames"), ("wpt+", "wpt")),
    *(("wpt+", "drq-v2"), ("wpt+", "jsrl-bc"), ("wpt+", PAPER_WPT)),
    *(("wpt", PRIOR_ACTOR), ("wpt", "scratch")),
    *(("wpt", "no-guidance"), ("no-guidance", "pretrain-only")),
)
EQUAL = 1e-6  # scores are rounded to two decimals, so means may differ by rounding errors
ROOM = 80.0  # a prior actor below it leaves room for improvement


@dataclass(frozen=True)
class Pair:
    """Two policies on their common tasks.

    :param where: the suite, or "all", and the kind of tasks
    :param scores: of the two policies, for each task; means over the seeds that both have
    """

    where: str
    first: str
    second: str
    scores: tuple[tuple[float, float], ...]

    @property
    def differences(self) -> list[float]:
        """The first policy's score minus the second's, in points, for each task."""
        return [round(ours - theirs, 6) + 0.0 for ours, theirs in self.scores]  # no "-0.00"

    @property
    def above(self) -> int:
        """The number of tasks on which the first policy has the higher score."""
        return sum(difference > EQUAL for difference in self.differences)

    @property
    def below(self) -> int:
        """The number of tasks on which the first policy has the lower score."""
        return sum(difference < -EQUAL for difference in self.differences)

    @property
    def cells(self) -> list[str]:
        """The row of a table, in the order of `HEADINGS`."""
        n = len(self.scores)
        ours, theirs = map(list, zip(*self.scores, strict=True))
        counts = [n, self.above, n - self.above - self.below, self.below]
        return [
            *(self.where, self.first, with_interval(ours), self.second, with_interval(theirs)),
            *(*map(str, counts), with_interval(self.differences)),
            *(number(min(self.differences)), f"{sign_test(self.above, self.below):.2g}"),
        ]


HEADINGS = (
    *("tasks", "policy", "mean (95 %)", "against", "mean (95 %)"),
    *("number", "above", "equal", "below", "mean difference (95 %)", "smallest", "p, sign test"),
)
NOTE = (
    "This table compares two policies over the tasks that both have. Only last policies with the "
    "unchanged preset and the usual budget are compared. The score of a task is the mean over the "
    "seeds that both policies have, or the paper's published mean. The prior actor is the one in "
    "the record, which another method may have cloned. All tasks have the same weight. The "
    "intervals are bootstraps over tasks, from three tasks on: they show how much other tasks "
    'would change a mean, not how much other seeds would. "Smallest" is the smallest difference on '
    "a task. The sign test leaves out tasks with equal scores."
)


def with_interval(values: Sequence[float]) -> str:
    """Write a mean over tasks with its 95 % interval: "9.2 (-5.0 to 30.0)"."""
    return f"{number(fmean(values))} ({interval_text(*task_interval(values))})"


def pairs(lines: Sequence[Line]) -> list[Pair]:
    """Return the comparisons that the record has a task for, on each suite and on all together.

    Each is made for all common tasks, for those with a gap in the paper, and against the prior
    actor for those on which it is below `ROOM`.
    """
    suites = evidence(lines)
    compared = []
    for first, second in (*PAIRS, *_pairs_of_added(suites)):
        by_suite = [pair for one in suites for pair in comparisons(one, first, second)]
        compared += by_suite
        for kind in dict.fromkeys(kind_of(pair) for pair in by_suite):
            same = [pair for pair in by_suite if kind_of(pair) == kind]
            if len(same) > 1:
                every = tuple(scores for pair in same for scores in pair.scores)
                compared.append(Pair(f"all{kind}", first, second, every))
    return compared


def _pairs_of_added(suites: Sequence[Evidence]) -> list[tuple[str, str]]:
    """Return each method that was added to the zoo with every other method and the prior actor."""
    names = list(dict.fromkeys(name for one in suites for name in one.scores))
    added = [name for name in names if is_added(name)]
    others = [name for name in names if name in (PRIOR_ACTOR, *MEANINGS)]
    return [(name, other) for i, name in enumerate(added) for other in (*others, *added[i + 1 :])]


def kind_of(pair: Pair) -> str:
    """Return the kind of tasks in `where`: ", with a gap", or "" for all tasks."""
    _, comma, kind = pair.where.partition(",")
    return comma + kind


def comparisons(one: Evidence, first: str, second: str) -> Iterable[Pair]:
    """Yield the comparisons of two policies on a suite for the kinds of tasks that they have."""
    common = compare(one, first, second)
    kinds = {"": list(common)}
    if second != PAPER_WPT:
        kinds[", with a gap"] = [task for task in one.with_gap if task in common]
    if second == PRIOR_ACTOR:
        low = [task for task, (_, clone) in common.items() if clone < ROOM]
        kinds[f", {second} below {ROOM:.0f}"] = low
    for kind, tasks in kinds.items():
        if tasks:
            scores = tuple(common[task] for task in tasks)
            yield Pair(f"{one.suite}{kind}", first, second, scores)


def compare(one: Evidence, first: str, second: str) -> dict[str, tuple[float, float]]:
    """Return the scores of two policies of a suite on each task that has both."""
    ours = last_scores(one, first)
    if second == PAPER_WPT:
        theirs = one.paper["wpt"]
        return {task: (fmean(ours[task].values()), theirs[task]) for task in ours if task in theirs}
    others = last_scores(one, second)
    common = {task: ours[task].keys() & others[task].keys() for task in ours if task in others}
    return {
        task: (fmean(ours[task][s] for s in seeds), fmean(others[task][s] for s in seeds))
        for task, seeds in common.items()
        if seeds
    }


def last_scores(one: Evidence, name: str) -> dict[str, dict[int, float]]:
    """Return task -> seed -> score of the last policies of a method, such as "scratch, 3x frames".

    In a record, the final policy has the name of the method. It is the last policy, unless the run
    kept the best one; then the last one is named "METHOD, last".
    """
    method, comma, budget = name.partition(",")
    last = one.scores.get(f"{method}, last{comma}{budget}", {})
    return {
        task: {**seeds, **last.get(task, {})} for task, seeds in one.scores.get(name, {}).items()
    }


def markdown(lines: Sequence[Line]) -> str:
    """Return the comparisons as a table, "" if there are none."""
    compared = pairs(lines)
    if not compared:
        return ""
    note = NOTE
    kinds = {kind_of(pair) for pair in compared}
    if ", with a gap" in kinds:
        note += f' "With a gap" are the tasks {GAP}.'
    if kinds - {"", ", with a gap"}:
        below = f"{PRIOR_ACTOR.capitalize()} below {ROOM:.0f}"
        note += (
            f' "{below}" are the tasks on which its score is lower. The same episodes choose these '
            "tasks and are compared, so chance makes the prior actor look worse there than it is."
        )
    return f"## Pairs\n\n{note}\n\n{markdown_table(HEADINGS, [pair.cells for pair in compared])}"
