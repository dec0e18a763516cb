"""WPT, Algorithm 1: pre-train on reward-free data, then retrieve, clone, collect and update.

Example::

    model = WPT.pretrain("data/dmc", steps=200_000)
    model.set_env("wpt/dmc-walker-run-v0")
    model.learn(75_000)
    action, state = model.predict(obs, state, episode_start, deterministic=True)
"""

import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any, Self

import numpy as np
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from wpt_agents.agents.base import MetricLists
from wpt_agents.agents.world_model_agent import WorldModelAgent
from wpt_agents.data.bars import shown
from wpt_agents.data.convert import Data
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer, mix
from wpt_agents.data.trajectory import Batch, Trajectory
from wpt_agents.files.model_file import read_model
from wpt_agents.model.actor_critic import debiased_fraction
from wpt_agents.model.prior_policy import prior_action
from wpt_agents.model.sizes import Size, find_size
from wpt_agents.training import pretraining
from wpt_agents.training.cloning import Cloning, clone
from wpt_agents.training.distributed import joined, local_device
from wpt_agents.training.guidance import draw_window
from wpt_agents.training.imitating import STEPS_PER_BATCH, imitate
from wpt_agents.training.keywords import Stage
from wpt_agents.training.progress import WPTProgress
from wpt_agents.training.randomness import Purpose
from wpt_agents.training.retrieving import read_retrieved, retrieve_ids, with_kept
from wpt_agents.training.rollout import FROM_LATER, FROM_WARM_UP, Window

NO_DATASET = (
    "No dataset: nothing is rehearsed, there is no prior actor to guide or to imitate, and "
    "model.prior stays None. Pass dataset= to WPT or load, or pass offline_ratio=0, guidance=0, "
    "kickstart=0, adapt_steps=0, without ibrl and residual, if this is intended"
)


