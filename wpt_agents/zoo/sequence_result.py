"""The result of a sequence of tasks; only this module reads and writes `sequence.json`.

Example::

    result = read_sequence(Path("runs/tiny/packnet/ant_0"))
    result.rows[2].scores["dmc-quadruped-stand"].mean  # the first task, after the third
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from wpt_agents.zoo.result import Change, Score, Variant, run_command
from wpt_agents.zoo.text_files import read_json, write_json

FILE = "sequence.json"
ROW = "scores.json"  # in the folder of each task that is finished


@dataclass(frozen=True)
class Row:
    """The scores at the end of one task of the sequence.

    :param task: the task that was learned
    :param scores: of this task and all before it, by task
    :param updates: updates for this task, including PackNet's retraining of the previous one
    :param seconds: wall-clock seconds of learning it
    :param cpu_seconds: processor seconds of learning it
    """

    task: str
    scores: Mapping[str, Score]
    updates: int
    seconds: float
    cpu_seconds: float

    @property
    def learned(self) -> Score:
        """The score on the task that was learned, the number of Fig. 4."""
        return self.scores[self.task]


@dataclass(frozen=True)
class SequenceResult:
    """All results of a sequence so far.

    :param tasks: all tasks, in the order of learning
    :param frames: simulator frames of each task
    :param steps: calls of `env.step` of each task
    :param rows: one for each task that is finished
    """

    suite: str
    sequence: str
    method: str
    variant: Variant
    seed: int
    tasks: Sequence[str]
    frames: int
    steps: int
    rows: Sequence[Row]
    commit: str | None = None

    @property
    def finished(self) -> bool:
        """True if all tasks are finished."""
        return len(self.rows) == len(self.tasks)

    @property
    def identity(self) -> tuple[str, str, Variant, int, int]:
        """The identity of the sequence: name, method, variant, budget and seed."""
        return self.sequence, self.method, self.variant, self.frames, self.seed

    @property
    def command(self) -> str:
        """A command that repeats the runs of the sequence."""
        task = ["--sequence", self.sequence]
        return run_command(task, self.method, self.variant, self.frames, self.seed)


def write_row(folder: Path, row: Row) -> None:
    """Write the scores at the end of a task atomically."""
    write_json(folder / ROW, asdict(row))


def read_row(folder: Path) -> Row | None:
    """Read the file of `write_row`; return None if the task is not finished.

    :raises ValueError: if the file is damaged
    """
    return read_json(folder / ROW, _row)


def write_sequence(folder: Path, result: SequenceResult) -> None:
    """Write the result of a sequence atomically."""
    write_json(folder / FILE, asdict(result) | {"command": result.command})


def read_sequence(folder: Path) -> SequenceResult | None:
    """Read the result of the sequence in `folder`; return None if no task is finished.

    :raises ValueError: if the file is damaged
    """
    return read_json(folder / FILE, _sequence)


def _sequence(stored: dict[str, Any]) -> SequenceResult:
    stored.pop("command")
    variant = stored.pop("variant")
    variant["changes"] = tuple(sorted(Change(**c).short for c in variant["changes"]))
    rows = [_row(row) for row in stored.pop("rows")]
    return SequenceResult(variant=Variant(**variant), rows=rows, **stored)


def _row(stored: dict[str, Any]) -> Row:
    scores = {task: Score.of(score) for task, score in stored.pop("scores").items()}
    return Row(scores=scores, **stored)
