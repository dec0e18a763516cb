"""Results as tables: the policies of one run, and the means of many runs over their seeds."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from rich.markup import escape
from rich.table import Table

from wpt_agents.files.names import counted
from wpt_agents.zoo.numbers import POSSIBLE, RULE, Range, interval_text, number, seeds_text
from wpt_agents.zoo.record_lines import csv_of
from wpt_agents.zoo.report.aggregates import PAPER_BUDGET, estimate, references
from wpt_agents.zoo.report.names import policy_name, policy_title
from wpt_agents.zoo.result import POLICIES, UNTRAINED, Result, Variant
from wpt_agents.zoo.statistics import mean, mean_interval


@dataclass(frozen=True)
class Row:
    """One task and method over its seeds.

    :param scores: of each seed, the mean return of its episodes or their success rate
    :param low: lower end of the 95 % interval over seeds (Student's t), None below three seeds
    :param possible: the range of the scores
    :param paper: the paper's score of this method at 150,000 frames, if there is one
    """

    task: str
    method: str
    preset: Variant
    frames: int
    scores: tuple[float, ...]
    mean: float
    low: float | None
    high: float | None
    possible: Range
    paper: float | None


def summarise(results: Iterable[Result]) -> list[Row]:
    """Return one row for each task, method, variant and budget."""
    groups: dict[tuple[str, str, Variant, int], list[Result]] = defaultdict(list)
    for result in sorted(results, key=lambda result: result.seed):
        groups[result.identity[:-1]].append(result)
    paper = paper_scores()
    rows = []
    for group, runs in sorted(groups.items(), key=lambda item: item[0]):
        scores = tuple(run.counted() for run in runs)
        possible = POSSIBLE[runs[0].metric]
        rows.append(Row(*group, scores, *mean_interval(scores), possible, paper.get(group[:2])))
    return rows


@dataclass(frozen=True)
class PolicyRow:
    """The returns of one policy on one task over its seeds, with 95 % intervals.

    :param method: "" for an untrained policy
    :param policy: one of `result.POLICIES`
    :param name: its name in tables
    :param final: whether it is the final policy of its runs
    :param means: the mean of each seed over its `episodes` episodes
    :param episodes_low: by a bootstrap of the episodes within each seed, as if these seeds were
        played again; None for two or fewer episodes of one seed
    :param seeds_low: by a bootstrap of the seeds' means, as if other seeds were trained; None for
        two or fewer seeds
    :param t_low: the same by Student's t, which is wider for few seeds
    :param success: the share of successful episodes, None if the task reports none
    """

    task: str
    preset: Variant
    frames: int
    method: str
    policy: str
    name: str
    final: bool
    episodes: int
    seeds: tuple[int, ...]
    means: tuple[float, ...]
    mean: float
    episodes_low: float | None
    episodes_high: float | None
    seeds_low: float | None
    seeds_high: float | None
    t_low: float | None
    t_high: float | None
    success: float | None
    commits: tuple[str, ...]

    @classmethod
    def of(cls, policy: str, runs: Sequence[Result]) -> Self:
        """Build the row of a policy from the runs of its method, one for each seed."""
        runs = sorted(runs, key=lambda run: run.seed)
        first = runs[0]
        scores = [run.scores[policy] for run in runs]
        returns = [np.array(score.returns, float) for score in scores]
        means = [score.mean for score in scores]
        rates = [score.success_rate for score in scores if score.success_rate is not None]
        _, episodes_low, episodes_high = estimate(mean, returns)
        _, seeds_low, seeds_high = estimate(mean, [np.array(means)])
        middle, t_low, t_high = mean_interval(means)
        return cls(
            task=first.task,
            preset=first.variant,
            frames=first.frames,
            method="" if policy in UNTRAINED else first.method,
            policy=policy,
            name=policy_name(first, policy),
            final=policy == first.final_policy,
            episodes=min(map(len, returns)),
            seeds=tuple(run.seed for run in runs),
            means=tuple(means),
            mean=middle,
            episodes_low=episodes_low,
            episodes_high=episodes_high,
            seeds_low=seeds_low,
            seeds_high=seeds_high,
            t_low=t_low,
            t_high=t_high,
            success=float(np.mean(rates)) if len(rates) == len(scores) else None,
            commits=tuple(sorted({run.commit_name for run in runs})),
        )


def policies(results: Iterable[Result]) -> list[PolicyRow]:
    """Return one row for each task, variant, budget and policy; the untrained ones come first."""
    groups: dict[tuple[str, Variant, int, str, str], dict[int, Result]] = defaultdict(dict)
    for result in results:
        for policy in result.scores:
            method = "" if policy in UNTRAINED else result.method
            group = result.task, result.variant, result.frames, method, policy
            groups[group][result.seed] = result  # untrained policies are the same for all methods
    rows = [PolicyRow.of(group[-1], list(runs.values())) for group, runs in groups.items()]
    return sorted(rows, key=_by_method)


def _by_method(row: PolicyRow) -> tuple[str, Variant, int, str, int]:
    """Sort rows by method; within a method as the run reports them."""
    place = POLICIES.index(row.policy) if row.policy in POLICIES else len(POLICIES)
    return row.task, row.preset, row.frames, row.method, place


def paper_scores() -> dict[tuple[str, str], float]:
    """Return the paper's scores at 150,000 frames by task and method."""
    return {
        (row.task, row.method): row.score
        for row in references()
        if row.samples == PAPER_BUDGET and row.score is not None
    }


def scores_table(result: Result) -> Table:
    """Return a table of the policies of one run."""
    episodes = counted(len(result.final.returns), "episode")
    caption = (
        f"{episodes} each, after {result.frames:,} frames of fine-tuning; "
        "intervals over episodes by Student's t"
    )
    title = f"{result.task}, {result.method}, seed {result.seed}"
    table = Table(title=title, caption=caption)
    table.add_column("policy")
    headings = ["mean return", "95 % interval", "lowest", "highest"]
    if result.metric == "success":
        headings += ["success", "at any step"]
    for heading in headings:
        table.add_column(heading, justify="right")
    for policy, score in result.scores.items():
        mean, low, high = score.interval
        cells = [number(mean), interval_text(low, high)]
        cells += [number(min(score.returns)), number(max(score.returns))]
        if result.metric == "success":
            cells += [number(score.success_rate), number(score.success_rate_any)]
        style = "bold" if policy == result.final_policy else None
        table.add_row(policy_title(policy_name(result, policy)), *cells, style=style)
    return table


HEADINGS = (
    *("task", "method", "preset", "frames", "seeds", "mean"),
    *("95 % interval or both seeds", "paper at 150k"),
)
NOTE = (
    "A mean is over the mean returns of the seeds' evaluation episodes or, on tasks that count "
    f"successes, over their success rates. {RULE}"
)


def cells(row: Row) -> list[str]:
    """Write a row as text, in the order of HEADINGS."""
    names = [row.task, row.method, str(row.preset), f"{row.frames:,}", str(len(row.scores))]
    spread = seeds_text(row.scores, row.low, row.high, row.possible)
    return [*names, number(row.mean), spread, number(row.paper)]


def summary_table(rows: Sequence[Row]) -> Table:
    """Return the rows as a table for a terminal."""
    table = Table(caption=NOTE)
    for heading in HEADINGS:
        words = heading in ("task", "method", "preset")
        title = heading.replace(" or", "\nor")
        table.add_column(title, justify="left" if words else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, cells(row)))  # a preset's name may contain brackets
    return table


