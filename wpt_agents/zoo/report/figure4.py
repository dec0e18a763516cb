"""Fig. 4 of the paper: a sequence of tasks, and each method's scores on earlier ones."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.markup import escape
from rich.table import Table

from wpt_agents.files.names import counted
from wpt_agents.zoo.learning_curves import EVALUATIONS, MONITOR, Evaluations, TrainingEpisodes
from wpt_agents.zoo.numbers import number
from wpt_agents.zoo.report import figures
from wpt_agents.zoo.report.sections import curve
from wpt_agents.zoo.report.tables import markdown_table
from wpt_agents.zoo.results import check_new, unless_damaged
from wpt_agents.zoo.sequence_result import FILE, SequenceResult, read_sequence

COMPARED = ("wpt", "packnet")
WINDOW = 10  # training episodes per point of a curve, if there are no evaluations
SequenceFolder = tuple[Path, SequenceResult]  # of a sequence with a finished task


@dataclass(frozen=True)
class Matrix:
    """Mean returns of one method; row k is measured after learning task k.

    :param share: `mean` as a share of WPT's; None where WPT was not run
    """

    name: str
    seeds: Sequence[int]
    rows: Sequence[Sequence[float]]
    command: str
    share: float | None

    @property
    def mean(self) -> float:
        """The mean over the tasks of the return on the task being learned."""
        return float(np.mean([row[-1] for row in self.rows]))


@dataclass(frozen=True)
class Figure4:
    """One sequence at one budget; curves are SVG, one for each task."""

    title: str
    tasks: Sequence[str]
    curves: Sequence[str]
    matrices: Sequence[Matrix]
    missing: Sequence[str]

    @property
    def names(self) -> list[str]:
        """The methods' names, in the order of their colours."""
        return [matrix.name for matrix in self.matrices]


def find_sequences(folder: Path) -> list[SequenceFolder]:
    """Return every sequence below `folder` with a finished task, in the order of their paths.

    :raises ValueError: if a sequence exists twice, which would count as two seeds
    """
    finished = []
    seen: dict[object, Path] = {}
    for path in sorted(file.parent for file in folder.glob(f"**/{FILE}")):
        result = unless_damaged(read_sequence, path)
        if result is not None:
            check_new(result.identity, path, seen)
            finished.append((path, result))
    return finished


def figures_4(finished: Sequence[SequenceFolder]) -> list[Figure4]:
    """Return a figure for each sequence, preset and budget, from the existing runs."""
    groups: dict[tuple[str, str, int], list[SequenceFolder]] = defaultdict(list)
    for path, result in finished:
        key = result.sequence, str(result.variant), result.frames
        groups[key].append((path, result))
    return [_figure(*key, group) for key, group in groups.items()]


def sequence_markdown(figures: Sequence[Figure4]) -> str:
    """Return the matrices of all sequences as Markdown tables."""
    parts = []
    for figure in figures:
        tasks = [task.replace("dmc-", "") for task in figure.tasks]
        for matrix in figure.matrices:
            lines = [
                [f"after {task}", *map(number, row), *[""] * (len(tasks) - len(row))]
                for task, row in zip(tasks, matrix.rows, strict=False)  # unfinished: fewer rows
            ]
            table = markdown_table([matrix.name, *tasks], lines)
            seeds = counted(len(matrix.seeds), "seed")
            mean = f"Means over {seeds}; on the tasks being learned: {number(matrix.mean)}."
            parts.append(f"### The sequence {figure.title}: {matrix.name}\n\n{table}\n{mean}\n")
    return "\n".join(parts)


def sequence_table(figures: Sequence[Figure4]) -> Table:
    """Return the mean of each sequence and method as a table for a terminal."""
    caption = "mean over seeds and tasks of the return on the task that is being learned"
    table = Table("sequence", "method", caption=caption)
    for heading in ("seeds", "tasks", "mean"):
        table.add_column(heading, justify="right")
    for figure in figures:
        for matrix in figure.matrices:
            counts = str(len(matrix.seeds)), f"{len(matrix.rows)} of {len(figure.tasks)}"
            table.add_row(escape(figure.title), matrix.name, *counts, number(matrix.mean))
    return table


def _figure(
    sequence: str, variant: str, frames: int, finished: Sequence[SequenceFolder]
) -> Figure4:
    methods: dict[str, list[SequenceFolder]] = defaultdict(list)
    for path, result in finished:
        methods[result.method].append((path, result))
    tasks = list(finished[0][1].tasks)
    curves = []
    for place, task in enumerate(tasks):
        runs_of = {
            name: [(path, result) for path, result in runs if len(result.rows) > place]
            for name, runs in methods.items()
        }
        seeds_of = {name: _curves(runs, task) for name, runs in runs_of.items()}
        lines = [curve(name, seeds) for name, seeds in seeds_of.items() if seeds]
        if lines:
            curves.append(figures.lines(task, "simulator frames", "return", lines, list(methods)))
    return Figure4(
        title=f"{sequence}, {variant}, {frames:,} frames a task",
        tasks=tasks,
        curves=curves,
        matrices=[
            _matrix(name, runs, _share(runs, methods.get("wpt", ())))
            for name, runs in methods.items()
        ],
        missing=[*_missing(finished), *(name for name in COMPARED if name not in methods)],
    )


def _missing(finished: Sequence[SequenceFolder]) -> list[str]:
    """Return a line for each unfinished sequence with its number of tasks."""
    lines = []
    for _, result in finished:
        if left := len(result.tasks) - len(result.rows):
            lines.append(f"{counted(left, 'task')} of {result.method}, seed {result.seed}")
    return lines


def _share(runs: Sequence[SequenceFolder], ours: Sequence[SequenceFolder]) -> float | None:
    """Return the mean return during learning as a share of WPT's, on common tasks."""
    if not ours:
        return None
    common = min(len(result.rows) for _, result in [*runs, *ours])
    theirs, wpt = (
        np.mean([[row.learned.mean for row in result.rows[:common]] for _, result in some])
        for some in (runs, ours)
    )
    return float(theirs / wpt) if wpt else None


def _matrix(name: str, finished: Sequence[SequenceFolder], share: float | None) -> Matrix:
    results = [result for _, result in finished]
    tasks = results[0].tasks
    rows = [
        [float(np.mean([r.rows[k].scores[task].mean for r in results])) for task in tasks[: k + 1]]
        for k in range(min(len(result.rows) for result in results))
    ]
    return Matrix(name, [result.seed for result in results], rows, results[0].command, share)


def _curves(runs: Sequence[SequenceFolder], task: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the curves of a task, without those whose file is damaged."""
    curves = [unless_damaged(partial(_curve, result, task), path) for path, result in runs]
    return [one for one in curves if one is not None]


def _curve(result: SequenceResult, task: str, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return frames (N,) and returns (N, episodes) of learning one task.

    They are the evaluations, or means of training episodes if there are none; N is 0 if learning
    ended within the first episode.

    :raises ValueError: if the file is damaged
    """
    repeat = result.frames // result.steps
    evaluated = Evaluations.read(folder / task / EVALUATIONS)
    if evaluated is not None:
        return evaluated.steps * repeat, np.asarray(evaluated.returns, float)
    played = TrainingEpisodes.read(folder / task / MONITOR)
    if not len(played):
        return np.empty(0), np.empty((0, 1))
    points = max(len(played) // WINDOW, 1)
    parts = np.array_split(np.arange(len(played)), points)
    frames = played.lengths.cumsum()[[part[-1] for part in parts]] * repeat
    size = min(map(len, parts))
    return frames, np.array([played.returns[part][-size:] for part in parts])
