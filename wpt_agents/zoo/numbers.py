"""Numbers and their 95 % intervals as text, the same on the page, in Markdown and on a terminal."""

from collections import Counter
from collections.abc import Collection, Sequence
from math import inf

from wpt_agents.files.names import counted
from wpt_agents.zoo.result import Metric, Result

Range = tuple[float, float]
ANY: Range = (-inf, inf)  # of returns: those of the tasks named "hard" can be negative
PERCENT: Range = (0.0, 100.0)  # of success rates in a record
POSSIBLE: dict[Metric, Range] = {"return": ANY, "success": (0.0, 1.0)}

# What tables with intervals over seeds say about them, everywhere in the same words.
RULE = (
    "An interval over the seeds of a task is a 95 % interval by Student's t and needs at least "
    "three seeds; with two, both values are shown instead. An end marked * is cut off at 0 or 1, "
    "the limits of a success rate."
)


def number(value: float | None) -> str:
    """Format a score with its significant digits: 0.42, 7.3, 512."""
    if value is None:
        return "-"
    digits = 2 if abs(value) < 2 else 1 if abs(value) < 100 else 0
    return f"{value:.{digits}f}"


def interval_text(low: float | None, high: float | None, possible: Range = ANY) -> str:
    """Format a 95 % interval for a table's cell; "0.42 to 1.00*" was cut off at the upper end."""
    if low is None or high is None:
        return "-"
    least, most = possible
    lower = number(low) if low >= least else f"{number(least)}*"
    upper = number(high) if high <= most else f"{number(most)}*"
    return f"{lower} to {upper}"


def seeds_text(
    values: Sequence[float], low: float | None, high: float | None, possible: Range = ANY
) -> str:
    """Format the interval over the seeds of a task; the values of two seeds take its place."""
    if len(values) == 1:
        return "one seed"
    if low is None:
        return " and ".join(map(number, values))
    return interval_text(low, high, possible)


def span(counts: Collection[int], noun: str) -> str:
    """Return numbers with their noun: '1 seed', '2 seeds', '1 to 3 seeds'."""
    low = min(counts)
    high = max(counts)
    return counted(low, noun) if low == high else f"{low:,} to {counted(high, noun)}"


def evidence_text(results: Sequence[Result]) -> str:
    """Return from how many seeds and episodes the scores of results are."""
    seeds = Counter(result.identity[:-1] for result in results)
    episodes = {len(result.final.returns) for result in results}
    return (
        f"{span(seeds.values(), 'seed')} per task and method, "
        f"{span(episodes, 'evaluation episode')} per seed"
    )
