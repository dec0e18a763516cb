"""The evidence of a record: a row per task with our scores and the paper's.

Runs with changed settings are excluded here; the table of every run has them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

import numpy as np

from wpt_agents.files.names import counted
from wpt_agents.zoo.numbers import interval_text, number
from wpt_agents.zoo.record_lines import Line
from wpt_agents.zoo.report.aggregates import PAPER_BUDGET, normalised, printed_scores
from wpt_agents.zoo.report.headline import suite_title
from wpt_agents.zoo.report.record import place
from wpt_agents.zoo.report.record_tables import OURS, column, usual_budgets
from wpt_agents.zoo.report.tables import markdown_table
from wpt_agents.zoo.result import Variant
from wpt_agents.zoo.statistics import bootstrap, mean

PAPER = {"dreamer-v3": "DreamerV3, paper", "drq-v2": "DrQ-v2, paper", "wpt": "WPT, paper"}
UNITS = {"dmc": "a tenth of the mean return", "metaworld": "the success rate in percent"}
# A task with a gap: the paper's baselines have at most LOW there, its WPT at least HIGH.
LOW = 40.0
HIGH = 70.0
GAP = (
    f"on which the paper's DreamerV3 and DrQ-v2 have at most {LOW:.0f} and its WPT at least "
    f"{HIGH:.0f}"
)


Columns = Mapping[str, Mapping[str, Mapping[int, float]]]  # column -> task -> seed -> percentage


@dataclass(frozen=True)
class Evidence:
    """The scores (0 to 100) of a suite's runs with an unchanged preset.

    :param frames: the usual budget; a column with another one has it in its name
    :param scores: column -> task -> seed -> score
    :param paper: method -> task -> the paper's score at 150,000 frames
    :param reached: the percentages of episodes with success at any step, of the runs for which the
        record has them
    """

    suite: str
    preset: Variant
    frames: int
    scores: Columns
    paper: Mapping[str, Mapping[str, float]]
    reached: Columns = field(default_factory=dict)

    @property
    def tasks(self) -> list[str]:
        """The tasks with a trained policy."""
        return sorted({task for tasks in self.scores.values() for task in tasks})

    @property
    def ours(self) -> str | None:
        """The method that the paper's mean is compared with."""
        return next((method for method in OURS if method in self.scores), None)

    @property
    def with_gap(self) -> list[str]:
        """The tasks with a trained policy on which the paper's WPT is far above its baselines."""
        baselines = [self.paper[method] for method in ("dreamer-v3", "drq-v2")]
        return [
            task
            for task in self.tasks
            if self.paper["wpt"].get(task, 0.0) >= HIGH
            and all(scores.get(task, 100.0) <= LOW for scores in baselines)
        ]

    def means(self, name: str) -> dict[str, float]:
        """Return the mean over seeds of each task of a column."""
        return seed_means(self.scores[name])


def seed_means(tasks: Mapping[str, Mapping[int, float]]) -> dict[str, float]:
    """Return the mean over seeds of each task."""
    return {task: fmean(seeds.values()) for task, seeds in tasks.items()}


def usual_lines(lines: Sequence[Line]) -> list[Line]:
    """Return the lines with an unchanged preset, for tasks with a trained policy."""
    budgets = usual_budgets(lines)
    presets = {suite: preset for suite, (_, preset) in budgets.items() if not preset.changes}
    usual = [
        line
        for line in lines
        if (preset := presets.get(line.suite)) and line.preset in (preset, preset.playing)
    ]
    trained = {line.task for line in usual if line.frames}
    return [line for line in usual if line.task in trained]


def evidence(lines: Sequence[Line]) -> list[Evidence]:
    """Return the evidence of each suite with runs of an unchanged preset."""
    budgets = usual_budgets(lines)
    shown: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
    for line in sorted(usual_lines(lines), key=_by_column):
        name = column(line, *budgets[line.suite])
        scores, reached = shown.setdefault(line.suite, ({}, {}))
        scores.setdefault(name, {}).setdefault(line.task, {})[line.seed] = line.score
        if line.success_any is not None:
            share = 100 * line.success_any
            reached.setdefault(name, {}).setdefault(line.task, {})[line.seed] = share
    return [
        Evidence(suite, budgets[suite][1], budgets[suite][0], scores, paper_scores(suite), reached)
        for suite, (scores, reached) in shown.items()
    ]


def _by_column(line: Line) -> tuple[str, int, str, int]:
    return line.suite, place(line.method), line.method, line.frames


def paper_scores(suite: str) -> dict[str, dict[str, float]]:
    """Return the paper's scores at 150,000 frames by method and task, 0 to 100."""
    metric = "return" if suite == "dmc" else "success"
    return {
        method: {
            task: 100 * normalised(score, metric)
            for task, score in printed_scores(suite, method, PAPER_BUDGET).items()
        }
        for method in PAPER
    }


