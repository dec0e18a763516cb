"""Checkpoints, from which the same command resumes an interrupted run.

A checkpoint is a folder `checkpoints/step-N`: model file, logs so far, and `state.json` with the
checksum of every other file. It is written to a temporary folder and renamed, so it is never
incomplete; the last two are kept. Episodes are stored in `replay/`, one file per episode.
Checkpoints are taken between episodes, and random numbers depend only on counters, so a resumed run
equals an uninterrupted one, bit for bit on a CPU. Everything after the checkpoint is discarded.
"""

import hashlib
import json
import os
import shutil
import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.files.archive import sync_folder
from wpt_agents.training.signals import StopSignals

BEST_MODEL = "best_model.zip"
HEAD_START_MODEL = "head_start_model.zip"
LOGS = ("0.monitor.csv", "progress.csv", "evaluations.npz", BEST_MODEL, HEAD_START_MODEL)
KEEP = 2
SECONDS = 600  # between checkpoints, if `every` steps take longer
STOPPING = (
    "The run stops after this episode and its updates, so that it can continue from there. "
    "Press Ctrl-C again to stop at once and lose the steps since the last checkpoint."
)
STATE = "state.json"


def resumes(agent: BaseAlgorithm) -> bool:
    """Return whether checkpoints can contain the whole agent, because it stores whole episodes."""
    buffer = getattr(agent, "replay_buffer", None)
    return isinstance(buffer, ReplayBuffer) and hasattr(agent, "episodes")


@dataclass(frozen=True)
class Origin:
    """What the processes of a run did before learning, which a resumed run does not do again.

    :param commits: of the code, one for each process that had another one than those before
    :param pretrained: the first digits of the SHA-256 of the pre-trained model, None without one
    :param seconds: wall-clock seconds of each stage before learning
    """

    commits: Sequence[str] = ()
    pretrained: str | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class State:
    """The content of `state.json`: all state besides the model file, the logs and the episodes.

    :param seconds: wall-clock seconds of learning so far
    :param replay: the number of episodes in the replay buffer
    :param log: the running means of the logger
    :param ep_info: SB3's information on the latest episodes
    :param files: the checksum of every file of the checkpoint
    :param cpu_seconds: processor seconds of learning so far; 0 in checkpoints of version 0.1
    :param origin: empty in checkpoints of version 0.2
    """

    seconds: float
    replay: int
    log: Mapping[str, float]
    ep_info: Sequence[Mapping[str, float]]
    ep_success: Sequence[bool]
    files: Mapping[str, str]
    cpu_seconds: float = 0.0
    origin: Origin = Origin()

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Self:
        """Build a state from the content of its file."""
        return cls(**stored | {"origin": Origin(**stored.get("origin", {}))})


@dataclass(frozen=True)
class Checkpoint:
    """A folder that `write_checkpoint` made."""

    folder: Path
    state: State

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the state of a checkpoint."""
        return cls(folder, State.of(json.loads((folder / STATE).read_text(encoding="utf-8"))))

    @property
    def model(self) -> Path:
        """The model file."""
        return self.folder / "model.zip"

    def check(self, run: Path) -> None:
        """Check that every file exists and is unchanged.

        :raises ValueError: if one does not or has changed
        """
        for name, written in self.state.files.items():
            if checksum(self.folder / name) != written:
                raise ValueError(f"{name} has changed since it was written")
        for i in range(self.state.replay):
            if not _episode(run, i).exists():
                raise ValueError(f"{_episode(run, i).name} is missing")

    def restore_logs(self, run: Path) -> None:
        """Replace the run's logs with those of the checkpoint."""
        for name in LOGS:
            (run / name).unlink(missing_ok=True)
            if name in self.state.files:
                shutil.copy2(self.folder / name, run / name)

    def restore(self, agent: Any, run: Path) -> None:
        """Restore the episodes and the logger's means, which the model file does not contain.

        :param agent: one that `resumes`
        """
        agent.replay_buffer = ReplayBuffer()
        for i in range(self.state.replay):
            for trajectory in ReplayBuffer.load(_episode(run, i)).trajectories:
                agent.replay_buffer.add(trajectory)
        for path in sorted((run / "replay").glob("episode-*"))[self.state.replay :]:
            path.unlink()
        window = agent._stats_window_size
        agent.ep_info_buffer = deque(self.state.ep_info, maxlen=window)
        agent.ep_success_buffer = deque(self.state.ep_success, maxlen=window)
        for name, value in self.state.log.items():
            agent.logger.record_mean(name, value)


def write_checkpoint(
    agent: Any,
    run: Path,
    seconds: float = 0.0,
    cpu_seconds: float = 0.0,
    origin: Origin = Origin(),
) -> None:
    """Write a checkpoint into the run's folder; no episode may be in progress.

    :param agent: one that `resumes`
    :param seconds: wall-clock seconds of learning so far
    :param cpu_seconds: processor seconds of learning so far
    :param origin: what was done before learning
    """
    _write_episodes(agent, run)
    folder = run / "checkpoints" / f"step-{agent.num_timesteps:09}"
    aside = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    agent.save(aside / "model.zip")
    for name in LOGS:
        if (run / name).exists():
            shutil.copy2(run / name, aside / name)
    log = agent.logger  # after an episode's updates each of its means has been recorded once
    state = State(
        seconds=seconds,
        replay=len(agent.replay_buffer.trajectories),
        log={k: float(v) for k, v in log.name_to_value.items() if log.name_to_count[k]},
        ep_info=list(agent.ep_info_buffer or []),
        ep_success=[bool(s) for s in agent.ep_success_buffer or []],
        files={path.name: checksum(path) for path in sorted(aside.iterdir())},
        cpu_seconds=cpu_seconds,
        origin=origin,
    )
    (aside / STATE).write_text(json.dumps(asdict(state)), encoding="utf-8")
    for path in aside.iterdir():
        with open(path, "rb") as file:
            os.fsync(file.fileno())
    sync_folder(aside)
    shutil.rmtree(folder, ignore_errors=True)
    aside.rename(folder)
    sync_folder(folder.parent)
    for old in _folders(run)[KEEP:]:
        shutil.rmtree(old)


