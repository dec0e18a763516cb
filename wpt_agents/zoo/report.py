"""Run folders -> tables: one run's policies, and many runs' means over seeds."""

import csv
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from wpt_agents.zoo.evaluation import mean_interval
from wpt_agents.zoo.presets import preset_folder


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


def read_results(folder: Path) -> list[dict[str, Any]]:
    """Every finished run below `folder`, in the order of their paths."""
    return [json.loads(path.read_text()) for path in sorted(folder.glob("**/result.json"))]


def summarise(results: Iterable[Mapping[str, Any]]) -> list[Row]:
    """One row for each task, method, preset and budget."""
    groups: dict[tuple[str, str, str, int], list[float]] = defaultdict(list)
    for result in results:
        group = result["task"], result["method"], result["preset"], result["frames"]
        groups[group].append(_score(result))
    paper = paper_scores()
    return [
        Row(*group, len(scores), *mean_interval(scores), paper.get(group[:2]))
        for group, scores in sorted(groups.items())
    ]


def _score(result: Mapping[str, Any]) -> float:
    score = result["scores"]["WPT"]
    return score["success_rate"] if result["metric"] == "success" else score["mean"]


def paper_scores() -> dict[tuple[str, str], float]:
    """(task, method) -> the paper's score at 150,000 frames."""
    scores = {}
    for path in sorted((preset_folder() / "references").glob("table*.csv")):
        with open(path, newline="") as file:
            for row in csv.DictReader(file):
                if row["samples"] == "150000" and row["score"]:
                    scores[row["task"], row["method"]] = float(row["score"])
    return scores


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
    episodes = len(result["scores"]["WPT"]["returns"])
    caption = f"{episodes} episodes each, after {result['frames']:,} frames of fine-tuning"
    table = Table(title=about, caption=caption)
    table.add_column("policy")
    for heading in ("mean return", "95 % interval", "lowest", "highest"):
        table.add_column(heading, justify="right")
    successes = result["metric"] == "success"
    if successes:
        table.add_column("success", justify="right")
    names = {"nothing": "doing nothing", "random": "random policy"}
    for name, score in result["scores"].items():
        cells = number(score["mean"]), interval_text(score["low"], score["high"])
        extremes = number(min(score["returns"])), number(max(score["returns"]))
        style = "bold" if name == "WPT" else None
        rate = [number(score["success_rate"])] if successes else []
        table.add_row(names.get(name, name), *cells, *extremes, *rate, style=style)
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
        table.add_row(*cells(row))
    return table


def markdown(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    lines = [HEADINGS, ["---"] * len(HEADINGS), *map(cells, rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
