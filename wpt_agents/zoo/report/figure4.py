"""Fig. 4 of the paper: a sequence of tasks, and what each method still knows of earlier ones."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wpt_agents.zoo.report import figures
from wpt_agents.zoo.report.sections import curve
from wpt_agents.zoo.sequence_result import FILE, SequenceResult, read_sequence

COMPARED = ("wpt", "packnet")
WINDOW = 10  # training episodes that a point of a curve averages where nothing was evaluated
Finished = tuple[Path, SequenceResult]


@dataclass(frozen=True)
class Matrix:
    """Mean returns of one method: row k is after task k was learned.

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


def find_sequences(folder: Path) -> list[Finished]:
    """Return every finished sequence below `folder`, in the order of their paths."""
    results = [(path.parent, read_sequence(path.parent)) for path in folder.glob(f"**/{FILE}")]
    return sorted((path, result) for path, result in results if result is not None)


def figures_4(finished: Sequence[Finished]) -> list[Figure4]:
    """Return a figure for each sequence, preset and budget, from whatever runs there are."""
    groups: dict[tuple[str, str, int], list[Finished]] = defaultdict(list)
    for path, result in finished:
        key = result.sequence, str(result.variant), result.frames
        groups[key].append((path, result))
    return [_figure(*key, group) for key, group in groups.items()]


def _figure(sequence: str, variant: str, frames: int, finished: Sequence[Finished]) -> Figure4:
    methods: dict[str, list[Finished]] = defaultdict(list)
    for path, result in finished:
        methods[result.method].append((path, result))
    tasks = [row.task for row in finished[0][1].rows]
    curves = []
    for task in tasks:
        lines = [
            curve(name, [_curve(*one, task) for one in runs]) for name, runs in methods.items()
        ]
        curves.append(figures.lines(task, "simulator frames", "return", lines, list(methods)))
    means = {name: float(np.mean(_learned(runs))) for name, runs in methods.items()}
    ours = means.get("wpt")
    return Figure4(
        title=f"{sequence}, {variant}, {frames:,} frames a task",
        tasks=tasks,
        curves=curves,
        matrices=[
            _matrix(name, runs, means[name] / ours if ours else None)
            for name, runs in methods.items()
        ],
        missing=[name for name in COMPARED if name not in methods],
    )


def _learned(finished: Sequence[Finished]) -> np.ndarray:
    """The returns on the task being learned: (seeds, tasks)."""
    return np.array([[row.learned.mean for row in result.rows] for _, result in finished])


def _matrix(name: str, finished: Sequence[Finished], share: float | None) -> Matrix:
    results = [result for _, result in finished]
    tasks = [row.task for row in results[0].rows]
    rows = [
        [float(np.mean([r.rows[k].scores[task].mean for r in results])) for task in tasks[: k + 1]]
        for k in range(len(tasks))
    ]
    return Matrix(name, [result.seed for result in results], rows, results[0].command, share)


def _curve(folder: Path, result: SequenceResult, task: str) -> tuple[np.ndarray, np.ndarray]:
    """Return frames (N,) and returns (N, episodes) of learning one task.

    They are the evaluations, or means of training episodes if there are none.
    """
    repeat = result.frames / result.steps
    path = folder / task / "evaluations.npz"
    if path.exists():
        with np.load(path) as arrays:  # no pickle
            return arrays["timesteps"] * repeat, np.asarray(arrays["results"], float)
    monitor = folder / task / "0.monitor.csv"
    rows = np.atleast_1d(np.genfromtxt(monitor, delimiter=",", skip_header=1, names=True))
    points = max(len(rows) // WINDOW, 1)
    parts = np.array_split(np.arange(len(rows)), points)
    frames = rows["l"].cumsum()[[part[-1] for part in parts]] * repeat
    size = min(map(len, parts))
    return frames, np.array([rows["r"][part][-size:] for part in parts])
