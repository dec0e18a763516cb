"""Read run folders for a report. A damaged file is left out with a warning that names it."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np

from wpt_agents.files.names import counted
from wpt_agents.zoo.learning_curves import EVALUATIONS, Evaluations, damaged
from wpt_agents.zoo.report.aggregates import Experiment
from wpt_agents.zoo.result import Result, read_result
from wpt_agents.zoo.results import find_results, unless_damaged
from wpt_agents.zoo.sequence_result import read_sequence


@dataclass(frozen=True)
class Finished:
    """A finished run: its folder and its result."""

    folder: Path
    result: Result

    @property
    def experiment(self) -> Experiment:
        """The experiment that the run belongs to."""
        return Experiment.of(self.result)

    def text(self, name: str) -> str:
        """Return the content of a text file of the folder, empty if there is no such file."""
        path = self.folder / name
        return path.read_text(encoding="utf-8", errors="replace").strip() if path.exists() else ""

    @property
    def name(self) -> str:
        """A unique name that is valid in a web address."""
        one = self.experiment
        return f"{self.result.task}-{one.method}-{one.variant}-{one.frames}-{self.result.seed}"

    def media(self) -> dict[str, str]:
        """Return video, predictions and retrieval as data URIs by their files' stems."""
        entries = {}
        if (video := self.folder / "policy.mp4").exists():
            entries["policy"] = data_uri("video/mp4", video.read_bytes())
        for name in ("predictions", "retrieval"):
            pixels = unless_damaged(_read_picture, self.folder / f"{name}.png")
            if pixels is not None:
                small = imageio.imwrite("<bytes>", pixels, extension=".jpg", quality=88)
                entries[name] = data_uri("image/jpeg", small)
        return entries

    def system(self) -> Any:
        """Return the content of `system.json`, None if there is none."""
        return unless_damaged(_read_system, self.folder / "system.json")

    @cached_property
    def _evaluations(self) -> Evaluations | None:
        return unless_damaged(Evaluations.read, self.folder / EVALUATIONS)

    def evaluations(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return frames (N,) and scores (N, episodes), which are successes for such tasks."""
        stored = self._evaluations
        if stored is None:
            return None
        scores = stored.successes if self.result.metric == "success" else stored.returns
        if scores is None:  # returns would be drawn as success rates
            return None
        repeat = self.result.frames // self.result.steps  # a part of a last step is not played
        return stored.steps * repeat, np.asarray(scores, float)


@dataclass(frozen=True)
class Unfinished:
    """A run folder without a readable result.

    :param error: empty if the run was killed or is still running
    """

    folder: Path
    error: str

    @property
    def last_line(self) -> str:
        """The exception without the traceback."""
        return self.error.splitlines()[-1] if self.error else "stopped, or still running"


def data_uri(kind: str, content: bytes) -> str:
    """Return an address that contains the file."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _read_picture(path: Path) -> np.ndarray | None:
    """Return the colours of a picture, (height, width, 3); None if there is no such file."""
    if not path.exists():
        return None
    try:
        return np.asarray(imageio.imread(path.read_bytes(), plugin="pillow")[..., :3])
    except (OSError, ValueError, SyntaxError) as error:  # the last one by Pillow
        raise damaged(path, error) from None


def _read_system(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
    except ValueError as error:
        raise damaged(path, error) from None


def find_finished(folder: Path) -> list[Finished]:
    """Return every finished run below `folder`, in the order of their paths.

    :raises ValueError: if a run exists twice, which would count as two seeds
    """
    return [Finished(path, result) for path, result in find_results(folder).items()]


def find_unfinished(folder: Path) -> list[Unfinished]:
    """Return every run folder below `folder` that has no result yet, or a damaged one."""
    folders = [path.parent for path in sorted(folder.glob("**/config.yaml"))]
    errors = ((path, _error(path)) for path in folders)
    return [Unfinished(path, error) for path, error in errors if error is not None]


def unfinished_text(unfinished: Sequence[Unfinished]) -> str:
    """Return a paragraph that names unfinished and failed runs, "" without any."""
    if not unfinished:
        return ""
    names = "; ".join(f"{one.folder} ({one.last_line})" for one in unfinished)
    count = counted(len(unfinished), "run")
    return f"Not finished, and in none of these numbers: {count}: {names}\n"


def _error(folder: Path) -> str | None:
    """Return the error of a run without a readable result, "" if unknown; None if it finished."""
    try:
        sequence = read_sequence(folder)
        if read_result(folder) is not None or (sequence is not None and sequence.finished):
            return None
    except ValueError as error:
        return str(error)
    path = folder / "error.txt"
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
