"""The base of all agents: keywords, random numbers, environment, model files and copies."""

import inspect
import warnings
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import VecEnv, VecExtractDictObs, unwrap_vec_normalize
from torch import Tensor

from wpt_agents.agents.attributes import declare
from wpt_agents.data.convert import Data, open_dataset
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.files.model_file import read_model
from wpt_agents.files.names import unknown_name
from wpt_agents.model.actions import space_as_dict, space_from_dict
from wpt_agents.model.observations import IMAGE_SPACE
from wpt_agents.training import model_files
from wpt_agents.training.checks import check_device
from wpt_agents.training.environments import as_vec_env
from wpt_agents.training.keywords import Keywords, Stage
from wpt_agents.training.progress import Progress
from wpt_agents.training.randomness import Streams, torch_seed
from wpt_agents.training.resets import resets
from wpt_agents.training.rollout import Rollout
from wpt_agents.training.spaces import check_spaces


class SavedAgent(BaseAlgorithm):
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
    saved_as: ClassVar[str] = ""  # the class that reads the model files, if not the class itself
    shape_keywords: ClassVar[tuple[str, ...]] = ()  # must be equal where weights are loaded

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
            raise TypeError(str(unknown_name("keyword", min(unknown), self.keywords.declared())))
        if isinstance(policy, str) and policy not in self.policy_aliases:
            raise unknown_name("policy", policy, self.policy_aliases)
        check_device(device)
        self.hyperparameters = self.keywords(**keywords)
        self.progress = self.progress_class()
        seed = self.hyperparameters.seed
        self.streams = Streams(torch_seed(np.random.default_rng()) if seed is None else seed)
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
        """The keywords that differ from their defaults, those that the size decides, and counts."""
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
        """Make what updates `self.policy`, with new optimisers."""

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
        """Adapt to an environment whose actions have another width than those before."""
        self.reset_task()

    # Keywords

    @classmethod
    def check_keywords(cls, kwargs: Mapping[str, Any]) -> None:
        """Refuse keywords that the constructor does not have, with the nearest ones."""
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
        """See the entry `image_key` of observations: the environment shows the former one alone."""
        self.policy.image_key = self.hyperparameters.image_key
        if self.env is not None:
            self.set_env(self.env.venv if isinstance(self.env, VecExtractDictObs) else self.env)

    def too_late(self, stage: Stage) -> str | None:
        """Return the remedy if keywords of this stage can no longer take effect, else None."""
        if stage in (Stage.SIZE, Stage.DRAWING):
            return f"the networks are made; make a new {type(self).__name__} with it"
        return None

    def hyperparameters_changed(self) -> None:
        """Bring what was made from `self.hyperparameters` up to date; ValueError refuses them."""

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed everything that is drawn from now on, and the environment's next reset."""
        if seed is not None:
            self.hyperparameters = self.hyperparameters.changed(seed=seed)
            self.streams = Streams(seed)
        super().set_random_seed(seed)

    # Data and environments

    def set_dataset(self, dataset: Data | None) -> None:
        """Use another dataset from the next call of `learn` on.

        Trajectories are then chosen, and the prior actor is trained, again. Until then the agent
        goes on with those of the dataset before.

        :param dataset: any kind that the keyword `dataset` takes; None changes nothing
        :raises ValueError: something that is no dataset, or data that the agent cannot learn from
        """
        if dataset is not None:
            opened = open_dataset(dataset)
            self.check_data(opened)
            self.dataset = opened
            self.check_units()

    def check_data(self, dataset: TrajectoryDataset) -> None:
        """Refuse a dataset that the agent cannot learn from."""

    def check_units(self) -> None:
        """Warn if the environment's actions are in other units than those of the dataset."""

    def check_env(self, env: VecEnv) -> None:
        """Refuse an environment that the agent cannot act in."""
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

        If its actions have another width, what was learnt and collected for a task is discarded.

        :param env: an id, a Gymnasium environment, a vector environment, or a list of environments
        :param force_reset: reset the environment at the next call of `learn`
        :raises ValueError: observations that are not images, or actions that are not a bounded Box
        """
        self._use_env(self._checked(env), force_reset)

    def _use_env(self, env: VecEnv, force_reset: bool = True) -> None:
        assert isinstance(env.action_space, spaces.Box)
        other = env.action_space.shape != self.action_space.shape
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
        if force_reset:
            self._last_obs = None
        self.rollout = None
        self.check_units()
        if self.hyperparameters.seed is not None:
            env.seed(self.hyperparameters.seed)
        self._resets_seen = resets(env)

    # Model files and copies

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        optimizers = (f"learner.{name}" for name in model_files.optimizers(self.learner))
        return ["policy", "progress", *optimizers], []

    def save(
        self,
        path: model_files.ModelPath,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write the model file: weights, optimisers, keywords and counters, but no episodes.

        :param path: the file; missing folders are made, and .zip is added where there is no suffix
        :param exclude: ignored; accepted because SB3 has it
        :param include: ignored; accepted because SB3 has it
        :raises OSError: a folder that cannot be written to, or a full disk
        """
        dataset = None if self.dataset is None else str(self.dataset.path)
        header = self.description() | {"dataset": dataset}
        model_files.write(path, header, self.policy, self.learner)

    def description(self) -> dict[str, Any]:
        """Return what a model file says of this agent besides its tensors."""
        return {
            "class": self.saved_as or type(self).__name__,
            "hyperparameters": self.hyperparameters.resolved().as_dict(),
            "action_space": space_as_dict(self.action_space),
            "counters": self.progress.as_dict(),
        }

    @classmethod
    def load(
        cls,
        path: model_files.ModelPath,
        env: GymEnv | str | None = None,
        device: torch.device | str = "auto",
        custom_objects: Mapping[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Read a model file.

        :param path: the path passed to `save`, or the name of a pre-trained world model that comes
            with the library, such as "metaworld-mid"
        :param env: the environment to continue with
        :param device: "auto", "cpu", "cuda", ...
        :param custom_objects: ignored; accepted because SB3 has it
        :param print_system_info: print this system's versions, as SB3 does
        :param force_reset: reset the environment at the next call of `learn`
        :param kwargs: new values for keywords of the constructor, also `dataset`
        :raises ValueError: a file that is cut short, damaged or another agent's; unknown keywords
        :raises FileNotFoundError: no such file; for a folder, the message lists the files in it
        """
        path = model_files.find(path)
        cls.check_keywords(kwargs)
        if print_system_info:
            get_system_info()
        header, tensors = read_model(path)
        model_files.check_class(header, path, cls.saved_as or cls.__name__)
        keywords = {**header["hyperparameters"], **kwargs}
        agent = cls(device=device, _init_setup_model=False, **keywords)
        agent.action_space = space_from_dict(header["action_space"])
        agent._setup_model()
        agent.policy.set_action_space(agent.action_space)
        agent.restore(header, tensors, cls.shape_keywords)
        learner = agent.learner
        if env is not None:
            agent.set_env(env, force_reset)
        if agent.learner is learner:  # no reset, as for actions of another width
            agent.warn_if_late(header, tensors)
        return agent

    def restore(
        self,
        header: Mapping[str, Any],
        tensors: Mapping[str, Mapping[str, Tensor]],
        same: tuple[str, ...],
    ) -> None:
        """Take over the weights, optimisers and counters of a model file, as `read_model` reads it.

        :param same: keywords that must be equal here and in the file
        """
        self._check_same(header, tensors, same)
        progress = self.progress_class.of(header["counters"])
        self._load_tensors(tensors)
        self.progress = progress

    def warn_if_late(
        self, header: Mapping[str, Any], tensors: Mapping[str, Mapping[str, Tensor]]
    ) -> None:
        """Warn of keywords that differ from a model file's and take effect after a reset only."""
        before = self.keywords.of(header["hyperparameters"])
        late = {stage: self.too_late(stage) for stage in (Stage.RETRIEVAL, Stage.CLONING)}
        if model_files.WORLD_MODEL not in tensors:
            late[Stage.DRAWING] = "the weights are loaded; call reset_task() to draw others"
        for name, declared in self.keywords.declared().items():
            value = self.hyperparameters.value(name)
            if value != before.value(name) and (why := late.get(declared.stage)):
                warnings.warn(f"{name}={value!r} has no effect yet: {why}", stacklevel=3)

    def _load_tensors(self, tensors: Mapping[str, Mapping[str, Tensor]]) -> None:
        self.fit_networks(tensors.get("policy", {}))
        model_files.restore(tensors, self.policy, self.learner)

    def fit_networks(self, weights: Mapping[str, Tensor]) -> None:
        """Add or remove the networks that only some models have, before weights are loaded.

        :param weights: by name; none of a file that holds a world model alone
        """

    def _check_same(
        self,
        header: Mapping[str, Any],
        tensors: Mapping[str, Mapping[str, Tensor]],
        names: tuple[str, ...],
    ) -> None:
        if model_files.WORLD_MODEL not in tensors:  # explorers take a world model, too
            kind = self.saved_as or type(self).__name__
            model_files.check_class(header, "The model file", kind)
        # of a `Size` it fills new fields
        trained_with = self.keywords.of(header["hyperparameters"])
        model_files.check_same(trained_with.as_dict(), self.hyperparameters.as_dict(), names)

    def set_parameters(
        self,
        load_path_or_dict: Any,
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """Load weights and optimisers in place; counters, such as `num_timesteps`, stay.

        :param load_path_or_dict: a model file, or what `get_parameters` returns
        :param exact_match: refuse a dictionary that lacks parts of the agent or has others
        :param device: the device of the tensors of a dictionary
        :raises ValueError: a file that is damaged or of another agent, or other parts
        """
        if isinstance(load_path_or_dict, dict):
            self.fit_networks(load_path_or_dict.get("policy", {}))
            # A copy, as torch lets two optimisers share the averages that one hands to the other.
            # Dictionaries of earlier versions lack "progress".
            parameters = {"progress": {}, **deepcopy(load_path_or_dict)}
            super().set_parameters(parameters, exact_match, device)
            return
        header, tensors = read_model(model_files.find(load_path_or_dict))
        self._check_same(header, tensors, self.shape_keywords)
        self._load_tensors(tensors)
        if model_files.WORLD_MODEL not in tensors:
            progress = self.progress_class.of(header["counters"])
            self.progress.load_state_dict(progress.state_dict())

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and pickles hold: all but environment, open episodes and logger."""
        left_out = {"env", "_vec_normalize_env", "_last_obs", "_resets_seen", "rollout"}
        left_out |= {"after_update"}  # a callback's
        state = {k: None if k in left_out else v for k, v in vars(self).items() if k != "_logger"}
        return state | {"_custom_logger": False}
