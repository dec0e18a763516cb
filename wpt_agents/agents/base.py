"""The base of all agents: keywords, environments, collecting episodes, logging, model files.

A subclass provides its keywords, a policy, a learner and one update. For example::

    class DrQv2(PixelAgent, keywords=DrQv2Keywords):    # a subclass of `training.keywords.Keywords`
        updates_per_step = 0.5                          # one update for every two collected steps
        def make_policy(self): return DrQv2Policy(self.observation_space, self.action_space)
        def make_learner(self): return DrQv2Learner(self.policy, self.hyperparameters)
        def update(self, metrics): ...                  # one update on `self.replay_buffer`

* The policy is a BasePolicy of SB3 with the methods of `training.rollout.Acting`, and
  `set_action_space`, `to_env` and `predict`.
* The learner is any object; the optimisers among its attributes are saved with the policy.
* `update` appends a scalar tensor to each of the lists in `metrics`, whose keys are the names in
  the log, such as "train/critic_loss".
* Draw all random numbers from `self.streams`, with a counter of `self.progress`, so that an agent
  that was loaded continues exactly. `collect` does so already.

Every keyword can be read as an attribute (`model.gamma`), and written as long as a change can still
take effect. A subclass may also override the methods below `# Hooks`.
"""

import os
import time
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import safe_mean
from torch import Tensor

from wpt_agents.agents.saved import SavedAgent
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.observations import to_images
from wpt_agents.training.checks import check_rewards, whole_steps
from wpt_agents.training.evaluations import showing_same_entry
from wpt_agents.training.outlook import Outlook
from wpt_agents.training.randomness import Purpose
from wpt_agents.training.resets import resets
from wpt_agents.training.rollout import WARM_UP, Rollout, Window, last_images, step_all

MetricLists = dict[str, list[Tensor]]  # of several updates, by the names of the log