def _write_episodes(agent: Any, run: Path) -> None:
    """Write the replay buffer's episodes that have no file yet."""
    for i, trajectory in enumerate(agent.replay_buffer.trajectories):
        if not _episode(run, i).exists():
            one = ReplayBuffer()
            one.add(trajectory)
            one.save(_episode(run, i))


def last_checkpoint(run: Path) -> Checkpoint | None:
    """Return the newest complete checkpoint; damaged ones are skipped with a warning."""
    for folder in _folders(run):
        try:
            checkpoint = Checkpoint.read(folder)
            checkpoint.check(run)
            return checkpoint
        except (OSError, ValueError, TypeError) as error:
            warnings.warn(f"{folder} is damaged and was skipped: {error}", stacklevel=2)
    return None


def remove_checkpoints(run: Path) -> None:
    """Delete all checkpoints when a run is finished, or before a new one starts."""
    for name in ("checkpoints", "replay"):
        shutil.rmtree(run / name, ignore_errors=True)


def _folders(run: Path) -> list[Path]:
    """Return the checkpoints' folders, newest first."""
    return sorted((run / "checkpoints").glob("step-*"), reverse=True)


def _episode(run: Path, number: int) -> Path:
    return run / "replay" / f"episode-{number:06}.zip"


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Checkpoints(BaseCallback):
    """Write checkpoints between episodes, at the end of learning, and when the process is stopped.

    Between episodes one is written if the last is `every` steps or ten minutes old. After Ctrl-C
    or SIGTERM the episode and its updates are completed, a checkpoint is written, and only then
    the signal takes effect; a second one takes effect at once.

    It also measures the cost of learning over all processes that took part.

    :param every: steps between checkpoints; 0: only at the end or on a signal, None: never
    :param seconds: wall-clock seconds of learning in earlier processes
    :param cpu_seconds: processor seconds of learning in earlier processes
    :param origin: what was done before learning
    """

    def __init__(
        self,
        run: Path,
        every: int | None,
        seconds: float = 0.0,
        cpu_seconds: float = 0.0,
        origin: Origin = Origin(),
    ) -> None:
        super().__init__()
        self.run = run
        self.origin = origin
        self.every = every
        self.written = 0
        self.written_at = 0.0  # on the clock of `time.monotonic`
        self.signals = StopSignals(STOPPING)
        self.start = time.perf_counter() - seconds
        self.cpu_start = time.process_time() - cpu_seconds

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of learning, in all processes."""
        return time.perf_counter() - self.start

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds of the learning processes, all their threads."""
        return time.process_time() - self.cpu_start

    def _on_training_start(self) -> None:
        self.written = self.model.num_timesteps
        self.written_at = time.monotonic()

    def _on_rollout_start(self) -> None:
        starts = self.model._last_episode_starts
        between = starts is not None and starts.all()  # but not within a long episode
        if self.every is None or not between:
            return
        self.signals.start()  # not sooner: nothing can be saved while the prior actor is trained
        steps = self.model.num_timesteps - self.written
        if steps and (self.signals.received or self._is_due(steps)):
            self._write()
        if self.signals.received:
            self.signals.deliver(self.signals.received)

    def _is_due(self, steps: int) -> bool:
        """Return whether it is time for a checkpoint, `steps` after the last one."""
        if not self.every:
            return False
        return steps >= self.every or time.monotonic() - self.written_at >= SECONDS

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        interrupted = self.model._last_obs is None  # stopped by an error within an episode
        new = self.model.num_timesteps > self.written
        if self.every is not None and new and not interrupted:
            self._write()

    def _write(self) -> None:
        write_checkpoint(self.model, self.run, self.seconds, self.cpu_seconds, self.origin)
        self.written = self.model.num_timesteps
        self.written_at = time.monotonic()


class HeadStart(BaseCallback):
    """Save the agent at the end of the head start of fine-tuning: after `actor_delay` updates.

    Agents without a head start lack this keyword or have the value 0.
    """

    def __init__(self, run: Path) -> None:
        super().__init__()
        self.path = run / HEAD_START_MODEL

    def _on_training_start(self) -> None:
        agent: Any = self.model
        if getattr(agent, "actor_delay", 0):
            # Updates of imagination may follow at once, before SB3 calls any callback.
            agent.after_update = self.save_at_its_end

    def save_at_its_end(self) -> None:
        """Save the agent after the last update of its head start."""
        agent: Any = self.model
        if agent.task_updates == agent.actor_delay:
            agent.save(self.path)

    def _on_training_end(self) -> None:
        vars(self.model).pop("after_update", None)

    def _on_step(self) -> bool:
        return True