def markdown(lines: Sequence[Line]) -> str:
    """Return a table for each suite, with a sentence about what it compares."""
    suites = evidence(lines)
    parts = [f"## {suite_title(one.suite)}\n\n{explanation(one)}\n{table(one)}" for one in suites]
    shown = {task for one in suites for task in one.tasks}
    if changed := sorted({line.task for line in lines if line.frames} - shown):
        parts.append(
            "Tasks that were only run with changed settings or another preset are listed under "
            f"[every run](#every-run) alone: {', '.join(changed)}.\n"
        )
    return "\n".join(parts)


def explanation(one: Evidence) -> str:
    """Return the explanation of a table's columns and its last row."""
    unit = UNITS.get(one.suite, " or ".join(UNITS.values()))
    published = any(task in scores for scores in one.paper.values() for task in one.tasks)
    text = (
        f"A score is {unit}, averaged over seeds; if there are several, their number is in "
        f"brackets. The column of a method shows its last policy after {one.frames:,} frames with "
        f"the unchanged preset `{one.preset}`. "
    )
    if published:
        text += f"The paper's columns are at {PAPER_BUDGET:,} frames. "
    if any(f"{name}, last" in one.scores for name in one.scores):
        text += (
            "If there is a column `METHOD, last`, that is the last policy, and the column `METHOD` "
            "shows the policy that did best in evaluations during training. "
        )
    text += (
        'The row "mean" averages each column over the tasks that have a score. In brackets are the '
        "number of these tasks and, from three tasks on, the 95 % interval by a bootstrap over "
        "tasks."
    )
    if published and one.ours is not None:
        text += f" In the paper's columns, only tasks with a score of `{one.ours}` count."
    if one.with_gap:
        text += f' The row "mean, with a gap" averages over the tasks {GAP}.'
    if one.reached:
        text += (
            " A score counts the episodes with success at the last step; the last row counts those "
            "with success at any step, where it was recorded."
        )
    return f"{text} Only means over the same tasks can be compared.\n"


def table(one: Evidence) -> str:
    """Return the table of a suite: the paper's columns, ours, and the rows of means."""
    columns: dict[str, list[str]] = {}
    compared = one.tasks if one.ours is None else list(one.scores[one.ours])
    for method, title in PAPER.items():
        theirs = {task: one.paper[method][task] for task in one.tasks if task in one.paper[method]}
        if theirs:
            shared = {task: theirs[task] for task in compared if task in theirs}
            cells = [number(theirs.get(task)) for task in one.tasks]
            columns[title] = [*cells, *mean_cells(one, shared), *(["-"] if one.reached else [])]
    for name, tasks in one.scores.items():
        cells = [seeds_cell(tasks.get(task, {})) for task in one.tasks]
        columns[name] = [*cells, *mean_cells(one, one.means(name))]
        if one.reached:
            columns[name].append(mean_cell([*seed_means(one.reached.get(name, {})).values()]))
    names = [*(task.removeprefix(f"{one.suite}-") for task in one.tasks), "**mean**"]
    names += ["**mean, with a gap**"] if one.with_gap else []
    names += ["**mean, success at any step**"] if one.reached else []
    return markdown_table(["task", *columns], zip(names, *columns.values(), strict=True))


def mean_cells(one: Evidence, scores: Mapping[str, float]) -> list[str]:
    """Return a column's mean over all tasks, and that over the tasks with a gap if there are any.

    :param scores: the column's score on each task
    """
    groups = [list(scores)] + ([one.with_gap] if one.with_gap else [])
    return [mean_cell([scores[task] for task in group if task in scores]) for group in groups]


def seeds_cell(seeds: Mapping[int, float]) -> str:
    """Write the mean over seeds: "62.5 (4)"."""
    if not seeds:
        return "-"
    return number(fmean(seeds.values())) + (f" ({len(seeds)})" if len(seeds) > 1 else "")


def mean_cell(scores: Sequence[float]) -> str:
    """Write the mean over tasks: "62.5 (50.0 to 75.0, 50 tasks)"."""
    if not scores:
        return "-"
    low, high = task_interval(scores)
    interval = "" if low is None else f"{interval_text(low, high)}, "
    return f"{number(fmean(scores))} ({interval}{counted(len(scores), 'task')})"


def task_interval(values: Sequence[float]) -> tuple[float | None, float | None]:
    """Return the 95 % bootstrap interval of a mean over tasks, None below three tasks."""
    if len(values) < 3:
        return None, None
    low, high = bootstrap(mean, [np.array(values)])
    return round(float(low), 6) + 0.0, round(float(high), 6) + 0.0  # no "-0.00"