class PixelAgent(SavedAgent):
    """The base of agents that act on images and learn from stored episodes, with SB3's methods."""

    warmup_pays: ClassVar[bool] = False  # whether steps before `learning_starts` earn updates
    # Called after each update of `learn`: SB3 calls no callback there.
    after_update: Callable[[], None] | None = None

    # What a subclass must provide, besides `make_policy` and `make_learner`

    @abstractmethod
    def update(self, metrics: MetricLists) -> None:
        """Make one update on `self.replay_buffer` and append its scalar tensors to `metrics`."""

    @property
    @abstractmethod
    def updates_per_step(self) -> float:
        """The number of updates for each collected step."""

    # Hooks

    def prepare(self, progress_bar: bool) -> None:
        """Prepare collecting, as by cloning; `learn` calls it after resetting the environment."""

    def before_step(self) -> None:
        """Prepare the next step, such as by setting the noise of exploration."""

    @property
    def warmup_driver(self) -> str:
        """What chooses the actions in the warm-up, as words for messages."""
        return "random actions"

    def guidance_window(self, rng: np.random.Generator) -> Window:
        """Return the steps (start, stop) of a new episode in which `guide` acts, not the policy."""
        return 0, 0

    def guide(self, frames: np.ndarray) -> np.ndarray:
        """Act in the warm-up and in guidance windows: (k, F, 64, 64, 3) -> (k, A) in [-1, 1]."""
        steps = self.progress.earlier_steps + self.num_timesteps
        rng = self.streams.numpy(Purpose.WARMUP, steps)
        width = self.policy.action_mask.shape[0]
        actions = rng.uniform(-1, 1, (len(frames), width)) * self.policy.action_mask.cpu().numpy()
        return np.asarray(actions, np.float32)

    def on_episode(self, trajectory: Trajectory) -> None:
        """Handle a finished episode before it is added to the replay buffer."""

    def steps_to_update(self) -> float:
        """Return the number of collected steps for each update."""
        return 1 / self.updates_per_step

    def cheaper_updates(self, steps: int) -> str:
        """Return a line of code that makes `steps` steps enough for an update, or ""."""
        return ""

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
        """Collect episodes and make updates in turns.

        :param total_timesteps: calls of `env.step`, summed over the environments, as in SB3. 0
            makes no step and no update, but the preparations for them, such as reading offline
            data
        :param callback: SB3's callbacks
        :param log_interval: stored episodes between two dumps of the log
        :param tb_log_name: name of the run's folder in `tensorboard_log`
        :param reset_num_timesteps: count steps and advance schedules from 0 again; False continues
        :param progress_bar: show a progress bar
        :return: the agent itself
        :raises ValueError: no environment, `total_timesteps` that are no whole number of at least
            0, or rewards that are not finite
        :raises FloatingPointError: a loss or gradient that is not finite; the weights are kept
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
        """Set up what `learn` needs, reset the environment, call the first and last callback."""
        if self.env is None:
            raise ValueError("No environment: call set_env(env), or pass env= to pretrain or load")
        total_timesteps = whole_steps(total_timesteps)
        if reset_num_timesteps:
            self.progress.restart_steps()
        if resets(self.env) != self._resets_seen:
            self._last_obs = None  # an evaluation, for example, has ended the open episodes
        with showing_same_entry(callback, self.env):
            total_timesteps, callback = self._setup_learn(
                total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
            )
            self._resets_seen = resets(self.env)
            if self.verbose:
                print(self)
            updates_before = self.updates
            # What earlier steps paid for is kept, so that short calls in a row learn, too.
            begun = self.num_timesteps >= self.learning_starts and len(self.replay_buffer) > 0
            continued = begun and not reset_num_timesteps
            outlook = Outlook.of(self)
            outlook.warn(over=False, learns=continued)
            callback.on_training_start(locals(), globals())
            try:
                yield callback
            except BaseException:
                self._last_obs = None  # open episodes may lack a step, so new ones begin
                raise
            finally:
                callback.on_training_end()
        outlook = replace(outlook, stop=self.num_timesteps, replay=len(self.replay_buffer) > 0)
        outlook.warn(over=True, learns=continued or self.updates > updates_before)

    @property
    def unfinished(self) -> bool:
        """Whether `learn` has steps left to collect."""
        return self.num_timesteps < self._total_timesteps

    def collect(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Step all environments until an episode ends, or has become so long that it is stored.

        :return: False if a callback asked to stop
        """
        assert self.env is not None
        callback.on_rollout_start()
        rollout = self._open_rollout()
        go_on = True
        ended = False
        while go_on and not ended and self.unfinished:
            self.before_step()
            image, _ = to_images(self._last_obs)
            actions = self.policy.to_env(rollout.act(image))  # named as callbacks of SB3 expect
            meanwhile = self.update_models if self.hyperparameters.train_freq == "step" else None
            new_obs, rewards, dones, infos = step_all(self.env, actions, meanwhile)
            check_rewards(rewards, self.num_timesteps)  # before anything of this step is recorded
            self.num_timesteps += self.n_envs
            if self.warmup_pays or self.num_timesteps > self.learning_starts:
                self.credit += self.n_envs
            full = rollout.full(dones, self.max_trajectory_length)
            last = last_images(self.env, infos, dones, new_obs, full)
            finished = rollout.end_step(rewards, dones, last)
            self._store(finished, int(full.sum()))  # before the callback, which may save the replay
            callback.update_locals(locals())
            self._resets_seen = resets(self.env)  # a step may reset all, with some VecEnvs
            go_on = callback.on_step()
            self._update_info_buffer(infos, dones)
            self._log_episodes(log_interval, len(finished))
            self._last_obs = new_obs
            self._last_episode_starts = dones
            # A callback may have played other episodes on the environment.
            ended = bool(finished) or resets(self.env) != self._resets_seen
        if go_on:
            callback.on_rollout_end()
        return go_on

    def first_images(self, number: int) -> np.ndarray:
        """Return the first images of episodes of the task.

        A single image is that of the first environment's open episode. For more, all environments
        are reset as often as necessary. In the middle of episodes, which a reset would interrupt,
        only one image is returned.

        :param number: the number of images
        :return: (number, 64, 64, 3) uint8, or (1, 64, 64, 3) in the middle of episodes
        """
        image: np.ndarray = np.array(to_images(self._last_obs)[0])  # copies: VecEnvs may reuse it
        if self.rollout is not None and not self._last_episode_starts.all():
            opening = self.rollout.first_image(0)
            return image[:1] if opening is None else opening[None]
        images = [image]
        while number > len(images) * self.n_envs:
            self.begin_episodes()
            images.append(np.array(to_images(self._last_obs)[0]))
        together: np.ndarray = np.concatenate(images)
        return together[:number]

    def begin_episodes(self) -> None:
        """Reset all environments; the open episodes are dropped."""
        assert self.env is not None
        self._last_obs = self.env.reset()
        self._last_episode_starts = np.ones(self.n_envs, bool)
        self._resets_seen = resets(self.env)

    def _open_rollout(self) -> Rollout:
        """Return the open episodes; new ones if all environments were just reset."""
        assert self.env is not None
        if resets(self.env) != self._resets_seen:
            self.begin_episodes()
        if self.rollout is None or self._last_episode_starts.all():
            self.rollout = Rollout(
                self.policy,
                self.n_envs,
                self.action_space.shape[0],
                self._next_window,
                self.guide,
                self.streams.torch(Purpose.ACT, self.episodes + self.progress.cut, self.device),
                self.hyperparameters.embodiment,
            )
        return self.rollout

    def _next_window(self) -> Window:
        """Return the steps of a new trajectory at which the guide acts."""
        if self.num_timesteps < self.warmup_steps:
            return WARM_UP
        self.progress.windows_drawn += 1
        return self.guidance_window(self.streams.numpy(Purpose.WINDOW, self.progress.windows_drawn))

    def _store(self, finished: list[Trajectory], cut: int) -> None:
        """Store completed trajectories, of which `cut` belong to episodes that have not ended."""
        for trajectory in finished:
            self.on_episode(trajectory)
            self.replay_buffer.add(trajectory)
            self.progress.seen_length = max(self.progress.seen_length or 0, len(trajectory))
            if cut and trajectory.reward is not None:  # SB3's means are of ended episodes alone
                self.logger.record_mean("rollout/reward_per_step", trajectory.reward.mean())
        self.episodes += len(finished) - cut
        self.progress.cut += cut

    def updates_due(self) -> int:
        """Return how many updates are due for the collected steps."""
        return int(self.credit * self.updates_per_step + 1e-9)  # rounding must not cost one

    def update_models(self) -> None:
        """Make the updates that are due, and log their means."""
        if not self.replay_buffer.trajectories or not self.updates_per_step:
            return
        if self.num_timesteps < self.learning_starts:
            return
        updates = self.updates_due()
        price = 1 / self.updates_per_step
        rest = max(self.credit - updates * price, 0.0)
        metrics: MetricLists = defaultdict(list)
        for left in reversed(range(updates)):
            self.update(metrics)
            self.credit = rest + left * price  # so that an interruption costs no updates
            if self.after_update is not None:
                self.after_update()
        for key, values in metrics.items():
            self.logger.record_mean(key, torch.stack(values).mean().item())

    def _log_episodes(self, log_interval: int | None, new: int) -> None:
        stored = self.episodes + self.progress.cut
        if not log_interval or (stored - new) // log_interval == stored // log_interval:
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

    def save_replay_buffer(self, path: str | os.PathLike[str]) -> None:
        """Write the collected episodes to one file, which `load_replay_buffer` reads.

        :param path: the file, which is replaced if it exists; missing folders are made
        :raises OSError: a folder that cannot be written to, or a full disk
        """
        self.replay_buffer.save(path)

    def load_replay_buffer(self, path: str | os.PathLike[str]) -> None:
        """Replace the replay buffer by the episodes in a file of `save_replay_buffer`.

        :param path: the file
        :raises ValueError: a file that is cut short, damaged, or not a replay buffer
        """
        self.replay_buffer = ReplayBuffer.load(path)
