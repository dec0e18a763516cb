"""What all agents are made of: keywords, counters, random numbers, data and an environment."""

import inspect
from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecExtractDictObs, unwrap_vec_normalize

from wpt_agents.agents.attributes import declare
from wpt_agents.agents.sb3_keywords import unknown_keyword
from wpt_agents.data.convert import Data, open_dataset
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.files.names import unknown_name
from wpt_agents.model.observations import IMAGE_SPACE
from wpt_agents.training.checks import check_device
from wpt_agents.training.environments import as_vec_env
from wpt_agents.training.keywords import Keywords, Stage
from wpt_agents.training.progress import Progress
from wpt_agents.training.randomness import Streams, free_seed
from wpt_agents.training.resets import resets
from wpt_agents.training.rollout import Rollout
from wpt_agents.training.spaces import check_spaces


class ConfiguredAgent(BaseAlgorithm):
    """An SB3 algorithm that is made of a policy, a learner, keywords and counters.

    Keywords are `hyperparameters` and counters are `progress`; both are also attributes. A subclass
    names their classes: `class DrQv2(PixelAgent, keywords=DrQv2Keywords)`.

    :param policy: the policy's name or class; the first of `policy_aliases` if None
    :param env: an id, a Gymnasium environment or a VecEnv with image observations and Box actions
    :param dataset: trajectories, for agents that learn from any: a `TrajectoryDataset`, the path of
        one or of files in another format, a replay buffer, trajectories, or a list of these
    :param tensorboard_log: folder of the TensorBoard events
    :param verbose: 0 for nothing, 1 for information
    :param device: "auto", "cpu", "cuda", ...
    """

    keywords: ClassVar[type[Keywords]] = Keywords
    progress_class: ClassVar[type[Progress]] = Progress

    policy: Any  # a BasePolicy with the methods of `training.rollout.Acting`
    learner: Any
    hyperparameters: Any  # of the class `keywords`
    progress: Any  # of the class `progress_class`
    streams: Streams
    # Counters of `progress`.
    num_timesteps: int
    episodes: int
    updates: int
    credit: float
    action_space: spaces.Box
    _last_obs: Any  # SB3's own type does not take all that a VecEnv returns
    _last_episode_starts: Any
    _resets_seen: int | None = None  # when the agent last used its environment

    if TYPE_CHECKING:  # keywords are attributes

        def __getattr__(self, name: str) -> Any: ...

    def __init_subclass__(
        cls,
        keywords: type[Keywords] | None = None,
        progress: type[Progress] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init_subclass__(**kwargs)
        cls.keywords = keywords or cls.keywords
        cls.progress_class = progress or cls.progress_class
        declare(cls, cls.keywords, cls.progress_class, cls.__init__)

    def __init__(
        self,
        policy: str | type[BasePolicy] | None = None,
        env: GymEnv | str | None = None,
        *,
        dataset: Data | None = None,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
        **keywords: Any,
    ) -> None:
        if unknown := keywords.keys() - self.keywords.declared().keys():
            raise unknown_keyword(min(unknown), self.keywords.declared())
        if isinstance(policy, str) and policy not in self.policy_aliases:
            raise unknown_name("policy", policy, self.policy_aliases)
        check_device(device)
        self.hyperparameters = self.keywords(**keywords)
        self.progress = self.progress_class()
        seed = self.hyperparameters.seed
        self.streams = Streams(free_seed() if seed is None else seed)
        super().__init__(
            policy or next(iter(self.policy_aliases)),
            None,
            learning_rate=getattr(self.hyperparameters, "learning_rate", 0.0),
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        self.dataset: TrajectoryDataset | None = None
        self.replay_buffer = ReplayBuffer()
        self.rollout: Rollout | None = None
        self.observation_space = IMAGE_SPACE
        self.n_envs = 1
        wrapped = None if env is None else self._checked(env)
        if wrapped is not None:
            assert isinstance(wrapped.action_space, spaces.Box)
            self.action_space = wrapped.action_space
        elif _init_setup_model:
            self.action_space = self.unbound_action_space()
        if _init_setup_model:
            self._setup_model()
        self.set_dataset(dataset)
        if wrapped is not None:
            self._use_env(wrapped)

    def __repr__(self) -> str:
        """The keywords that differ from their defaults or depend on the size, and the counters."""
        chosen = ", ".join(f"{k}={v!r}" for k, v in self.hyperparameters.chosen().items())
        counted = f"num_timesteps={self.num_timesteps}, updates={self.updates}"
        return f"<{type(self).__name__}({chosen}), {counted}>"

    def _setup_model(self) -> None:
        self.set_random_seed(self.hyperparameters.seed)
        self.policy = self.make_policy().to(self.device)
        self.policy.image_key = self.hyperparameters.image_key
        self.learner = self.make_learner()

    @abstractmethod
    def make_policy(self) -> Any:
        """Make the policy for `self.observation_space` and `self.action_space`."""

    @abstractmethod
    def make_learner(self) -> Any:
        """Make the object that updates `self.policy`, with new optimisers."""

    def unbound_action_space(self) -> spaces.Box:
        """Return the action space of an agent that was made without an environment."""
        raise ValueError(f"{type(self).__name__} needs an environment: pass env=")

    def reset_task(self) -> None:
        """Discard the episodes, and initialise the networks that belong to the task again."""
        self.replay_buffer = ReplayBuffer()
        self.progress.reset("credit", "seen_length")
        self.rollout = None
        self._last_obs = None
        self.policy.reset_behavior()
        self.learner = self.make_learner()

    def on_other_actions(self) -> None:
        """Adapt to an environment whose actions have another number of dimensions."""
        self.reset_task()

    # Keywords

    @classmethod
    def check_keywords(cls, kwargs: Mapping[str, Any]) -> None:
        """Raise a ValueError for an unknown keyword, which suggests similar ones."""
        valid = set(inspect.signature(cls).parameters) - {"_init_setup_model"}
        for name in kwargs:
            if name not in valid:
                raise unknown_name("keyword", name, valid)

    def change_hyperparameter(self, name: str, value: Any) -> None:
        """Set a keyword, as `model.gamma = 0.98` does. It takes effect at once and is saved.

        :raises ValueError: a value that is not allowed, or one that can no longer take effect
        """
        before = self.hyperparameters
        changed = before.changed(**{name: value})
        if changed == before:
            return
        if remedy := self.too_late(self.keywords.declared()[name].stage):
            raise ValueError(f"{name}={value!r} can no longer take effect: {remedy}")
        self.hyperparameters = changed
        try:
            if name == "image_key":
                self._show_entry()
            self.hyperparameters_changed()
        except ValueError:
            self.hyperparameters = before
            self.policy.image_key = before.image_key
            raise
        if name == "seed":
            self.set_random_seed(changed.seed)

    def _show_entry(self) -> None:
        """Show the agent the entry `image_key`, by wrapping the environment again."""
        self.policy.image_key = self.hyperparameters.image_key
        if self.env is not None:
            self.set_env(self.env.venv if isinstance(self.env, VecExtractDictObs) else self.env)

    def too_late(self, stage: Stage) -> str | None:
        """Return the remedy if keywords of this stage can no longer take effect, else None."""
        if stage in (Stage.SIZE, Stage.DRAWING):
            return f"the networks are made; make a new {type(self).__name__} with it"
        return None

    def hyperparameters_changed(self) -> None:
        """Update what depends on `self.hyperparameters`, or raise a ValueError to reject them."""

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all random numbers from now on, and the environment's next reset."""
        if seed is not None:
            self.hyperparameters = self.hyperparameters.changed(seed=seed)
            self.streams = Streams(seed)
        super().set_random_seed(seed)

    # Data and environments

    def set_dataset(self, dataset: Data | None) -> None:
        """Use another dataset from the next call of `learn` on.

        That call chooses trajectories and trains the prior actor again. Until then, the agent uses
        the trajectories and the prior actor of the previous dataset.

        :param dataset: any kind that the keyword `dataset` takes; None changes nothing
        :raises ValueError: something that is no dataset, or data that the agent cannot learn from
        """
        if dataset is not None:
            opened = open_dataset(dataset)
            self.check_data(opened)
            self.dataset = opened
            self.check_units()

    def check_data(self, dataset: TrajectoryDataset) -> None:
        """Raise a ValueError for a dataset that the agent cannot learn from."""

    def check_units(self) -> None:
        """Warn if the environment's actions are in other units than those of the dataset."""

    def check_env(self, env: VecEnv) -> None:
        """Raise a ValueError for an environment that the agent cannot act in."""
        check_spaces(env)

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return as_vec_env(env, monitor=monitor_wrapper)

    def _checked(self, env: GymEnv | str) -> VecEnv:
        wrapped = as_vec_env(env, self.hyperparameters.image_key)
        self.check_env(wrapped)
        return wrapped

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """Use another environment, with any number of copies.

        If its actions have another number of dimensions, everything that was learnt and collected
        for a task is discarded.

        :param env: an id, a Gymnasium environment, a vector environment, or a list of environments
        :param force_reset: reset the environment at the next call of `learn`; another number of
            copies is always reset
        :raises ValueError: observations that are not images, or actions that are not a bounded Box
        """
        self._use_env(self._checked(env), force_reset)

    def _use_env(self, env: VecEnv, force_reset: bool = True) -> None:
        assert isinstance(env.action_space, spaces.Box)
        other = env.action_space.shape != self.action_space.shape
        if force_reset or env.num_envs != self.n_envs:
            self._last_obs = None
        self.env = env
        self.n_envs = env.num_envs
        self._vec_normalize_env = unwrap_vec_normalize(env)
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        self.policy.observation_space = env.observation_space
        self.policy.image_key = self.hyperparameters.image_key
        self.policy.set_action_space(env.action_space)
        if other:
            self.on_other_actions()
        self.rollout = None
        self.check_units()
        if self.hyperparameters.seed is not None:
            env.seed(self.hyperparameters.seed)
        self._resets_seen = resets(env)
