"""The base of all agents: keywords, environments, collecting whole episodes, logging, model files.

A subclass provides its keywords, a policy, a learner and one update. For example::

    class DrQv2(PixelAgent, keywords=DrQv2Keywords):    # a subclass of `training.keywords.Keywords`
        updates_per_step = 0.5                          # one update for every two collected steps
        def make_policy(self): return DrQv2Policy(self.observation_space, self.action_space)
        def make_learner(self): return DrQv2Learner(self.policy, self.hyperparameters)
        def update(self, metrics): ...                  # one update on `self.replay_buffer`

* The policy is a BasePolicy of SB3 with the methods of `training.rollout.Acting`, and
  `set_action_space`, `to_env` and `predict`.
* The learner is any object; the optimisers among its attributes are saved with the policy.
* `update` appends tensors to `metrics`: lists by the names of the log, such as "train/critic_loss".
* All random numbers are drawn from `self.streams` by a counter of `self.progress`, so that an agent
  that was loaded continues exactly. `collect` does so already.

Every keyword can be read as an attribute (`model.gamma`) and, as long as it takes effect, written.
A subclass may also override the methods below `# Hooks`.
"""

import inspect
import os
import sys
import time
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import get_system_info, safe_mean
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import Tensor

from wpt_agents.agents.attributes import declare
from wpt_agents.data.convert import Data, open_dataset
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.files.model_file import read_model
from wpt_agents.files.names import unknown_name
from wpt_agents.model.actions import space_as_dict, space_from_dict
from wpt_agents.model.policy import IMAGE_SPACE, to_images
from wpt_agents.training import model_files
from wpt_agents.training.checks import check_device, check_rewards
from wpt_agents.training.environments import as_vec_env
from wpt_agents.training.keywords import Keywords, Stage
from wpt_agents.training.progress import Progress
from wpt_agents.training.randomness import Purpose, Streams, torch_seed
from wpt_agents.training.rollout import Rollout, Window, last_images, step_all
from wpt_agents.training.spaces import check_spaces

Metrics = dict[str, list[Tensor]]


