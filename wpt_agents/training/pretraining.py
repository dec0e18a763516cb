"""Pre-training of the world model (Algorithm 1), on one device or several."""

import os
import warnings
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from wpt_agents.data.bars import StageBar
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Batch
from wpt_agents.files.locks import lock
from wpt_agents.training.distributed import World
from wpt_agents.training.divided import Divided
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.logs import PretrainingLog
from wpt_agents.training.progress import WorldModelProgress
from wpt_agents.training.randomness import Purpose, Streams, torch_seed
from wpt_agents.training.signals import StopSignals
from wpt_agents.training.world_model_learner import (
    Metrics,
    WorldModelLearner,
    world_model_metrics,
)

SAVE_EVERY = 1000  # updates between two model files

Update = Callable[[Batch, int], Metrics]  # called with a batch and the update's number
Callback = Callable[[int, dict[str, float]], Any]  # called with the updates made and the metrics


class Pretrainable(Protocol):
    """An agent whose world model `pretrain` can train."""

    @property
    def dataset(self) -> TrajectoryDataset | None:
        """The trajectories to learn from."""

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The keywords."""

    @property
    def learner(self) -> WorldModelLearner:
        """The object that updates the world model."""

    @property
    def progress(self) -> WorldModelProgress:
        """The counters, of which `pretrain_steps` is raised."""

    @property
    def streams(self) -> Streams:
        """The source of all random numbers."""

    def adapt_to_data(self, data: TrajectoryDataset) -> None:
        """Adapt a new world model to images of the data, once."""

    def save(self, path: Path) -> None:
        """Write the model file."""


def pretrain(
    model: Pretrainable,
    world: World,
    steps: int,
    accumulate: int = 1,
    run_dir: Path | None = None,
    progress_bar: bool = False,
    callback: Callback | None = None,
) -> None:
    """Train a model's world model on its dataset, up to `steps` updates in all.

    :param world: the processes that share the work; rank 0 alone writes files and calls back
    :param steps: number of updates in all
    :param accumulate: number of passes in which a batch, or a process's share of it, is computed,
        to save memory
    :param run_dir: folder of the model file and of the learning curve
    :param progress_bar: show a progress bar
    :param callback: called after every update with (step, metrics)
    """
    assert model.dataset is not None
    facts = {"steps": steps, "accumulate": accumulate}
    facts |= {"pretrain_steps": model.progress.pretrain_steps}
    facts |= model.hyperparameters.as_dict() | {"dataset": model.dataset.fingerprint}
    world.check_same(facts)
    model.adapt_to_data(model.dataset)
    updates = world_model_updates(model, world, steps, accumulate, progress_bar)
    with closing(updates), Pretraining(model, steps, run_dir, callback, world) as run:
        for metrics in updates:
            run.finish_update(metrics)


class Pretraining:
    """Count, log and save the updates of pre-training, and stop it when asked.

    With a run folder the model is saved every `SAVE_EVERY` updates, at the end, and when Ctrl-C,
    SIGTERM or the callback stops it. It is never saved in the middle of an update, so that training
    that continues from the file equals training that was never stopped.

    Example::

        with Pretraining(agent, steps=1000, run_dir="runs/all") as run:
            for metrics in updates:
                run.finish_update(metrics)

    :param agent: with `save`, `progress.pretrain_steps`, `tensorboard_log` and `verbose`
    :param steps: number of updates in all
    :param run_dir: folder of `model.zip` and of the log
    :param callback: called after every update with (step, metrics)
    :param world: the processes that share the work; rank 0 alone logs, saves and calls back
    """

    def __init__(
        self,
        agent: Any,
        steps: int,
        run_dir: Path | None = None,
        callback: Callback | None = None,
        world: World | None = None,
    ) -> None:
        if callback is not None and not callable(callback):
            raise ValueError(
                f"callback is called with (step, metrics), and a {type(callback).__name__} cannot "
                "be: pass a function. Callbacks of Stable-Baselines3 are for `learn`"
            )
        self.agent = agent
        self.steps = steps
        self.run_dir = run_dir
        self.callback = callback
        self.world = world or World()
        self.signals = StopSignals()
        self.log: PretrainingLog | None = None
        self.unlock = ExitStack()

    def __enter__(self) -> Self:
        agent = self.agent
        done = agent.progress.pretrain_steps
        if self.world.rank == 0:
            # Equal counts are no mistake: the same call opens a finished model again.
            if self.run_dir is not None and done > self.steps:
                warnings.warn(
                    f"{self.run_dir} holds a model of {done} updates already, so that steps="
                    f"{self.steps} makes none: to train it further pass steps above {done}",
                    stacklevel=4,
                )
            if agent.verbose:
                print(agent)
        if self.run_dir is not None:
            self.signals.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self.log is not None:
            self.log.close()
        self.unlock.close()
        self.signals.__exit__()

    def finish_update(self, metrics: Metrics) -> None:
        """Count an update and log it, call back, and save or stop where it is time."""
        agent = self.agent
        progress = agent.progress
        if self.log is None and self.world.rank == 0:  # not sooner: a refusal leaves no files
            before = progress.pretrain_steps
            self._lock()
            self.log = PretrainingLog(self.run_dir, agent.tensorboard_log, agent.verbose, before)
        progress.pretrain_steps += 1
        step = progress.pretrain_steps
        if self.log is not None:
            self.log.add(metrics)
        if self.callback is not None and self.world.rank == 0:
            try:
                self.callback(step, {k: float(v) for k, v in metrics.items()})
            except (KeyboardInterrupt, SystemExit):
                self._save()
                raise
        stop = self.world.largest(self.signals.received, agent.device)
        if stop or step % SAVE_EVERY == 0 or step == self.steps:
            self._save()
            self.world.barrier()  # no process goes on, or ends, before the file is there
        if stop:
            self.signals.deliver(stop)

    def _lock(self) -> None:
        """Lock the run folder; raise a ValueError if another process trains in it."""
        if self.run_dir is None:
            return
        self.run_dir.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.run_dir, os.O_RDONLY)
        self.unlock.callback(os.close, descriptor)
        try:
            lock(descriptor)
        except BlockingIOError as error:
            raise ValueError(
                f"Another process trains in run_dir={self.run_dir}: wait for it, or pass another "
                "run_dir"
            ) from error
        except OSError:
            pass  # a file system without locks

    def _save(self) -> None:
        if self.log is not None:
            self.log.write()
        if self.run_dir is not None and self.world.rank == 0:
            self.agent.save(self.run_dir / "model.zip")


def world_model_updates(
    model: Pretrainable, world: World, steps: int, accumulate: int, progress_bar: bool
) -> Generator[Metrics, None, None]:
    """Train a model's world model on its dataset by Eq. (1); yield each update's metrics.

    Batch k depends on the seed and k alone, so that training that is interrupted continues exactly.

    :param world: the processes that share the work; a batch is divided among them
    :param steps: number of updates in all
    :param accumulate: number of passes in which a batch, or a process's share of it, is computed,
        to save memory
    """
    assert model.dataset is not None
    learner = model.learner
    streams = model.streams
    settings = learner.hyperparameters
    start = model.progress.pretrain_steps
    batches = model.dataset.batches(
        settings.batch_size,
        settings.batch_length,
        settings.max_action_dim,
        streams.seed,
        Purpose.PRETRAIN,
        start=start,
        pin=learner.policy.device.type == "cuda",
        share=world.share(settings.batch_size),
        mark=settings.marks,
    )
    # The divided update agrees to rounding only, and several passes cost one more forward pass.
    if world.size == accumulate == 1:
        update = whole_update(learner, streams)
    else:
        update = divided_update(learner, streams, world, accumulate)
    bar = StageBar(steps, "pre-train", progress_bar, start, silent=world.rank > 0)
    with bar, closing(batches):  # closing ends the thread that reads ahead
        for step, batch in zip(range(start, steps), batches, strict=False):
            metrics = update(batch, step)
            yield metrics
            values = {}
            if step % 20 == 0 and bar.bar is not None:  # reading a loss waits for the GPU
                loss = float(metrics["train/reconstruction_loss"])
                values["reconstruction"] = f"{loss:.1f}"
            bar.update(values=values)


def whole_update(learner: WorldModelLearner, streams: Streams) -> Update:
    """Return an update on a whole batch."""
    device = learner.policy.device

    def update(batch: Batch, step: int) -> Metrics:
        generator = streams.torch(Purpose.PRETRAIN, step, device)
        _, _, metrics = learner.update_world_model(batch.to(device), generator)
        return metrics

    return update


def divided_update(
    learner: WorldModelLearner, streams: Streams, world: World, accumulate: int
) -> Update:
    """Return an update on this process's share of a batch, in several passes."""
    divided = Divided(learner, world, accumulate)

    def update(batch: Batch, step: int) -> Metrics:
        optimizer = learner.model_optimizer
        optimizer.zero_grad()
        seed = streams.integer(Purpose.PRETRAIN, step)
        loss = divided.backward(batch, learner.policy.device, seed)
        norm = learner.take_step(optimizer, loss.total, "world model")
        return world_model_metrics(loss, norm)

    return update


def common_seed(world: World, seed: int | None) -> int | None:
    """Return the seed, or if several processes have none, one new seed for all."""
    if seed is None and world.size > 1:
        return world.rank_0s(torch_seed(np.random.default_rng()))
    return seed
