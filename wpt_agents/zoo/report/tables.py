"""Results -> tables: one run's policies, and many runs' means over seeds."""

import csv
import io
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Self

import numpy as np
from rich.markup import escape
from rich.table import Table

from wpt_agents.files.names import counted
from wpt_agents.zoo.report.aggregates import estimate, references, score_of
from wpt_agents.zoo.statistics import mean, mean_interval

POLICIES = {"nothing": "doing nothing", "random": "random policy"}  # as tables call them


@dataclass(frozen=True)
class Row:
    """One task and method over its seeds; a seed counts by its mean over episodes.

    :param low: lower end of the 95 % interval over seeds (Student's t), None with one seed
    :param paper: the paper's score of this method at 150,000 frames, where it gives one
    """

    task: str
    method: str
    preset: str
    frames: int
    seeds: int
    mean: float
    low: float | None
    high: float | None
    paper: float | None


def summarise(results: Iterable[Mapping[str, Any]]) -> list[Row]:
    """One row for each task, method, preset and budget."""
    groups: dict[tuple[str, str, str, int], list[float]] = defaultdict(list)
    for result in results:
        group = result["task"], result["method"], result["preset"], result["frames"]
        groups[group].append(score_of(result))
    paper = paper_scores()
    return [
        Row(*group, len(scores), *mean_interval(scores), paper.get(group[:2]))
        for group, scores in sorted(groups.items())
    ]


@dataclass(frozen=True)
class PolicyRow:
    """One policy on one task over its seeds, by return. Intervals are of 95 %.

    :param method: "" for a policy that no method has a part in
    :param means: of each seed, over its `episodes` episodes
    :param episodes_low: bootstrap of the episodes within each seed: were these seeds played again;
        None with one episode
    :param seeds_low: bootstrap of the seeds' means: were other seeds trained; None with one seed
    :param t_low: the same by Student's t, which is wider for few seeds
    :param success: share of episodes that end in success, None where the task counts none
    """

    task: str
    preset: str
    frames: int
    method: str
    policy: str
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
    def of(
        cls, group: tuple[str, str, int, str, str], runs: Mapping[int, Mapping[str, Any]]
    ) -> Self:
        """Builds the row from a policy's `scores` of each seed, each with its run's commit."""
        seeds = sorted(runs)
        returns = [np.array(runs[seed]["returns"], float) for seed in seeds]
        means = [float(each.mean()) for each in returns]
        rates = [runs[seed]["success_rate"] for seed in seeds]
        _, episodes_low, episodes_high = estimate(mean, returns)
        _, seeds_low, seeds_high = estimate(mean, [np.array(means)])
        middle, t_low, t_high = mean_interval(means)
        return cls(
            *group,
            episodes=min(map(len, returns)),
            seeds=tuple(seeds),
            means=tuple(means),
            mean=middle,
            episodes_low=episodes_low,
            episodes_high=episodes_high,
            seeds_low=seeds_low,
            seeds_high=seeds_high,
            t_low=t_low,
            t_high=t_high,
            success=None if None in rates else float(np.mean(rates)),
            commits=tuple(sorted({runs[seed]["commit"] or "unknown" for seed in seeds})),
        )


def policies(results: Iterable[Mapping[str, Any]]) -> list[PolicyRow]:
    """One row for each task, preset, budget and policy; the untrained policies come first."""
    groups: dict[tuple[str, str, int, str, str], dict[int, Mapping[str, Any]]] = defaultdict(dict)
    for result in results:
        about = result["task"], result["preset"], result["frames"]
        for policy, score in result["scores"].items():
            method = "" if policy in POLICIES else result["method"]
            commit = {"commit": result.get("commit")}
            groups[*about, method, policy][result["seed"]] = score | commit
    return [PolicyRow.of(*item) for item in sorted(groups.items(), key=_by_method)]


def _by_method(item: tuple[tuple[str, str, int, str, str], Any]) -> tuple[Any, ...]:
    """The order of rows; within a method as the run reports them."""
    (*about, method, policy), _ = item
    order = (*POLICIES, "prior actor", "WPT")
    return (*about, method, order.index(policy) if policy in order else len(order))


def paper_scores() -> dict[tuple[str, str], float]:
    """(task, method) -> the paper's score at 150,000 frames."""
    return {
        (row.task, row.method): row.score
        for row in references()
        if row.samples == 150_000 and row.score is not None
    }


def interval_text(low: float | None, high: float | None) -> str:
    """A 95 % interval in a table's cell."""
    return "-" if low is None or high is None else f"{number(low)} to {number(high)}"