class PixelAgent(BaseAlgorithm):
    """An algorithm that acts on images, learns from whole episodes and keeps SB3's verbs.

    :param policy: the policy's name or class; the first of `policy_aliases` if None
    :param env: an id, a Gymnasium environment or a VecEnv with image observations and Box actions
    :param dataset: trajectories to learn from: whatever `open_dataset` takes
    :param tensorboard_log: folder of the TensorBoard events
    :param verbose: 0 for nothing, 1 for information
    :param device: "auto", "cpu", "cuda", ...
    """

    keywords: ClassVar[type[Keywords]] = Keywords
    progress_class: ClassVar[type[Progress]] = Progress
    saved_as: ClassVar[str]  # the class that reads the model files; subclasses may share them
    shape_keywords: ClassVar[tuple[str, ...]] = ()  # must be equal where weights are loaded
    warmup_pays: ClassVar[bool] = False  # whether steps before `learning_starts` pay for updates

    policy: Any  # a BasePolicy with the methods of `Acting`
    learner: Any
    action_space: spaces.Box
    _last_obs: Any  # SB3's own type does not take all that a VecEnv returns
    _last_episode_starts: Any
    # Counters of `progress`, which are attributes, too.
    num_timesteps: int
    episodes: int
    updates: int
    credit: float

    def __init_subclass__(
        cls,
        keywords: type[Keywords] | None = None,
        progress: type[Progress] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init_subclass__(**kwargs)
        cls.keywords = keywords or cls.keywords
        cls.progress_class = progress or cls.progress_class
        if "saved_as" not in cls.__dict__:
            cls.saved_as = getattr(cls, "saved_as", cls.__name__)
        declare(cls, cls.keywords, cls.progress_class, cls.__init__)

    if TYPE_CHECKING:  # keywords are attributes

        def __getattr__(self, name: str) -> Any: ...

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
        check_device(device)
        self.hyperparameters = self.keywords(**keywords)
        self.progress = self.progress_class()
        seed = self.hyperparameters.seed
        self.streams = Streams(torch_seed(np.random.default_rng()) if seed is None else seed)
        rate = getattr(self.hyperparameters, "learning_rate", 0.0)
        super().__init__(
            policy or next(iter(self.policy_aliases)),
            None,
            learning_rate=rate,
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

    def _setup_model(self) -> None:
        self.set_random_seed(self.hyperparameters.seed)
        self.policy = self.make_policy().to(self.device)
        self.learner = self.make_learner()

    # What a subclass must provide

    @abstractmethod
    def make_policy(self) -> Any:
        """Make the policy for `self.observation_space` and `self.action_space`."""

    @abstractmethod
    def make_learner(self) -> Any:
        """Make what updates `self.policy`, with new optimisers."""

    @abstractmethod
    def update(self, metrics: Metrics) -> None:
        """Make one update from `self.replay_buffer`; append to `metrics` by the log's names."""

    @property
    @abstractmethod
    def updates_per_step(self) -> float:
        """How many updates a collected step pays for."""

    # Hooks

    def unbound_action_space(self) -> spaces.Box:
        """Return the action space of an agent that was made without an environment."""
        raise ValueError(f"{type(self).__name__} needs an environment: pass env=")

    def check_env(self, env: VecEnv) -> None:
        """Refuse an environment that the agent cannot act in."""
        check_spaces(env)

    def set_dataset(self, dataset: Data | None) -> None:
        """Use other trajectories from now on: whatever `open_dataset` takes."""
        if dataset is not None:
            opened = open_dataset(dataset)
            self.check_data(opened)
            self.dataset = opened

    def check_data(self, dataset: TrajectoryDataset) -> None:
        """Refuse a dataset that the agent cannot learn from."""

    def prepare(self, progress_bar: bool) -> None:
        """Do what comes before collecting; called by `learn`, when the environment is reset."""

    def guidance_window(self, rng: np.random.Generator) -> Window:
        """Return the steps (start, stop) of a new episode in which `guide` acts, not the policy."""
        return 0, 0

    def guide(self, frames: np.ndarray) -> np.ndarray:
        """Act in the warm-up and in guidance windows: (k, F, 64, 64, 3) -> (k, A) in [-1, 1]."""
        rng = self.streams.numpy(Purpose.WARMUP, self.num_timesteps)
        width = self.policy.action_mask.shape[0]
        actions = rng.uniform(-1, 1, (len(frames), width)) * self.policy.action_mask.cpu().numpy()
        return actions.astype(np.float32)

    def before_step(self) -> None:
        """Do what must come before each step that is collected, such as setting the noise."""

    def on_episode(self, trajectory: Trajectory) -> None:
        """Look at a finished episode before it is added to the replay buffer."""

    def on_other_actions(self) -> None:
        """Adapt to an environment whose actions have another width than those before."""
        self.reset_task()

    def reset_task(self) -> None:
        """Forget the task: the episodes, and the networks that `reset_behavior` draws again."""
        self.replay_buffer = ReplayBuffer()
        self.progress.reset("credit", "seen_length")
        self.rollout = None
        self._last_obs = None
        self.policy.reset_behavior()
        self.learner = self.make_learner()

    def too_late(self, stage: Stage) -> str | None:
        """Return the remedy if keywords of this stage can no longer take effect, else None."""
        if stage is Stage.SIZE:
            return f"the networks are made; make a new {type(self).__name__} with it"
        return None

    def hyperparameters_changed(self) -> None:
        """Bring what was made from `self.hyperparameters` up to date."""

    # Keywords, seeds and environments

    def change_hyperparameter(self, name: str, value: Any) -> None:
        """Set a keyword, as `model.gamma = 0.98` does. It takes effect at once and is saved.

        :raises ValueError: a value that is not allowed, or one that can no longer take effect
        """
        changed = self.hyperparameters.changed(**{name: value})
        if changed == self.hyperparameters:
            return
        stage = self.keywords.declared()[name].stage
        if remedy := self.too_late(stage):
            raise ValueError(f"{name}={value!r} can no longer take effect: {remedy}")
        self.hyperparameters = changed
        if name == "seed":
            self.set_random_seed(changed.seed)
        self.hyperparameters_changed()

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed everything that is drawn from now on, and the environment's next reset."""
        if seed is not None:
            self.hyperparameters = self.hyperparameters.changed(seed=seed)
            self.streams = Streams(seed)
        super().set_random_seed(seed)

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return as_vec_env(env, monitor=monitor_wrapper)

    def _checked(self, env: GymEnv | str) -> VecEnv:
        wrapped = self._wrap_env(env, self.verbose)
        self.check_env(wrapped)
        return wrapped

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """Use another environment, with any number of copies.

        If its actions have another width, what was learned and collected for a task is dropped.

        :raises ValueError: observations that are no images, or actions that are no bounded Box
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
        self.policy.set_action_space(env.action_space)
        if other:
            self.on_other_actions()
        if force_reset:
            self._last_obs = None
        self.rollout = None
        if self.hyperparameters.seed is not None:
            env.seed(self.hyperparameters.seed)

    # Learning

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Collect and update in turns.

        :param total_timesteps: calls of `env.step`, a lower bound
        :param callback: SB3's callbacks
        :param log_interval: episodes between two dumps of the log
        :return: the agent itself
        """
        with self.learning(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        ) as callback:
            self.prepare(progress_bar)
            while self.unfinished and self.collect(callback, log_interval):
                self.update_models()
        return self

    @contextmanager
    def learning(
        self,
        total_timesteps: int,
        callback: MaybeCallback,
        reset_num_timesteps: bool,
        tb_log_name: str,
        progress_bar: bool,
    ) -> Iterator[BaseCallback]:
        """Set up what `learn` needs and reset the environment; call the callbacks at both ends."""
        if self.env is None:
            raise ValueError("No environment: call set_env(env), or pass env= to pretrain or load")
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        try:
            yield callback
        except BaseException:
            self._last_obs = None  # open episodes may lack a step: the next call begins new ones
            raise
        finally:
            callback.on_training_end()

    @property
    def unfinished(self) -> bool:
        """Whether `learn` has steps left to collect."""
        return self.num_timesteps < self._total_timesteps

    def collect(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Step all environments until an episode ends; return False when a callback says stop."""
        assert self.env is not None
        rollout = self._open_rollout()
        callback.on_rollout_start()
        go_on = True
        ended = False
        while go_on and not ended and self.unfinished:
            self.before_step()
            image, _ = to_images(self._last_obs)
            action = self.policy.to_env(rollout.act(image))
            meanwhile = self.update_models if self.hyperparameters.train_freq == "step" else None
            new_obs, rewards, dones, infos = step_all(self.env, action, meanwhile)
            check_rewards(rewards, self.num_timesteps)
            self.num_timesteps += self.n_envs
            if self.warmup_pays or self.num_timesteps > self.hyperparameters.learning_starts:
                self.credit += self.n_envs
            last = last_images(self.env, infos, dones, new_obs)
            finished = rollout.end_step(rewards, dones, last)
            self._store(finished)  # before the callback, which may save the replay buffer
            callback.update_locals(locals())
            go_on = callback.on_step()
            self._update_info_buffer(infos, dones)
            self._log_episodes(log_interval, len(finished))
            self._last_obs = new_obs
            self._last_episode_starts = dones
            ended = bool(dones.any())
        if go_on:
            callback.on_rollout_end()
        return go_on

    def _open_rollout(self) -> Rollout:
        """Return the open episodes; new ones if all environments were just reset."""
        if self.rollout is None or self._last_episode_starts.all():
            self.rollout = Rollout(
                self.policy,
                self.n_envs,
                self.action_space.shape[0],
                self._draw_window,
                self.guide,
                self.streams.torch(Purpose.ACT, self.episodes, self.device),
                self.hyperparameters.embodiment,
            )
        return self.rollout

    def _draw_window(self) -> Window:
        """Decide at an episode's start whether, and when, the guide acts."""
        if self.num_timesteps < self.hyperparameters.warmup_steps:
            return 0, sys.maxsize  # the whole episode, however long it lasts
        self.progress.windows_drawn += 1
        return self.guidance_window(self.streams.numpy(Purpose.WINDOW, self.progress.windows_drawn))

    def _store(self, finished: list[Trajectory]) -> None:
        for trajectory in finished:
            self.on_episode(trajectory)
            self.replay_buffer.add(trajectory)
            self.progress.seen_length = max(self.progress.seen_length or 0, len(trajectory))
        self.episodes += len(finished)

    def updates_due(self) -> int:
        """Return how many updates the collected steps have paid for."""
        return int(self.credit * self.updates_per_step + 1e-9)  # rounding must not cost one

    def update_models(self) -> None:
        """Make the updates that are due, and log their means."""
        if not self.replay_buffer.trajectories or not self.updates_per_step:
            return
        if self.num_timesteps < self.hyperparameters.learning_starts:
            return
        updates = self.updates_due()
        price = 1 / self.updates_per_step
        rest = max(self.credit - updates * price, 0.0)
        metrics: Metrics = defaultdict(list)
        for left in reversed(range(updates)):
            self.update(metrics)
            self.credit = rest + left * price  # so that an interruption costs no updates
        for key, values in metrics.items():
            self.logger.record_mean(key, torch.stack(values).mean().item())

    def _log_episodes(self, log_interval: int | None, new: int) -> None:
        before = self.episodes - new
        if not log_interval or before // log_interval == self.episodes // log_interval:
            return
        assert self.ep_info_buffer is not None and self.ep_success_buffer is not None
        record = self.logger.record
        if self.ep_info_buffer:
            record("rollout/ep_rew_mean", safe_mean([e["r"] for e in self.ep_info_buffer]))
            record("rollout/ep_len_mean", safe_mean([e["l"] for e in self.ep_info_buffer]))
        if self.ep_success_buffer:
            record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        seconds = max(time.time_ns() - self.start_time, 1) / 1e9
        record("time/episodes", self.episodes, exclude="tensorboard")
        record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / seconds))
        record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        record("train/updates", self.updates)
        self.logger.dump(step=self.num_timesteps)

    # Model files and copies

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", *(f"learner.{name}" for name in model_files.optimizers(self.learner))], []

    def save(
        self,
        path: model_files.ModelPath,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write the model file: weights, optimisers, keywords and counters; no episodes, no data.

        :param path: the suffix .zip is added where there is none
        :param exclude: accepted because SB3 has it; nothing optional is in the file
        :param include: likewise
        """
        about = {
            "class": self.saved_as,
            "hyperparameters": self.hyperparameters.as_dict(),
            "action_space": space_as_dict(self.action_space),
            "dataset": str(self.dataset.path) if self.dataset is not None else None,
            "counters": self.progress.as_dict(),
        }
        model_files.write(path, about, self.policy, self.learner)

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

        :param path: the path given to `save`
        :param env: the environment to continue with
        :param custom_objects: accepted because SB3 has it
        :param print_system_info: print this system's versions, as SB3 does
        :param kwargs: keywords of the constructor that are to change, also `dataset`
        :raises ValueError: a file that is cut short, damaged or another agent's; unknown keywords
        :raises FileNotFoundError: no such file; for a folder, the message lists the files in it
        """
        path = model_files.find(path)
        cls.check_keywords(kwargs)
        if print_system_info:
            get_system_info()
        about, tensors = read_model(path)
        kind = about.get("class", cls.saved_as)
        if kind != cls.saved_as:
            raise ValueError(
                f"{path} is of {kind}: read it by {kind}.load, not {cls.__name__}.load"
            )
        agent = cls(
            device=device, _init_setup_model=False, **{**about["hyperparameters"], **kwargs}
        )
        agent.action_space = space_from_dict(about["action_space"])
        agent._setup_model()
        agent.policy.set_action_space(agent.action_space)
        agent.restore(about, tensors, cls.shape_keywords)
        if env is not None:
            agent.set_env(env, force_reset)
        return agent

    def restore(
        self,
        about: Mapping[str, Any],
        tensors: Mapping[str, Mapping[str, Tensor]],
        same: tuple[str, ...],
    ) -> None:
        """Take over the weights, optimisers and counters of a model file, as `read_model` reads it.

        :param same: keywords that must be equal here and in the file
        """
        model_files.check_same(about, self.hyperparameters.as_dict(), same)
        progress = self.progress_class.of(about["counters"])
        model_files.restore(tensors, self.policy, self.learner)
        self.progress = progress

    def set_parameters(
        self,
        load_path_or_dict: Any,
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """Load weights and optimisers in place, from a model file or from `get_parameters`."""
        if isinstance(load_path_or_dict, dict):
            super().set_parameters(load_path_or_dict, exact_match, device)
            return
        about, tensors = read_model(model_files.find(load_path_or_dict))
        model_files.check_same(about, self.hyperparameters.as_dict(), self.shape_keywords)
        model_files.restore(tensors, self.policy, self.learner)

    def save_replay_buffer(self, path: str | os.PathLike[str]) -> None:
        """Write the collected episodes to one file."""
        self.replay_buffer.save(path)

    def load_replay_buffer(self, path: str | os.PathLike[str]) -> None:
        """Read what `save_replay_buffer` wrote."""
        self.replay_buffer = ReplayBuffer.load(path)

    @classmethod
    def check_keywords(cls, kwargs: Mapping[str, Any]) -> None:
        """Refuse keywords that the constructor does not have, with the nearest ones."""
        valid = set(inspect.signature(cls).parameters) - {"_init_setup_model"}
        for name in kwargs:
            if name not in valid:
                raise unknown_name("keyword", name, valid)

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and pickles hold: all but environment, open episodes and logger."""
        left_out = {"env", "_vec_normalize_env", "_last_obs", "rollout"}
        state = {k: None if k in left_out else v for k, v in vars(self).items() if k != "_logger"}
        return state | {"_custom_logger": False}
