"""// Task-Agnostic World Model Pre-Training of Algorithm 1: `WPT.pretrain`, on one device or many.

`WPT` inherits `Pretraining`, so that `wpt.py` holds what is done for a task and this module what
comes before.
"""

import os
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Self

import numpy as np
from stable_baselines3.common.type_aliases import GymEnv
from torch import Tensor
from tqdm.auto import tqdm

from wpt_agents.data.convert import Data
from wpt_agents.data.trajectory import Batch
from wpt_agents.files.model_file import read_model
from wpt_agents.model.networks import Size
from wpt_agents.training.distributed import Divided, World, joined, local_device
from wpt_agents.training.saving import Saving
from wpt_agents.training.updates import PRETRAIN, Updates, note, torch_seed

EVERY = 1000  # steps between checkpoints


class Pretraining(Updates, Saving):
    """What `WPT` learns without a task."""

    set_dataset: Callable[[Data | None], None]
    pretrain_steps: int

    @classmethod
    def pretrain(
        cls,
        dataset: Data,
        env: GymEnv | str | None = None,
        steps: int = 200_000,
        size: str | Size | Mapping[str, Any] = "paper",
        run_dir: str | os.PathLike[str] | None = None,
        seed: int | None = None,
        progress_bar: bool = False,
        callback: Callable[[int, dict[str, float]], Any] | None = None,
        accumulate: int = 1,
        **kwargs: Any,
    ) -> Self:
        """Trains a world model on reward-free trajectories of any embodiments, by Eq. (1).

        Started by `torchrun`, the processes divide each batch among them, learn what one would
        learn from it, and all return the model; rank 0 alone writes, calls back and has the bar.

        :param dataset: a TrajectoryDataset or its path, other people's files, trajectories:
            whatever `TrajectoryDataset.of` takes
        :param env: the environment to go on with, if known
        :param steps: updates
        :param run_dir: `model.zip` is written there every 1000 steps and at the end; if it is
            there already, training goes on from it, on any number of processes
        :param callback: called after every update with (step, metrics)
        :param accumulate: passes over a batch, or a process's share of it, to save memory
        :param kwargs: keywords of `WPT`; `batch_size` is that of all processes and passes together
        :raises ValueError: an empty dataset, one without a trajectory as long as `batch_length`,
            with other images or wider actions; an unknown keyword; a batch that cannot be divided
        """
        cls._check_keywords(kwargs)
        kwargs["device"] = local_device(kwargs.get("device", "auto"))
        with joined(kwargs["device"]) as world:
            model: Self = cls(size=size, seed=_common(world, seed), **kwargs)
            with world.rank_0_first():
                model.set_dataset(dataset)
            path = Path(run_dir) / "model.zip" if run_dir is not None else None
            if path is not None and path.exists():
                kept = "size", "max_action_dim", "batch_size", "batch_length"
                model._take(*read_model(path), kept)
            model._pretrain(world, steps, accumulate, path, progress_bar, callback)
        if env is not None:
            model.set_env(env)
        return model

    def _pretrain(
        self,
        world: World,
        steps: int,
        accumulate: int,
        path: Path | None,
        progress_bar: bool,
        callback: Callable[[int, dict[str, float]], Any] | None,
    ) -> None:
        assert self.dataset is not None
        done, first = self.pretrain_steps, world.rank == 0
        told = {"steps": steps, "pretrain_steps": done, "accumulate": accumulate}
        world.check_same(told | self.hyperparameters | {"dataset": self.dataset.fingerprint})
        self._initialise(self.dataset)
        shape = self.batch_size, self.batch_length, self.max_action_dim
        pin, share = self.device.type == "cuda", world.share(self.batch_size)
        batches = self.dataset.batches(
            *shape, self.stream_seed, PRETRAIN, start=done, pin=pin, share=share
        )
        update = self._pretrain_update(world, accumulate)
        hidden = not (progress_bar and first)
        bar = tqdm(total=steps, initial=done, desc="pre-train", disable=hidden)
        with bar, closing(batches):
            for step, batch in zip(range(done, steps), batches, strict=False):
                metrics: dict[str, list[Tensor]] = defaultdict(list)
                update(batch, metrics, step)
                self.pretrain_steps = step + 1
                if callback is not None and first:
                    callback(self.pretrain_steps, {k: float(v[0]) for k, v in metrics.items()})
                if step % 20 == 0:
                    loss = float(metrics["train/reconstruction_loss"][0])
                    bar.set_postfix(reconstruction=f"{loss:.1f}")
                bar.update()
                if path is not None and ((step + 1) % EVERY == 0 or step + 1 == steps):
                    if first:
                        self.save(path)
                    world.barrier()

    def _pretrain_update(
        self, world: World, accumulate: int
    ) -> Callable[[Batch, dict[str, list[Tensor]], int], None]:
        """An update by number: on a whole batch, or on this process's share in several passes."""

        def whole(batch: Batch, metrics: dict[str, list[Tensor]], step: int) -> None:
            generator = self._generator(PRETRAIN, step)
            self._update_world_model(batch.to(self.device), metrics, generator)

        def share(batch: Batch, metrics: dict[str, list[Tensor]], step: int) -> None:
            self.model_optimizer.zero_grad()
            seed = torch_seed(self._stream(PRETRAIN, step))
            loss = divided.backward(batch, self.device, seed)
            norm = self._step(self.model_optimizer, loss.total, "world model")
            note(metrics, loss, norm)

        if world.size == accumulate == 1:
            return whole
        divided = Divided(
            self.policy.world_model,
            world,
            accumulate,
            self.batch_size,
            self._autocast,
            self._eq_1_options,
        )
        return share


def _common(world: World, seed: int | None) -> int | None:
    """The seed given; where several processes got none, the same new one for all."""
    if seed is None and world.size > 1:
        return world.rank_0s(torch_seed(np.random.default_rng()))
    return seed