def number(value: float | None) -> str:
    """A score with the digits that matter: 0.42, 7.3, 512."""
    if value is None:
        return "-"
    digits = 2 if abs(value) < 2 else 1 if abs(value) < 100 else 0
    return f"{value:.{digits}f}"


def scores_table(result: Mapping[str, Any]) -> Table:
    """The policies of one run side by side."""
    about = f"{result['task']}, {result['method']}, seed {result['seed']}"
    episodes = counted(len(result["scores"]["WPT"]["returns"]), "episode")
    caption = f"{episodes} each, after {result['frames']:,} frames of fine-tuning"
    table = Table(title=about, caption=caption)
    table.add_column("policy")
    for heading in ("mean return", "95 % interval", "lowest", "highest"):
        table.add_column(heading, justify="right")
    successes = result["metric"] == "success"
    if successes:
        table.add_column("success", justify="right")
    for name, score in result["scores"].items():
        cells = number(score["mean"]), interval_text(score["low"], score["high"])
        extremes = number(min(score["returns"])), number(max(score["returns"]))
        style = "bold" if name == "WPT" else None
        rate = [number(score["success_rate"])] if successes else []
        table.add_row(POLICIES.get(name, name), *cells, *extremes, *rate, style=style)
    return table


HEADINGS = ("task", "method", "preset", "frames", "seeds", "mean", "95 % interval", "paper at 150k")


def cells(row: Row) -> list[str]:
    """A row as text, in the order of HEADINGS."""
    frames, interval = f"{row.frames:,}", interval_text(row.low, row.high)
    about = [row.task, row.method, row.preset, frames, str(row.seeds)]
    return [*about, number(row.mean), interval, number(row.paper)]


def summary_table(rows: Sequence[Row]) -> Table:
    """The rows for a terminal."""
    table = Table(caption="mean over seeds; interval over seeds by Student's t")
    for heading in HEADINGS:
        words = heading in ("task", "method", "preset")
        table.add_column(heading, justify="left" if words else "right")
    for row in rows:
        table.add_row(*map(escape, cells(row)))  # a preset's name may hold brackets
    return table


def markdown(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    return markdown_table(HEADINGS, map(cells, rows))


def markdown_table(headings: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Text in columns, as Markdown."""
    every = [headings, ["---"] * len(headings), *lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in every)


POLICY_HEADINGS = (
    *("policy", "mean return of each seed", "mean"),
    *("95 %, episodes", "95 %, seeds", "95 %, seeds by t", "success at the last step"),
)


def policy_cells(row: PolicyRow) -> list[str]:
    """A row as text, in the order of POLICY_HEADINGS."""
    name = POLICIES.get(row.policy, row.policy)
    success = "-" if row.success is None else f"{row.success:.2f}"
    return [
        f"{name}, {row.method}" if row.method not in ("", "wpt") else name,
        ", ".join(map(number, row.means)),
        number(row.mean),
        interval_text(row.episodes_low, row.episodes_high),
        interval_text(row.seeds_low, row.seeds_high),
        interval_text(row.t_low, row.t_high),
        success,
    ]


def by_task(rows: Iterable[PolicyRow]) -> dict[str, list[PolicyRow]]:
    """The rows of each task, preset and budget, under a heading that names them."""
    tables: dict[str, list[PolicyRow]] = defaultdict(list)
    for row in rows:
        tables[f"{row.task}, preset {row.preset}, {row.frames:,} frames"].append(row)
    return dict(tables)


def policy_markdown(rows: Sequence[PolicyRow]) -> str:
    """A Markdown table for each task, seeds and commits under it."""
    parts = []
    for title, table in by_task(rows).items():
        seeds = sorted({seed for row in table for seed in row.seeds})
        commits = sorted({commit for row in table for commit in row.commits})
        episodes = min(row.episodes for row in table)
        about = f"Seeds {', '.join(map(str, seeds))}, {counted(episodes, 'episode')} each; "
        about += f"commit {', '.join(commits)}."
        lines = markdown_table(POLICY_HEADINGS, map(policy_cells, table))
        parts.append(f"### {title}\n\n{lines}\n{about}\n")
    return "\n".join(parts)


def policy_csv(rows: Sequence[PolicyRow]) -> str:
    """The rows as CSV, unrounded; seeds, their means and commits are separated by spaces."""
    file = io.StringIO()
    writer = csv.DictWriter(file, [field.name for field in fields(PolicyRow)], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        spaced = {k: " ".join(map(str, v)) for k, v in asdict(row).items() if isinstance(v, tuple)}
        writer.writerow(asdict(row) | spaced)
    return file.getvalue()