def markdown(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table with its explanation."""
    return f"{markdown_table(HEADINGS, map(cells, rows))}\n{NOTE}\n"


def markdown_table(headings: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    every = [headings, ["---"] * len(headings), *lines]
    escaped = ([cell.replace("|", "\\|") for cell in line] for line in every)
    return "".join(f"| {' | '.join(line)} |\n" for line in escaped)


POLICY_HEADINGS = (
    *("policy", "mean return", "mean return of each seed"),
    *("95 % over episodes", "95 % over seeds", "success rate"),
)
POLICY_NOTE = (
    "The first 95 % interval is a bootstrap of each seed's episodes: how much other episodes of "
    "these seeds would change the mean. The second is over the seeds by Student's t, from three "
    "seeds on: how much other seeds would change it. A success counts if it lasts until the last "
    "step of the episode."
)


def policy_cells(row: PolicyRow) -> list[str]:
    """Write a row as text, in the order of POLICY_HEADINGS."""
    return [
        policy_title(row.name),
        number(row.mean),
        ", ".join(map(number, row.means)),
        interval_text(row.episodes_low, row.episodes_high),
        interval_text(row.t_low, row.t_high),
        "-" if row.success is None else f"{row.success:.2f}",
    ]


def by_task(rows: Iterable[PolicyRow]) -> Mapping[str, Sequence[PolicyRow]]:
    """Group the rows by task, variant and budget, under a heading that names them."""
    tables: dict[str, list[PolicyRow]] = defaultdict(list)
    for row in rows:
        tables[f"{row.task}, preset {row.preset}, {row.frames:,} frames"].append(row)
    return dict(tables)


def policy_markdown(rows: Sequence[PolicyRow]) -> str:
    """Return a Markdown table for each task, with seeds and commits under it, and a note."""
    parts = []
    for title, table in by_task(rows).items():
        lines = markdown_table(POLICY_HEADINGS, map(policy_cells, table))
        parts.append(f"### {title}\n\n{lines}\n{policy_note(table)}\n")
    return "\n".join([*parts, f"{POLICY_NOTE}\n"])


def policy_note(rows: Sequence[PolicyRow]) -> str:
    """Return the seeds, episodes and commits of a table, of each policy if they differ."""
    notes: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        seeds = ", ".join(map(str, row.seeds))
        commits = ", ".join(row.commits)
        noun = "seed" if len(row.seeds) == 1 else "seeds"
        episodes = counted(row.episodes, "episode")
        note = f"{noun} {seeds}; {episodes} per seed; commit {commits}."
        notes[note].append(policy_title(row.name))
    if len(notes) == 1:
        return next(iter(notes)).replace("s", "S", 1)
    return " ".join(f"{', '.join(names)}: {note}" for note, names in notes.items())


def policy_csv(rows: Sequence[PolicyRow]) -> str:
    """Return the rows as CSV, unrounded; seeds, their means and commits are separated by spaces."""
    return csv_of(PolicyRow, rows)
