"""Where a run stands, so that the same command goes on from there whatever ended the process.

A checkpoint is a folder `checkpoints/step-N`: model file, logs so far, and `state.json` with the
checksum of every other file. It is written aside and renamed, so it is whole or not there; the last
two are kept. Episodes stand beside in `replay/`, one file each. Checkpoints are taken between two
episodes, and all that is drawn depends on counters alone, so a run that goes on equals one that was
never ended, bit for bit on a CPU. What came after the checkpoint never happened.
"""

import hashlib
import json
import os
import shutil
import time
import warnings
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.files.archive import sync_folder

LOGS = ("0.monitor.csv", "progress.csv", "evaluations.npz", "best_model.zip")
KEEP = 2


@dataclass(frozen=True)
class Checkpoint:
    """A folder that `write_checkpoint` made."""

    folder: Path
    state: dict[str, Any]

    @property
    def model(self) -> Path:
        """The model file."""
        return self.folder / "model.zip"

    def restore_logs(self, run: Path) -> None:
        """Puts the run's logs back to what they were."""
        for name in LOGS:
            (run / name).unlink(missing_ok=True)
            if name in self.state["files"]:
                shutil.copy2(self.folder / name, run / name)

    def restore(self, model: WPT, run: Path) -> None:
        """Puts back what the model file does not hold: episodes, and means being logged."""
        model.replay_buffer, held = ReplayBuffer(), self.state["replay"]
        for i in range(held):
            for trajectory in ReplayBuffer.load(_episode(run, i)).trajectories:
                model.replay_buffer.add(trajectory)
        for path in sorted((run / "replay").glob("episode-*"))[held:]:
            path.unlink()
        window = model._stats_window_size
        model.ep_info_buffer = deque(self.state["ep_info"], maxlen=window)
        model.ep_success_buffer = deque(self.state["ep_success"], maxlen=window)
        for name, value in self.state["log"].items():
            model.logger.record_mean(name, value)


def write_checkpoint(model: WPT, run: Path, seconds: float = 0.0) -> None:
    """Writes where `model` stands into the run's folder; no episode may be open.

    :param seconds: spent on learning so far
    """
    replay = model.replay_buffer.trajectories
    for i, trajectory in enumerate(replay):
        if not _episode(run, i).exists():
            one = ReplayBuffer()
            one.add(trajectory)
            one.save(_episode(run, i))
    folder = run / "checkpoints" / f"step-{model.num_timesteps:09}"
    aside = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    model.save(aside / "model.zip")
    for name in LOGS:
        if (run / name).exists():
            shutil.copy2(run / name, aside / name)
    log = model.logger  # after an episode's updates each of its means has been recorded once
    state = {
        "seconds": seconds,
        "replay": len(replay),
        "log": {k: float(v) for k, v in log.name_to_value.items() if log.name_to_count[k]},
        "ep_info": list(model.ep_info_buffer or []),
        "ep_success": [bool(s) for s in model.ep_success_buffer or []],
        "files": {path.name: _checksum(path) for path in sorted(aside.iterdir())},
    }
    (aside / "state.json").write_text(json.dumps(state))
    for path in aside.iterdir():
        with open(path, "rb") as file:
            os.fsync(file.fileno())
    sync_folder(aside)
    shutil.rmtree(folder, ignore_errors=True)
    aside.rename(folder)
    sync_folder(folder.parent)
    for old in _folders(run)[KEEP:]:
        shutil.rmtree(old)


def last_checkpoint(run: Path) -> Checkpoint | None:
    """The newest checkpoint that is whole; a damaged one is passed over, aloud."""
    for folder in _folders(run):
        try:
            state = json.loads((folder / "state.json").read_text())
            for name, checksum in state["files"].items():
                if _checksum(folder / name) != checksum:
                    raise ValueError(f"{name} is not as it was written")
            for i in range(state["replay"]):
                if not _episode(run, i).exists():
                    raise ValueError(f"{_episode(run, i).name} is missing")
            return Checkpoint(folder, state)
        except (OSError, ValueError, KeyError) as error:
            warnings.warn(f"{folder} is damaged and passed over: {error}", stacklevel=2)
    return None


def remove_checkpoints(run: Path) -> None:
    """Frees the disk when a run is finished, or makes way for a new one."""
    for name in ("checkpoints", "replay"):
        shutil.rmtree(run / name, ignore_errors=True)


def _folders(run: Path) -> list[Path]:
    """Newest first, by step."""
    return sorted((run / "checkpoints").glob("step-*"), reverse=True)


def _episode(run: Path, number: int) -> Path:
    return run / "replay" / f"episode-{number:06}.zip"


def _checksum(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Checkpoints(BaseCallback):
    """Writes a checkpoint between two episodes every so many steps, and at the end of learning.

    :param every: steps; 0 for at the end only
    :param seconds: spent on learning before
    """

    def __init__(self, run: Path, every: int, seconds: float = 0.0) -> None:
        super().__init__()
        self.run, self.every, self.written = run, every, 0
        self.begun = time.perf_counter() - seconds

    @property
    def seconds(self) -> float:
        """Spent on learning, in all processes that took part."""
        return time.perf_counter() - self.begun

    def _on_training_start(self) -> None:
        self.written = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        assert isinstance(self.model, WPT)
        if self.every and self.model.num_timesteps - self.written >= self.every:
            write_checkpoint(self.model, self.run, self.seconds)
            self.written = self.model.num_timesteps

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        assert isinstance(self.model, WPT)
        interrupted = self.model._last_obs is None  # by an error, in the middle of an episode
        if not interrupted and self.model.num_timesteps > self.written:
            write_checkpoint(self.model, self.run, self.seconds)
