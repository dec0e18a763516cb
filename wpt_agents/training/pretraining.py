"""// Task-Agnostic World Model Pre-Training of Algorithm 1, on one device or many."""

from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from tqdm.auto import tqdm

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Batch
from wpt_agents.training.distributed import Divided, World
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.progress import WorldModelProgress
from wpt_agents.training.randomness import Purpose, Streams, torch_seed
from wpt_agents.training.world_model_learner import (
    Metrics,
    WorldModelLearner,
    world_model_metrics,
)

EVERY = 1000  # updates between two model files

Update = Callable[[Batch, int], Metrics]  # called with a batch and the update's number
Callback = Callable[[int, dict[str, float]], Any]  # called with the updates made and the metrics


class Pretrainable(Protocol):
    """What an agent must have so that `pretrain` can train its world model."""

    @property
    def dataset(self) -> TrajectoryDataset | None:
        """The trajectories to learn from."""

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The keywords."""

    @property
    def learner(self) -> WorldModelLearner:
        """What updates the world model."""

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
    path: Path | None = None,
    progress_bar: bool = False,
    callback: Callback | None = None,
) -> None:
    """Train a model's world model on its dataset, up to `steps` updates in all.

    :param world: the processes that share the work; rank 0 alone writes files and calls back
    :param accumulate: passes over a batch, or a process's share of it, to save memory
    :param path: where the model file is written every 1000 updates and at the end
    :param callback: called after every update
    """
    assert model.dataset is not None
    done = model.progress.pretrain_steps
    facts = {"steps": steps, "pretrain_steps": done, "accumulate": accumulate}
    facts |= model.hyperparameters.as_dict() | {"dataset": model.dataset.fingerprint}
    world.check_same(facts)
    model.adapt_to_data(model.dataset)
    updates = world_model_updates(
        model.learner, model.dataset, model.streams, world, done, steps, accumulate, progress_bar
    )
    with closing(updates):
        for metrics in updates:
            done += 1
            model.progress.pretrain_steps = done
            if callback is not None and world.rank == 0:
                callback(done, {name: float(value) for name, value in metrics.items()})
            if path is not None and (done % EVERY == 0 or done == steps):
                if world.rank == 0:
                    model.save(path)
                world.barrier()  # no process goes on, or ends, before the file is there


def world_model_updates(
    learner: WorldModelLearner,
    dataset: TrajectoryDataset,
    streams: Streams,
    world: World,
    start: int,
    steps: int,
    accumulate: int = 1,
    progress_bar: bool = False,
) -> Generator[Metrics, None, None]:
    """Train a world model on reward-free trajectories by Eq. (1); yield each update's metrics.

    Batch k depends on the seed and k alone, so that training that is interrupted continues exactly.

    :param world: the processes that share the work; a batch is divided among them
    :param start: updates that were made before
    :param steps: updates in all
    :param accumulate: passes over a batch, or a process's share of it, to save memory
    """
    settings = learner.hyperparameters
    batches = dataset.batches(
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
    shown = progress_bar and world.rank == 0
    bar = tqdm(total=steps, initial=start, desc="pre-train", disable=not shown)
    with bar, closing(batches):  # closing ends the thread that reads ahead
        for step, batch in zip(range(start, steps), batches, strict=False):
            metrics = update(batch, step)
            yield metrics
            if step % 20 == 0:  # reading a loss waits for the GPU
                loss = float(metrics["train/reconstruction_loss"])
                bar.set_postfix(reconstruction=f"{loss:.1f}")
            bar.update()


def whole_update(learner: WorldModelLearner, streams: Streams) -> Update:
    """Return an update on a whole batch."""
    device = learner.policy.device

    def update(batch: Batch, step: int) -> Metrics:
        generator = streams.torch(Purpose.PRETRAIN, step, device)
        return learner.update_world_model(batch.to(device), generator)[1]

    return update


def divided_update(
    learner: WorldModelLearner, streams: Streams, world: World, accumulate: int
) -> Update:
    """Return an update on this process's share of a batch, in several passes."""
    settings = learner.hyperparameters
    divided = Divided(
        learner.policy.world_model,
        world,
        accumulate,
        settings.batch_size,
        learner.autocast,
        learner.eq_1_options,
    )

    def update(batch: Batch, step: int) -> Metrics:
        optimizer = learner.model_optimizer
        optimizer.zero_grad()
        seed = streams.integer(Purpose.PRETRAIN, step)
        loss = divided.backward(batch, learner.policy.device, seed)
        norm = learner.take_step(optimizer, loss.total, "world model")
        return world_model_metrics(loss, norm)

    return update


def common_seed(world: World, seed: int | None) -> int | None:
    """Return the seed, or if several processes have none, the same new one for all."""
    if seed is None and world.size > 1:
        return world.rank_0s(torch_seed(np.random.default_rng()))
    return seed
