"""What run folders hold, read back."""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np

from wpt_agents.zoo.report.aggregates import Experiment


@dataclass(frozen=True)
class Finished:
    """A finished run: its folder and what its `result.json` holds."""

    folder: Path
    result: dict[str, Any]

    @property
    def experiment(self) -> Experiment:
        """What it is a run of."""
        return Experiment.of(self.result)

    def text(self, name: str) -> str:
        """A text file of the folder, empty if it is not there."""
        path = self.folder / name
        return path.read_text(errors="replace").strip() if path.exists() else ""

    @property
    def name(self) -> str:
        """What no other run is called, with characters that a web address may have."""
        one = self.experiment
        return f"{self.result['task']}-{one.method}-{one.preset}-{one.frames}-{self.result['seed']}"

    def media(self) -> dict[str, str]:
        """Video, predictions and what was retrieved, as data URIs by their files' stems."""
        found = {}
        if (video := self.folder / "policy.mp4").exists():
            found["policy"] = data_uri("video/mp4", video.read_bytes())
        for name in ("predictions", "retrieval"):
            if (picture := self.folder / f"{name}.png").exists():
                pixels = imageio.imread(picture)[..., :3]
                small = imageio.imwrite("<bytes>", pixels, extension=".jpg", quality=88)
                found[name] = data_uri("image/jpeg", small)
        return found

    def evaluations(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Frames (N,) and scores (N, episodes), successes where the task counts them."""
        path = self.folder / "evaluations.npz"
        if not path.exists():
            return None
        with np.load(path) as held:  # no pickle
            success = self.result["metric"] == "success" and "successes" in held
            scores = held["successes" if success else "results"]
            repeat = self.result["frames"] / self.result["steps"]
            return held["timesteps"] * repeat, np.asarray(scores, float)


@dataclass(frozen=True)
class Unfinished:
    """A run folder without a result: what it died of, or nothing if it still runs or was killed."""

    folder: Path
    error: str

    @property
    def last_line(self) -> str:
        """The exception itself."""
        return self.error.splitlines()[-1] if self.error else "stopped, or still running"


def data_uri(kind: str, content: bytes) -> str:
    """A file as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def read_runs(folder: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Every finished run below `folder` and its result, in the order of their paths.

    :raises ValueError: a run that stands there twice, which would count as two seeds
    """
    runs = [(path.parent, _read(path)) for path in sorted(folder.glob("**/result.json"))]
    seen: dict[tuple[Any, ...], Path] = {}
    for path, result in runs:
        one = tuple(result[name] for name in ("task", "method", "preset", "frames", "seed"))
        if one in seen:
            raise ValueError(
                f"{seen[one]} and {path} are the same run: report one of their folders, or delete "
                "one of them"
            )
        seen[one] = path
    return runs


def read_results(folder: Path) -> list[dict[str, Any]]:
    """The results of `read_runs`."""
    return [result for _, result in read_runs(folder)]


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); delete it and run again") from None


def find_finished(folder: Path) -> list[Finished]:
    """Every finished run below `folder`."""
    return [Finished(*run) for run in read_runs(folder)]


def find_unfinished(folder: Path) -> list[Unfinished]:
    """Every run folder below `folder` that has no result yet."""
    found = []
    for path in sorted(folder.glob("**/config.yaml")):
        if not (path.parent / "result.json").exists():
            error = path.parent / "error.txt"
            found.append(Unfinished(path.parent, error.read_text() if error.exists() else ""))
    return found
