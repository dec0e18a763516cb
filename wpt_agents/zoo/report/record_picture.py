"""A record as a picture: a panel per task, or a row per task if there are many.

Both exclude runs with changed settings if there are others, and show the paper's WPT as a hollow
marker. A panel also has the methods whose only runs on its task have changed settings, with these
in their names. The colours are Okabe and Ito's colour-blind safe ones.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wpt_agents.files.archive import replacing
from wpt_agents.zoo.pictures.style import plt
from wpt_agents.zoo.record_lines import Line
from wpt_agents.zoo.report.aggregates import PAPER_BUDGET
from wpt_agents.zoo.report.evidence import Evidence, evidence, paper_scores, usual_lines
from wpt_agents.zoo.report.headline import suite_title
from wpt_agents.zoo.report.record import order
from wpt_agents.zoo.report.record_tables import Cell, Key, by_task
from wpt_agents.zoo.result import HEAD_START, IMITATION, LAST, NOTHING

PANELS = 8  # up to this number of tasks each has a panel


class Style(NamedTuple):
    """The style of a method, the same in every picture."""

    colour: str
    marker: str


STYLES = {
    "random": Style("#888888", "x"),
    "prior actor": Style("#009e73", "s"),
    "scratch": Style("#cc79a7", "v"),
    "wpt": Style("#0072b2", "o"),
    "wpt+": Style("#d55e00", "D"),
    "kickstart": Style("#e69f00", "^"),
}
OTHERS = (  # for the other methods, in turn
    *(Style("#56b4e9", "P"), Style("#000000", "*"), Style("#56b4e9", "<")),
    *(Style("#000000", ">"), Style("#56b4e9", "X"), Style("#000000", "p")),
)
GREY = Style("#777777", "o")  # for the other methods in panels, whose rows have names
PAPER: dict[str, Any] = {
    "marker": "D",
    "ms": 9,
    "mfc": "none",
    "mec": "black",
    "mew": 1.1,
    "ls": "none",
}
PAPER_NAME = f"the paper's WPT,\n{PAPER_BUDGET:,} frames"


def least(scores: Iterable[float], usual: float) -> float:
    """Return the lower end of an axis: `usual`, or less on the hard tasks, whose effort costs."""
    return min(usual, min(scores, default=0.0) + usual)


def draw(path: Path, lines: Sequence[Line]) -> None:
    """Draw the record with as much detail as its number of tasks allows."""
    usual = usual_lines(lines)
    if len({line.task for line in usual}) > PANELS:
        figure = draw_rows(evidence(usual))
    else:
        figure = draw_panels(with_only_changed(usual, lines) if usual else lines)
    save(figure, path)


def with_only_changed(usual: Sequence[Line], lines: Iterable[Line]) -> list[Line]:
    """Add the lines with changed settings of methods that have no line in `usual` on a task.

    A method with several such settings on a task is left out; the tables compare them.
    """
    tasks = {line.task for line in usual}
    shown = {(line.task, line.method) for line in usual}
    changed: dict[tuple[str, str], list[Line]] = defaultdict(list)
    for line in lines:
        if line.task in tasks and (line.task, line.method) not in shown:
            changed[line.task, line.method].append(line)
    alike = [
        line
        for same in changed.values()
        if len({(line.preset, line.frames) for line in same}) == 1
        for line in same
    ]
    return sorted([*usual, *alike], key=order)


def save(figure: Figure, path: Path) -> None:
    """Write a figure atomically, and close it."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    plt.close(figure)


def legend_of(figure: Figure) -> dict[str, Any]:
    """Return what a legend of all panels shows: each label once, with its line or marker."""
    return {
        label: handle
        for panel in figure.axes
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }


def draw_rows(suites: Sequence[Evidence]) -> Figure:
    """Draw a row for each task with the mean of each method, suites below each other."""
    tasks = [len(one.tasks) for one in suites]
    figure, axes = plt.subplots(
        *(len(suites), 1),
        figsize=(8, 0.27 * sum(tasks) + 0.7 * len(suites) + 0.9),
        height_ratios=tasks,
        squeeze=False,
        layout="constrained",
    )
    names = dict.fromkeys(name for one in suites for name in one.scores if drawn(name))
    styles = styles_of(names)
    for panel, one in zip(axes.flat, suites, strict=True):
        _draw_suite(panel, one, styles)
    legend = legend_of(figure)
    figure.legend(
        legend.values(), legend.keys(), loc="outside upper center", ncols=min(4, len(legend))
    )
    axes.flat[-1].set_xlabel("score, 0 to 100: the mean over seeds, a line from lowest to highest")
    return figure


def styles_of(names: Collection[str]) -> dict[str, Style]:
    """Return a style for each method."""
    others = iter(OTHERS * len(names))
    return {name: STYLES.get(name) or next(others) for name in names}


def drawn(method: str) -> bool:
    """Return whether a method is shown in rows of tasks; the tables show all methods."""
    between = {HEAD_START, IMITATION, LAST}
    return method != NOTHING and not between & set(method.split(", "))