class WPT(WorldModelAgent, progress=WPTProgress):
    """Generalist world-model pre-training and fine-tuning, with the methods of Stable-Baselines3.

    Example::

        model = WPT.pretrain("data/dmc", size="small", steps=20_000)
        model.set_env("wpt/dmc-walker-run-v0")
        model.learn(75_000).save("walker.zip")

    `WPT("WPTPolicy", env, offline_ratio=0, guidance=0)` learns from scratch. The defaults are those
    of Table 2 of the paper. Steps are calls of `env.step`, which are 2 frames each at action repeat
    2.

    :param policy: "WPTPolicy"
    :param env: an id, a Gymnasium environment or a VecEnv with image observations and Box actions
    :param dataset: data for rehearsal and guidance (D_off in the paper): a `TrajectoryDataset`, the
        path of one or of files in another format, a replay buffer, trajectories, or a list of these
    :param tensorboard_log: folder of the TensorBoard events
    :param verbose: 0 for nothing, 1 for information
    :param device: "auto", "cpu", "cuda", ...
    """

    saved_as = "WPT"
    warmup_pays = True
    progress: WPTProgress
    retrieved: ReplayBuffer | None = None  # D_retrieval
    kept: ReplayBuffer | None = None  # episodes of earlier tasks, to retrieve from without rewards

    # // Task-Agnostic World Model Pre-Training

    @classmethod
    def pretrain(
        cls,
        dataset: Data,
        env: GymEnv | str | None = None,
        steps: int | None = None,
        size: str | Size | Mapping[str, Any] = "paper",
        run_dir: str | os.PathLike[str] | None = None,
        seed: int | None = None,
        progress_bar: bool = False,
        callback: pretraining.Callback | None = None,
        accumulate: int = 1,
        **kwargs: Any,
    ) -> Self:
        """Train a world model on reward-free trajectories of one or several robots, by Eq. (1).

        With `torchrun`, the processes divide each batch among them, learn what one process would
        learn from it, and all return the model; rank 0 alone writes files, calls the callback and
        shows the progress bar.

        :param dataset: what the keyword `dataset` of `WPT` takes
        :param env: the environment to continue with, if known
        :param steps: number of updates in total; if None, it depends on the size (200,000 for
            `paper`)
        :param size: widths of all networks, as the keyword of `WPT`
        :param run_dir: folder of `model.zip`, which is written every 1,000 updates, at the end, and
            on Ctrl-C or SIGTERM, and of the learning curve, `progress.csv` and TensorBoard events.
            If a model is there, training continues from it, on any number of processes
        :param seed: seed of all random numbers; None: a random seed
        :param progress_bar: show a progress bar
        :param callback: called after every update with (step, metrics)
        :param accumulate: number of passes in which a batch, or a process's share of it, is
            computed, to save memory
        :param kwargs: keywords of `WPT`, also `tensorboard_log`; `batch_size` is that of all
            processes and passes together
        :raises ValueError: an empty dataset, one without a trajectory as long as `batch_length`,
            with other images or wider actions; an unknown keyword; a batch that cannot be divided
        :raises FloatingPointError: a loss or gradient that is not finite; the last checkpoint stays
        """
        cls.check_keywords(kwargs)
        device = local_device(kwargs.pop("device", "auto"))
        with joined(device) as world:
            seed = pretraining.common_seed(world, seed)
            model = cls(size=size, seed=seed, device=device, **kwargs)
            # Checked now, so that a wrong environment does not fail after days of training.
            checked = None if env is None else model._checked(env)
            with world.rank_0_first():
                model.set_dataset(dataset)
            folder = Path(run_dir) if run_dir is not None else None
            if folder is not None and (folder / "model.zip").exists():
                same = (*cls.shape_keywords, "batch_size", "batch_length")
                saved = read_model(folder / "model.zip")
                model.restore(*saved, same)
                model.warn_if_late(*saved)
            steps = find_size(model.hyperparameters.size).pretrain_steps if steps is None else steps
            steps = int(steps)  # a float such as 2e4 is allowed
            with model.operations():
                pretraining.pretrain(
                    model, world, steps, accumulate, folder, progress_bar, callback
                )
        if checked is not None:
            model._use_env(checked)
        return model

    # // Task-Specific Training

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "WPT",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Fine-tune on the task (Algorithm 1): retrieve, clone, then collect and update in turns.

        :param total_timesteps: calls of `env.step`, summed over the environments, as in SB3. With
            0 there is no step, only what precedes the first one: retrieval, cloning, `adapt_steps`
        :param callback: SB3's callbacks
        :param log_interval: stored episodes between two dumps of the log
        :param tb_log_name: name of the run's folder in `tensorboard_log`
        :param reset_num_timesteps: count steps and advance schedules from 0 again; False continues
        :param progress_bar: show a progress bar of each stage
        :return: the model itself
        :raises ValueError: no environment, `total_timesteps` that are not a whole number of at
            least 0, or rewards that are not finite
        :raises FloatingPointError: a loss or gradient that is not finite; the weights are kept
        """
        with (
            self.operations(),
            self.learning(
                total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
            ) as callback,
        ):
            self.retrieve(progress_bar)
            self.clone(progress_bar)
            self.adapt(progress_bar)
            while self.unfinished and self.collect(callback, log_interval):
                self.update_models()
        return self

    def retrieve(self, progress_bar: bool = False) -> None:
        """Retrieve the R trajectories whose first images are most like the task's, by Eq. (5)."""
        settings = self.hyperparameters
        if not settings.retrieves:
            return
        if self.dataset is None:
            self._warn_without_dataset()
            return
        if self.retrieved is not None and not self.outdated:
            return
        kept = self.kept.trajectories if self.kept is not None else []
        if not self.progress.retrieved_ids or self.outdated:
            self._search(self.dataset, kept, progress_bar)
        retrieved = ReplayBuffer()
        ids = self.progress.retrieved_ids
        trajectories = read_retrieved(self.dataset, kept, ids, self.action_space)
        for trajectory in shown(trajectories, len(ids), "retrieve", progress_bar):
            retrieved.add(replace(trajectory, reward=None))
        self.retrieved = retrieved  # only when it is complete, in case of an interruption

    def _search(
        self, dataset: TrajectoryDataset, kept: list[Trajectory], progress_bar: bool
    ) -> None:
        """Find the trajectories to retrieve, and discard what depends on earlier ones."""
        progress = self.progress
        settings = self.hyperparameters
        outdated = self.outdated
        query = self.policy.embed(self.first_images(settings.retrieval_images))
        index = self.build_index(progress_bar)
        if kept:
            index = with_kept(index, kept, self.policy.embed)
        width = self.action_space.shape[0]
        progress.retrieved_ids = retrieve_ids(index, dataset, query, width, settings, self.streams)
        progress.retrieved_of = dataset.fingerprint
        self.retrieved = None  # now, because reading the new ones may be interrupted
        if outdated:
            progress.adapted = 0
            # If it is not cloned again, the prior actor of the old ones stays.
            progress.cloned = progress.cloned and not settings.needs_clone
            self.choose_who_acts()

    def _warn_without_dataset(self) -> None:
        """Warn if the missing dataset prevents cloning or rehearsal."""
        settings = self.hyperparameters
        lacks_clone = settings.needs_clone and not self.progress.cloned
        if lacks_clone or not self.progress.retrieved_ids:
            warnings.warn(NO_DATASET, stacklevel=4)
        elif settings.offline_ratio:
            what = "Without its dataset the model rehearses nothing: load it with dataset="
            warnings.warn(f"{what}, or with offline_ratio=0 if this is intended", stacklevel=4)

    def clone(self, progress_bar: bool = False) -> None:
        """Train the prior actor on the retrieved trajectories, once for a task."""
        settings = self.hyperparameters
        if self.retrieved is None or self.progress.cloned or not settings.needs_clone:
            return
        actor = clone(
            self.policy.prior_actor,
            self.retrieved.trajectories,
            self.policy.action_mask,
            Cloning.of(settings, settings.grad_clip),
            self.streams,
            progress_bar,
            self.learner.autocast,
        )
        self.policy.prior_actor.load_state_dict(actor.state_dict())
        self.progress.cloned = True
        self.choose_who_acts()

    def adapt(self, progress_bar: bool = False) -> None:
        """Train the world model on the retrieved trajectories alone (`adapt_steps`, Eq. 1)."""
        settings = self.hyperparameters
        progress = self.progress
        shape = settings.batch_size, settings.batch_length, settings.max_action_dim
        left = settings.adapt_steps - progress.adapted
        if self.retrieved is None or left <= 0:
            return
        self.adapt_to_data(self.retrieved)
        for _ in shown(range(left), left, "adapt", progress_bar):
            rng = self.streams.numpy(Purpose.ADAPT, progress.adapted)
            generator = self.streams.torch(Purpose.ADAPT, progress.adapted, self.device)
            batch = self.retrieved.sample(*shape, rng, settings.marks).to(self.device)
            self.learner.update_world_model(batch, generator)
            progress.adapted += 1

    # // Collect Data: the loop is `PixelAgent.collect`, which calls these

    def guidance_window(self, rng: np.random.Generator) -> Window:
        """Return the steps of a new episode at which the prior actor acts."""
        guided = self.hyperparameters.guidance_at(self.num_timesteps)
        return draw_window(guided if self.progress.cloned else 0.0, self.expected_length(), rng)

    @property
    def warmup_driver(self) -> str:
        """What chooses the actions in the warm-up, as words for messages."""
        guided = self.progress.cloned or (self.dataset and self.hyperparameters.needs_clone)
        return "the prior actor's actions" if guided else super().warmup_driver

    def guide(self, frames: np.ndarray) -> np.ndarray:
        """Return the prior actor's actions, or random ones: (k, F, 64, 64, 3) uint8 -> (k, A)."""
        return prior_action(self.policy, frames) if self.progress.cloned else super().guide(frames)

    # // Update Models

    @property
    def head_start(self) -> int:
        """The number of updates of the head start (`actor_delay`) that remain."""
        return max(self.hyperparameters.actor_delay - self.progress.task_updates, 0)

    def steps_to_update(self) -> float:
        """Return the number of collected steps for each update, 0 while a head start is due."""
        return 0.0 if self.head_start else super().steps_to_update()

    def updates_due(self) -> int:
        """Return the number of updates to make now, for the collected steps or the head start."""
        return max(super().updates_due(), self.head_start)

    def update(self, metrics: MetricLists) -> None:
        """Make one update of every network on a mixed batch; append to `metrics`."""
        progress = self.progress
        self.prepare_update()
        batch = self.mixed_batch(self.streams.numpy(Purpose.UPDATE, progress.updates))
        generator = self.streams.torch(Purpose.UPDATE, progress.updates, self.device)
        with self.operations():
            update = self.learner.update(
                batch, generator, self.num_timesteps, self.imitation_weight(), self.head_start > 0
            )
        for name, value in update.items():
            metrics[name].append(value)
        self.policy.average(self.averaging())
        progress.updates += 1
        progress.task_updates += 1
        if not self.head_start:
            self.imitate(metrics)

    def imitate(self, metrics: MetricLists) -> None:
        """Let the actor imitate the prior actor from fixed latent states, once for a task."""
        settings = self.hyperparameters
        steps = settings.imitation_steps
        if self.progress.imitated or not self.progress.cloned or not steps:
            return
        rngs = (
            self.streams.numpy(Purpose.IMITATE, k) for k in range(ceil(steps / STEPS_PER_BATCH))
        )
        batches = (self.mixed_batch(rng) for rng in rngs)
        size = settings.batch_size * settings.batch_length
        with self.operations():
            actor, loss = imitate(self.learner, batches, steps, size, self.streams)
        self.policy.actor.load_state_dict(actor.state_dict())
        self.policy.updates += 1
        self.progress.imitated = True
        metrics["train/imitation_loss"].append(loss)

    def prepare_update(self) -> None:
        """Adapt a new world model, add networks that are now needed, and set learning rates."""
        settings = self.hyperparameters
        self.adapt_to_data(self.replay_buffer)
        self.learn_ends()
        self.fit_reward_ensemble()
        if settings.residual and self.progress.cloned and not self.head_start:
            self.begin_residual()
        if settings.actor_critic_decay:
            left = 1 - self.num_timesteps / max(self._total_timesteps, 1)
            self.learner.set_actor_critic_rate(max(left, 0.0))

    def mixed_batch(self, rng: np.random.Generator) -> Batch:
        """Draw the batch of an update: collected sequences, then retrieved ones."""
        settings = self.hyperparameters
        return mix(
            self.replay_buffer,
            self.retrieved,
            settings.offline_ratio,
            settings.batch_size,
            settings.batch_length,
            settings.max_action_dim,
            rng,
            settings.recent_share,
            settings.marks,
        ).to(self.device)

    def imitation_weight(self) -> float:
        """Return the weight of the loss by which the actor imitates the prior actor."""
        if not self.progress.cloned:
            return 0.0
        returns = self.collected_returns() if self.hyperparameters.adapts else ()
        weight = self.hyperparameters.kickstart_at(self.num_timesteps, *returns)
        # In the head start it is the only term of the loss, so any weight will do.
        return max(weight, 1.0) if self.head_start else weight

    def collected_returns(self) -> tuple[list[float], list[float]]:
        """Return the returns of the collected trajectories, of the warm-up and of later ones.

        Replay buffers of earlier versions do not name the source of a trajectory. There, a
        trajectory is of the warm-up if fewer than `warmup_steps` steps are stored before it.

        :return: the returns of the warm-up, and the later ones, in the order of collection
        """
        returns: tuple[list[float], list[float]] = ([], [])
        start = 0  # the number of steps that were stored before a trajectory
        for trajectory in self.replay_buffer.trajectories:
            later = start >= self.hyperparameters.value("warmup_steps")
            if trajectory.source in (FROM_WARM_UP, FROM_LATER):
                later = trajectory.source == FROM_LATER
            if trajectory.reward is not None:
                returns[later].append(float(trajectory.reward.sum()))
            start += len(trajectory)
        return returns

    def begin_residual(self) -> None:
        """Add to the prior actor's action, from now on, what the actor learns (`residual`)."""
        if self.policy.imitator is None:
            self.policy.begin_residual()
            self.learner.begin_imitator()

    def averaging(self) -> float:
        """Return the share by which the average actor follows the actor, 0 in the head start."""
        number = self.progress.task_updates - self.hyperparameters.actor_delay + 1
        share = self.hyperparameters.actor_average
        return debiased_fraction(share, number) if share and number > 0 else 0.0

    # The data and the task

    @property
    def outdated(self) -> bool:
        """Whether the retrieved trajectories are of another dataset than the current one."""
        progress = self.progress
        other = self.dataset is not None and self.dataset.fingerprint != progress.retrieved_of
        return bool(progress.retrieved_ids) and other

    @property
    def begun(self) -> bool:
        """Whether anything was collected or learnt for a task."""
        return super().begun or bool(self.progress.retrieved_ids)

    def reset_task(self, keep_data: bool = False) -> None:
        """Prepare for another task: keep the world model and discard everything else.

        Replay buffer, reward head, actor, critic, prior actor and retrieved trajectories are
        discarded. The optimisers, also that of the world model, start again with zero averages.

        :param keep_data: keep the collected episodes as reward-free data beside the dataset, so
            that the next task's trajectories are retrieved from both
        :raises ValueError: `keep_data` without a dataset
        """
        if keep_data and self.dataset is None:
            raise ValueError(
                "keep_data=True keeps episodes beside a dataset, and the agent has none: call "
                "set_dataset(dataset) first"
            )
        if keep_data:
            self.kept = self.kept or ReplayBuffer()
            for trajectory in self.replay_buffer.trajectories:
                self.kept.add(replace(trajectory, reward=None))
        self.retrieved = None
        self.progress.reset("retrieved_ids", "adapted", "imitated")
        super().reset_task()

    def next_task(self, env: GymEnv | str) -> None:
        """Begin the next task of a sequence with the world model and the episodes of earlier ones.

        The episodes are kept only if the agent has a dataset. Schedules and the count of steps
        start again.

        :param env: the environment of the next task, in any form that `set_env` takes
        :raises ValueError: an environment that the agent cannot act in; nothing is discarded then
        """
        checked = self._checked(env)
        with self.streams.weights(Purpose.REDRAW, self.progress.episodes, self.device):
            self.reset_task(keep_data=self.dataset is not None)
        self._use_env(checked)
        self.progress.restart_steps()

    def too_late(self, stage: Stage) -> str | None:
        """Return the remedy if keywords of this stage can no longer take effect, else None."""
        if stage is Stage.RETRIEVAL and self.progress.retrieved_ids and not self.outdated:
            return "the trajectories are retrieved; call reset_task() first"
        if stage is Stage.CLONING and self.progress.cloned and not self.outdated:
            return "the prior actor is cloned; call reset_task() first"
        return super().too_late(stage)
