"""The base of agents with WPT's networks: how the networks are made, adapted, saved and used."""

import math
import os
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar, Self

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from wpt_agents.agents.base import PixelAgent
from wpt_agents.agents.official import export_model, import_model
from wpt_agents.data.convert import Data
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.retrieval import Retriever
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.units import compare_units
from wpt_agents.fast.compiled import compile_loops
from wpt_agents.model.observations import State
from wpt_agents.model.ops import definitions
from wpt_agents.model.policy import WPTPolicy
from wpt_agents.model.prior_policy import PriorPolicy
from wpt_agents.model.sizes import find_size
from wpt_agents.training.checks import check_dataset, check_trajectory
from wpt_agents.training.ends import time_limit
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.learner import Learner
from wpt_agents.training.model_files import WORLD_MODEL, write_world_model
from wpt_agents.training.progress import WorldModelProgress
from wpt_agents.training.randomness import Purpose
from wpt_agents.training.spaces import check_spaces

INITIAL_IMAGES = 128, 4  # sequences, and images of each, that a new posterior is adapted to


class WorldModelAgent(PixelAgent, keywords=Hyperparameters, progress=WorldModelProgress):
    """The base of agents with a world model, an actor, a critic and a prior actor.

    `WPT` adds the training.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"WPTPolicy": WPTPolicy}
    shape_keywords = ("size", "max_action_dim")
    policy: WPTPolicy
    learner: Learner
    hyperparameters: Hyperparameters
    progress: WorldModelProgress

    # The networks

    def make_policy(self) -> WPTPolicy:
        """Make all networks, for actions of any width up to `max_action_dim`."""
        settings = self.hyperparameters
        policy = WPTPolicy(
            self.observation_space,
            self.unbound_action_space(),
            find_size(settings.size),
            settings.max_action_dim,
            settings.unimix,
            settings.value("zero_init_heads"),
            settings.actor_outscale,
            settings.bin_range,
        ).to(self.device)
        if settings.compile:
            compile_loops(policy)
        return policy

    def make_learner(self) -> Learner:
        """Make the optimisers."""
        return Learner(self.policy, self.hyperparameters)

    def unbound_action_space(self) -> spaces.Box:
        """Return the action space of a model without an environment, which is padded."""
        return spaces.Box(-1.0, 1.0, (self.hyperparameters.max_action_dim,), np.float32)

    def adapt_to_data(self, data: TrajectoryDataset | ReplayBuffer) -> None:
        """Standardise a new world model's posterior by 512 images of the data, once."""
        settings = self.hyperparameters
        if settings.data_dependent_init and not self.progress.initialised:
            rng = self.streams.numpy(Purpose.INITIALISE, 0)
            batch = data.sample(*INITIAL_IMAGES, settings.max_action_dim, rng)
            self.policy.world_model.standardise(batch.image.flatten(0, 1).to(self.device))
        self.progress.initialised = True

    def learn_ends(self) -> None:
        """Add the continue head once an episode of the task has terminated."""
        model = self.policy.world_model
        if not self.hyperparameters.continue_head or model.continue_head is not None:
            return
        if ends := sum(episode.terminated for episode in self.replay_buffer.trajectories):
            odds = len(self.replay_buffer) / ends  # even odds would halve all values at first
            seed = self.streams.integer(Purpose.CONTINUE, 0)
            model.make_continue_head(math.log(odds), seed)
            self.learner.add_continue_head()

    def fit_reward_ensemble(self) -> None:
        """Replace the further reward heads if `reward_ensemble` asks for another number of them."""
        model = self.policy.world_model
        number = self.hyperparameters.reward_ensemble - 1
        if len(model.reward_members) != number:
            model.make_reward_members(self.member_seeds(number))
            self.learner.add_reward_members()

    def member_seeds(self, number: int) -> list[int]:
        """Return the seeds of the further reward heads."""
        return [self.streams.integer(Purpose.ENSEMBLE, k) for k in range(number)]

    def fit_networks(self, weights: Mapping[str, Tensor]) -> None:
        """Add or remove continue head, further reward heads and imitator, so that weights fit."""
        if not weights:
            return
        model = self.policy.world_model
        model.continue_head = None
        if any(name.startswith("world_model.continue_head.") for name in weights):
            model.make_continue_head(log_odds=0.0, seed=0)
        self.learner.add_continue_head()
        start = "world_model.reward_members."
        members = {name.split(".")[2] for name in weights if name.startswith(start)}
        model.make_reward_members(self.member_seeds(len(members)))
        self.learner.add_reward_members()
        self.policy.fit_actors(weights)
        self.learner.add_imitator()

    def restore(
        self,
        header: Mapping[str, Any],
        tensors: Mapping[str, Mapping[str, Tensor]],
        same: tuple[str, ...],
    ) -> None:
        """Restore the weights, optimisers and counters of a model file.

        If the file contains a world model alone, the counters of the task start at 0.
        """
        if WORLD_MODEL in tensors:
            before = self.progress_class.of(header["counters"])
            kept = {name: getattr(before, name) for name in ("pretrain_steps", "initialised")}
            header = {**header, "counters": self.progress_class(**kept).as_dict()}
        super().restore(header, tensors, same)
        self.choose_who_acts()

    def _check_same(
        self,
        header: Mapping[str, Any],
        tensors: Mapping[str, Mapping[str, Tensor]],
        names: tuple[str, ...],
    ) -> None:
        """Raise a ValueError for other shapes, or other bins than heads were trained with."""
        learned = WORLD_MODEL not in tensors and header["counters"].get("updates")
        super()._check_same(header, tensors, (*names, "bin_range") if learned else names)

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """Load weights and optimisers in place; a loaded posterior is not adapted to data.

        The parameters are those of `SavedAgent.set_parameters`.
        """
        super().set_parameters(*args, **kwargs)
        self.progress.initialised = True
        self.choose_who_acts()

    def choose_who_acts(self) -> None:
        """Decide by the keywords whether prior actor and average actor take part in acting.

        With `ibrl` or `residual`, the prior actor takes part once it is trained. If the average is
        switched off, it is dropped.
        """
        self.policy.ibrl = self.hyperparameters.ibrl and self.progress.cloned
        self.policy.residual = self.hyperparameters.residual and self.progress.cloned
        if not self.hyperparameters.actor_average:
            self.policy.average(0.0)

    def operations(self) -> AbstractContextManager[None]:
        """Return the context in which the networks compute, which depends on the keyword `fast`."""
        return nullcontext() if self.hyperparameters.fast else definitions()

    # Collecting and learning

    @property
    def updates_per_step(self) -> float:
        """The number of updates for each collected step, of which each replays B x T steps."""
        settings = self.hyperparameters
        return settings.train_ratio / (settings.batch_size * settings.batch_length)

    def cheaper_updates(self, steps: int) -> str:
        """Return a line of code that makes `steps` collected steps enough for an update."""
        settings = self.hyperparameters
        ratio = math.ceil(settings.batch_size * settings.batch_length / max(steps, 1))
        return f"model.train_ratio = {ratio}"

    def expected_length(self) -> int:
        """Return the expected number of steps of a trajectory, for the guidance window.

        It is the keyword `episode_length`, else the length of the longest trajectory so far, else
        the environment's time limit, else 500, and at most `max_trajectory_length`: if an episode
        is stored in parts, each part has a guidance window of its own.
        """
        known = self.hyperparameters.episode_length or self.progress.seen_length
        # 500 calls of `env.step` are an episode of DMControl at action repeat 2.
        length = known or time_limit(self.env) or 500
        return min(length, self.hyperparameters.max_trajectory_length)

    def on_episode(self, trajectory: Trajectory) -> None:
        """Log how well the world model predicts an episode that it has not replayed yet."""
        for name, error in self.policy.heldout_errors(trajectory).items():
            self.logger.record_mean(f"train/heldout_{name}_error", error)

    # The data, the task and the keywords

    def check_data(self, dataset: TrajectoryDataset) -> None:
        """Raise a ValueError for a dataset that WPT cannot learn from."""
        settings = self.hyperparameters
        check_dataset(dataset, settings.max_action_dim, settings.batch_length)

    def check_env(self, env: VecEnv) -> None:
        """Raise a ValueError for an environment that WPT cannot act in."""
        check_spaces(env, self.hyperparameters.max_action_dim, self.progress.initialised)

    def check_units(self) -> None:
        """Warn if the environment's actions are in other units than those of the dataset."""
        if self.dataset is not None and self.env is not None:
            compare_units(self.dataset, self.action_space, self.hyperparameters.embodiment)

    def on_other_actions(self) -> None:
        """Reset the task if one was begun, because its actions have another width."""
        if self.begun:
            with self.streams.weights(Purpose.REDRAW, self.progress.episodes, self.device):
                self.reset_task()

    @property
    def begun(self) -> bool:
        """Whether anything was collected or learnt for a task."""
        return self.progress.episodes + self.progress.cut > 0

    def reset_task(self) -> None:
        """Keep the world model and discard everything else, for another task.

        The optimisers, also that of the world model, start again with zero averages.
        """
        self.progress.reset("cloned", "task_updates")
        super().reset_task()
        self.choose_who_acts()

    def hyperparameters_changed(self) -> None:
        """Let the learner use the changed keywords; raise a ValueError if the data forbid them."""
        if self.dataset is not None:
            self.check_data(self.dataset)
        self.learner.configure(self.hyperparameters)
        self.choose_who_acts()

    # What a model can show

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, State]:
        """Return actions for observations, and the recurrent state for the next call, as in SB3.

        :param observation: (64, 64, 3) or (n, 64, 64, 3) uint8, or a Dict with one image; channels
            first and other sizes are converted
        :param state: the state that the last call returned; None at the start of an episode
        :param episode_start: (n,) bool, the environments whose episode has just begun
        :param deterministic: act by the most likely latent state and the mean action
        :return: (A,) or (n, A) in the bounds of the environment's actions, and the next state
        :raises ValueError: an observation that is not an image, a state of another number of
            environments, or weights that are not finite
        """
        with self.operations():
            return self.policy.predict(observation, state, episode_start, deterministic)

    @property
    def prior(self) -> PriorPolicy | None:
        """The prior actor as a policy with `predict`, or None before it is trained."""
        return PriorPolicy(self.policy) if self.progress.cloned else None

    def build_index(self, progress_bar: bool = False) -> Retriever:
        """Return the index of the dataset's first images, which is kept beside the dataset.

        :param progress_bar: show a progress bar
        :return: the index, a `Retriever`
        :raises ValueError: the agent has no dataset
        """
        if self.dataset is None:
            raise ValueError("No dataset to index: pass dataset= to load or WPT")
        policy = self.policy
        with self.operations():
            return Retriever.beside(self.dataset, policy.embed, policy.encoder_id(), progress_bar)

    def open_loop(self, trajectory: Trajectory, context: int = 5, horizon: int = 40) -> np.ndarray:
        """Predict a trajectory's images from its first images and all actions.

        :param trajectory: images to start from and actions to follow
        :param context: number of images that the model sees; these are reconstructed
        :param horizon: number of images to predict after them, at most

        :return: (context + horizon, 64, 64, 3) uint8, or fewer images if the trajectory is shorter;
            the first `context` are reconstructions
        :raises ValueError: no context, more actions than the model takes, images of another size
        """
        check_trajectory(trajectory, self.hyperparameters.max_action_dim, context)
        with self.operations():
            return self.policy.open_loop(trajectory, context, horizon)

    # Weights for others, and the authors' own

    @classmethod
    def from_official(
        cls,
        path: str | os.PathLike[str],
        env: GymEnv | str | None = None,
        dataset: Data | None = None,
        stoch: int | None = None,
        **kwargs: Any,
    ) -> Self:
        """Read a model file of the paper's authors, such as `dmcontrol.pt`.

        The widths and `max_action_dim` are inferred from the shapes. Reward head, actor, critic and
        target critic are read if the file has them; otherwise they are initialised.

        :param path: a `torch.save` file of nested state dicts; it is read with `weights_only=True`
        :param env: the environment to continue with
        :param dataset: data for rehearsal and guidance, such as the authors' folder
            `ncrl_datasets/dmcontrol`
        :param stoch: groups of z, if they are not the authors' 32
        :param kwargs: further keywords of `WPT`
        :raises FileNotFoundError: no such file
        :raises ValueError: a file that is cut short or damaged, contains more than weights, or is
            not in the authors' format
        """
        cls.check_keywords(kwargs)
        lean = cls.make_policy is WorldModelAgent.make_policy  # explorers have further networks
        model: Self = import_model(cls, path, stoch, lean, dataset, env, **kwargs)
        return model

    def save_world_model(self, path: str | os.PathLike[str]) -> None:
        """Write encoder, RSSM and decoder alone, in bfloat16: a small file to share.

        `load` reads it. The other networks are then new, and so are the optimisers.

        :param path: a file name that ends in .zip
        """
        write_world_model(path, self.description(), self.policy)

    def save_official(self, path: str | os.PathLike[str]) -> None:
        """Write the weights in the authors' format, so that their scripts can read them.

        Actor, critic, target critic and reward head are written, too, trained or not.

        :param path: the file
        :raises ValueError: a model whose `Size` has other `gates` or `norm_eps` than the authors'
        """
        export_model(self.policy, path)