def _draw_suite(panel: Axes, one: Evidence, styles: dict[str, Style]) -> None:
    rows = {task: row for row, task in enumerate(one.tasks)}
    for row in range(0, len(rows), 2):
        panel.axhspan(row - 0.5, row + 0.5, color="#f2f2f2", lw=0, zorder=0)
    names = [name for name in styles if name in one.scores]
    offsets = np.linspace(-0.32, 0.32, len(names) + 2)[1:-1]  # so that equal scores stay visible
    for name, offset in zip(names, offsets, strict=True):
        colour, marker = styles[name]
        at = [rows[task] + offset for task in one.scores[name]]
        seeds = [list(scores.values()) for scores in one.scores[name].values()]
        panel.hlines(at, list(map(min, seeds)), list(map(max, seeds)), color=colour, lw=1)
        means = list(map(np.mean, seeds))
        panel.plot(means, at, marker, color=colour, ms=5, label=name, clip_on=False)
    theirs = {task: score for task, score in one.paper["wpt"].items() if task in rows}
    if theirs:
        at = [rows[task] for task in theirs]
        label = PAPER_NAME.replace("\n", " ")
        panel.plot(list(theirs.values()), at, label=label, clip_on=False, **PAPER)
    panel.set_yticks(range(len(rows)), [task.removeprefix(f"{one.suite}-") for task in rows])
    panel.tick_params("y", labelsize=8.5, length=0)
    every = (one.scores[name][task].values() for name in names for task in one.scores[name])
    panel.set(xlim=(least(chain(*every), -3), 103), ylim=(len(rows) - 0.5, -0.5))
    panel.set_title(suite_title(one.suite), fontsize=10)
    panel.grid(axis="x", lw=0.4)
    panel.spines[["top", "right", "left"]].set_visible(False)


def draw_panels(lines: Sequence[Line]) -> Figure:
    """Draw a panel for each task: the seeds of each method as dots, their mean as a stroke."""
    tasks = {name: panel_rows(*name, cells) for name, cells in by_task(lines).items()}
    columns = min(4, len(tasks))
    lengths = [sum(row.height for row in rows) for rows in tasks.values()]
    heights = [max(lengths[i : i + columns]) for i in range(0, len(lengths), columns)]
    figure, panels = plt.subplots(
        *(len(heights), columns),
        figsize=(3.5 * columns, 0.17 * sum(heights) + 0.6 * len(heights) + 0.5),
        height_ratios=heights,
        squeeze=False,
        layout="constrained",
    )
    for panel, ((suite, task), rows) in zip(panels.flat, tasks.items(), strict=False):
        _draw_panel(panel, task.removeprefix(f"{suite}-"), rows)
    for panel in panels.flat[len(tasks) :]:
        panel.remove()
    explained = ["a dot per seed, a stroke at their mean"]
    if any(row.style is None for rows in tasks.values() for row in rows):
        explained.append("hollow: the paper's")
    space = "; " if columns > 1 else ";\n"  # a single panel is narrow
    figure.supxlabel(f"score, 0 to 100\n{space.join(explained)}", fontsize=9)
    return figure


class PanelRow(NamedTuple):
    """A method's scores in a panel."""

    label: str
    scores: Sequence[float]
    style: Style | None

    @property
    def height(self) -> float:
        """The lines of text that the row takes: those of its label, half a line between rows."""
        return self.label.count("\n") + 1.5


def panel_rows(suite: str, task: str, cells: Mapping[Key, Cell]) -> list[PanelRow]:
    """Return the rows of a task's panel, the paper's WPT at the end."""
    shown = {key: cell for key, cell in cells.items() if not key.method.endswith(", last")}
    rows = [
        PanelRow(label, cell.scores, STYLES.get(key.method, GREY))
        for label, (key, cell) in zip(row_names(shown), shown.items(), strict=True)
    ]
    paper = paper_scores(suite)["wpt"].get(task)
    return rows if paper is None else [*rows, PanelRow(PAPER_NAME, [paper], None)]


def _draw_panel(panel: Axes, title: str, rows: Sequence[PanelRow]) -> None:
    ends = np.cumsum([0, *(row.height for row in rows)])
    middles = (ends[:-1] + ends[1:]) / 2
    for row, at in zip(rows, middles, strict=True):
        if row.style is None:
            panel.plot(row.scores, [at], clip_on=False, **PAPER)
            continue
        colour, _ = row.style
        panel.plot(row.scores, [at] * len(row.scores), "o", ms=5, color=colour, alpha=0.7)
        panel.plot([np.mean(row.scores)] * 2, [at - 0.5, at + 0.5], color=colour, lw=2)
    panel.set_yticks(middles, [row.label for row in rows], fontsize=7.5)
    left = least((score for row in rows for score in row.scores), -4)
    panel.set(xlim=(left, 104), ylim=(ends[-1], 0), title=title)
    panel.title.set_fontsize(9)
    panel.grid(axis="x", lw=0.4)
    panel.spines[["top", "right"]].set_visible(False)


def row_names(keys: Iterable[Key]) -> list[str]:
    """Return the methods, with preset or budget if there are several.

    The words of a preset that all trained policies share are left out.
    """
    keys = list(keys)
    trained = [frozenset(preset.words) for _, preset, frames in keys if frames]
    common = frozenset.intersection(*trained) if trained else frozenset()
    budgets: dict[str, set[int]] = defaultdict(set)
    for method, _, frames in keys:
        budgets[method].add(frames)
    names = []
    for method, preset, frames in keys:
        changes = [word for word in preset.words if word not in common] if frames else []
        budget = [f"{frames:,} frames"] if len(budgets[method]) > 1 else []
        names.append(", ".join([",\n".join([method, *changes]), *budget]))
    return names
