"""Read run folders for a report."""

import base64
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from wpt_agents.zoo.learning_curves import EVALUATIONS, Evaluations
from wpt_agents.zoo.report.aggregates import Experiment
from wpt_agents.zoo.result import FILE, Result, read_result
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
            if (picture := self.folder / f"{name}.png").exists():
                pixels = imageio.imread(picture)[..., :3]
                small = imageio.imwrite("<bytes>", pixels, extension=".jpg", quality=88)
                entries[name] = data_uri("image/jpeg", small)
        return entries

    def evaluations(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return frames (N,) and scores (N, episodes), which are successes for such tasks."""
        stored = Evaluations.read(self.folder / EVALUATIONS)
        if stored is None:
            return None
        scores = stored.successes if self.result.metric == "success" else stored.returns
        if scores is None:  # returns would be drawn as success rates
            return None
        repeat = self.result.frames / self.result.steps
        return stored.steps * repeat, np.asarray(scores, float)


@dataclass(frozen=True)
class Unfinished:
    """A run folder without a result; `error` is empty if it was killed or is still running."""

    folder: Path
    error: str

    @property
    def last_line(self) -> str:
        """The exception without the traceback."""
        return self.error.splitlines()[-1] if self.error else "stopped, or still running"


def data_uri(kind: str, content: bytes) -> str:
    """Return an address that contains the file."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def find_finished(folder: Path) -> list[Finished]:
    """Return every finished run below `folder`, in the order of their paths.

    :raises ValueError: if a run exists twice, which would count as two seeds
    """
    runs = []
    seen: dict[object, Path] = {}
    for path in sorted(folder.glob(f"**/{FILE}")):
        result = read_result(path.parent)
        assert result is not None, path
        check_new(result.identity, path.parent, seen)
        runs.append(Finished(path.parent, result))
    return runs


def check_new(identity: object, folder: Path, seen: dict[object, Path]) -> None:
    """Raise an error if `seen` has a run of this identity; add it otherwise."""
    if identity in seen:
        raise ValueError(
            f"{seen[identity]} and {folder} are the same run: report one of their folders, or "
            "delete one of them"
        )
    seen[identity] = folder


def read_results(folder: Path) -> list[Result]:
    """Return the results of `find_finished`."""
    return [run.result for run in find_finished(folder)]


def find_unfinished(folder: Path) -> list[Unfinished]:
    """Return every run folder below `folder` that has no result yet."""
    entries = []
    for path in sorted(folder.glob("**/config.yaml")):
        sequence = read_sequence(path.parent)
        finished = (path.parent / FILE).exists() or (sequence is not None and sequence.finished)
        if not finished:
            error = path.parent / "error.txt"
            entries.append(
                Unfinished(path.parent, error.read_text(encoding="utf-8") if error.exists() else "")
            )
    return entries
