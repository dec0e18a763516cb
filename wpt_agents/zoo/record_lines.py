"""The lines of a record, a CSV file of results, and how they are read and written."""

import csv
import io
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from wpt_agents.zoo.result import PRIOR_ACTOR, Variant

Identity = tuple[str, str, str, int, int]  # task, method or policy, preset, frames, seed


@dataclass(frozen=True)
class Line:
    """The score of one policy of one run.

    :param method: the run's method for its final policy, else the policy's name
    :param score: 0 to 100 as in the paper: the return / 10, or the share of successes x 100
    :param hours: hours of the whole run, including shared stages that it executed
    :param updates: gradient updates of fine-tuning; None where unknown, as in version 0.1
    :param cpu_hours: CPU hours of fine-tuning by the learner's process; a worker process in which
        the environment steps, as the model-free agents have, is not counted; None where unknown
    :param model_hash: the first digits of the SHA-256 of the pre-trained model file that
        fine-tuning began with; "" without one, or where unknown
    :param policy: one of `POLICIES`; "" in records of version 0.1
    :param success_any: the share of episodes with success at any step, where `success` is that
        with success at the last one; None in older records and without successes
    """

    suite: str
    task: str
    method: str
    seed: int
    preset: Variant
    frames: int
    score: float
    return_: float
    success: float | None
    hours: float
    commit: str
    command: str
    updates: int | None = None
    cpu_hours: float | None = None
    model_hash: str = ""
    policy: str = ""
    success_any: float | None = None

    @property
    def run_method(self) -> str:
        """The method of the run, which for most policies is in their names."""
        named = re.search(r"--method (\S+)", self.command)  # of "prior actor" it is only there
        name = self.method.removeprefix(f"{PRIOR_ACTOR}, ").split(",")[0]
        return named[1] if named else name

    @property
    def identity(self) -> Identity:
        """The identity of the line; the prior actors of two methods may have the same name."""
        clone = self.method.startswith(PRIOR_ACTOR)
        method = f"{PRIOR_ACTOR}, {self.run_method}" if clone else self.method
        return self.task, method, str(self.preset), self.frames, self.seed

    @property
    def run(self) -> Identity:
        """The identity of the run; an untrained policy, which all methods share, has its own."""
        method = self.run_method if self.frames else self.method
        return self.task, method, str(self.preset), self.frames, self.seed


COLUMNS = [field.name.rstrip("_") for field in fields(Line)]
# Older records lack these.
OPTIONAL = ("updates", "cpu_hours", "model_hash", "policy", "success_any")


def read(path: Path) -> list[Line]:
    """Read the lines of a record.

    :raises ValueError: if the file is no record or is damaged
    """
    try:
        # Spreadsheet programs write a mark at the beginning, which "utf-8" would take for a name.
        with open(path, newline="", encoding="utf-8-sig") as file:
            return [_parse(row) for row in csv.DictReader(file)]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(
            f"{path} is not a record of runs ({error}); its columns are {', '.join(COLUMNS)}"
        ) from None


PARSERS: Mapping[str, Callable[[str], Any]] = {
    "seed": int,
    "preset": Variant.parse,
    "frames": int,
    "score": float,
    "return": float,
    "success": lambda text: float(text) if text else None,
    "hours": float,
    "updates": lambda text: int(text) if text else None,
    "cpu_hours": lambda text: float(text) if text else None,
    "success_any": lambda text: float(text) if text else None,
}


def _parse(row: Mapping[Any, Any]) -> Line:
    if None in row or None in row.values():  # as `DictReader` marks them
        raise ValueError(f"a line has too many or too few cells: {list(row.values())}")
    cells = {name: row.get(name, "") if name in OPTIONAL else row[name] for name in COLUMNS}
    return Line(*(PARSERS.get(name, str)(text) for name, text in cells.items()))


def csv_of(kind: type, rows: Iterable[Any]) -> str:
    """Return objects of a dataclass as CSV, a column for each field.

    The values of a tuple are in one cell, separated by spaces. The underscore at the end of
    `return_`, which is a word of Python, is not in the name of its column.
    """
    names = [field.name for field in fields(kind)]
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(name.rstrip("_") for name in names)
    for row in rows:
        values = [getattr(row, name) for name in names]
        writer.writerow(" ".join(map(str, v)) if isinstance(v, tuple) else v for v in values)
    return file.getvalue()
