"""Collecting: the open episodes of several environments, and the choice between two policies."""

import sys
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch import Generator

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.observations import State, stack_frames, to_images
from wpt_agents.training.ends import last_observation
from wpt_agents.training.environments import innermost

PATIENCE = 1800.0  # seconds that a worker process may take for a step; people may reset robots
GO_ON = (
    "The model is intact: call set_env() with a new environment, then "
    "learn(..., reset_num_timesteps=False)"
)
Window = tuple[int, int]  # steps start .. stop - 1 of an episode
WARM_UP: Window = 0, sys.maxsize  # the whole episode, however long it lasts
# `Trajectory.source` of collected trajectories: whether they began in the warm-up
FROM_WARM_UP = "collected in the warm-up"
FROM_LATER = "collected after the warm-up"
Guide = Callable[[np.ndarray], np.ndarray]  # (k, F, 64, 64, 3) frames -> (k, A) actions


class Acting(Protocol):
    """The methods that a policy needs for collecting. A is the width of its actions."""

    def initial_state(self, n: int) -> State:
        """Return the recurrent state of n new episodes, a tuple of arrays (n, ...)."""

    def act(
        self,
        image: np.ndarray,
        state: State | None,
        episode_start: np.ndarray | None,
        deterministic: bool = False,
        generator: Generator | None = None,
    ) -> tuple[np.ndarray, State]:
        """Return actions (n, A) in [-1, 1] for images (n, 64, 64, 3), and the next state."""

    def executed(self, state: State, action: np.ndarray) -> State:
        """Return the state after `action` (n, A) was executed, whichever policy chose it."""


class Rollout:
    """Record steps until an episode ends, and let a guide act in its window.

    A long episode is recorded as several trajectories, one after the other, so that it can be
    replayed while it goes on. Each has a window of its own; the policy does not notice the cut.

    :param policy: the policy that acts outside of the windows
    :param n_envs: number of environments, each with one open episode
    :param action_dim: width of the actions that are recorded, the environment's own
    :param draw_window: called when a trajectory begins; returns the steps at which the guide acts
    :param guide: the policy that acts in the windows: (k, F, 64, 64, 3) -> (k, A)
    :param generator: source of the policy's random numbers
    :param embodiment: name of the robot, written on each trajectory
    """

    def __init__(
        self,
        policy: Acting,
        n_envs: int,
        action_dim: int,
        draw_window: Callable[[], Window],
        guide: Guide,
        generator: Generator | None = None,
        embodiment: str | None = None,
    ) -> None:
        self.policy = policy
        self.action_dim = action_dim
        self.draw_window = draw_window
        self.guide = guide
        self.generator = generator
        self.embodiment = embodiment
        self.state: State = policy.initial_state(n_envs)
        self.frames: np.ndarray | None = None
        self.episode_start = np.ones(n_envs, bool)
        self.trajectory_start = np.ones(n_envs, bool)  # of an episode, or of a part of one
        self.opening: list[np.ndarray | None] = [None] * n_envs  # the first image of each episode
        self.windows: list[Window] = [(0, 0)] * n_envs
        self.images: list[list[np.ndarray]] = [[] for _ in range(n_envs)]
        self.actions: list[list[np.ndarray]] = [[] for _ in range(n_envs)]
        self.rewards: list[list[float]] = [[] for _ in range(n_envs)]

    def act(self, image: np.ndarray) -> np.ndarray:
        """Return one action per environment. The policy sees every step, also those of the guide.

        :param image: (n, 64, 64, 3) uint8
        :return: (n, A) in [-1, 1]
        """
        for i in np.flatnonzero(self.trajectory_start):
            self.windows[i] = self.draw_window()
        for i in np.flatnonzero(self.episode_start):
            self.opening[i] = image[i].copy()
        # Kept at every step, because the guide's window may begin at any.
        self.frames = stack_frames(image, self.frames, self.episode_start)
        action, state = self.policy.act(
            image, self.state, self.episode_start, generator=self.generator
        )
        time = np.array([len(actions) for actions in self.actions])
        start, stop = np.array(self.windows).T
        guided = (start <= time) & (time < stop)
        if guided.any():
            action[guided] = self.guide(self.frames[guided])
        # The RSSM must see what was done, whoever decided: it predicts from actions.
        self.state = self.policy.executed(state, action)
        for i, (frame, row) in enumerate(zip(image, action, strict=True)):
            self.images[i].append(frame.copy())  # the environment may draw into it
            self.actions[i].append(row[: self.action_dim].copy())
        return action

    def full(self, done: np.ndarray, longest: int) -> np.ndarray:
        """Return which open episodes have become so long that they must be stored, (n,) bool.

        :param done: (n,) bool, which episodes the current step ended
        :param longest: the largest number of steps of a trajectory
        """
        lengths = np.array([len(actions) for actions in self.actions])
        full: np.ndarray = (lengths >= longest) & ~done
        return full

    def longest_open(self) -> int:
        """Return the steps of the longest open trajectory."""
        return max(len(actions) for actions in self.actions)

    def end_step(
        self, reward: np.ndarray, done: np.ndarray, last: dict[int, tuple[np.ndarray, bool]]
    ) -> list[Trajectory]:
        """Record the results of a step; return the trajectories that it completed.

        :param reward: (n,)
        :param done: (n,) bool, which episodes ended
        :param last: for each completed trajectory its last image (64, 64, 3), and whether its
            episode terminated
        """
        finished = []
        for i, value in enumerate(reward):
            self.rewards[i].append(float(value))
            if i in last:
                finished.append(self._finish(i, *last[i]))
        self.episode_start = done.copy()
        self.trajectory_start = np.array([i in last for i in range(len(reward))])
        return finished

    def first_image(self, i: int) -> np.ndarray | None:
        """Return the first image of an open episode, None before its first step."""
        return None if self.episode_start[i] else self.opening[i]

    def _finish(self, i: int, image: np.ndarray, terminated: bool) -> Trajectory:
        trajectory = Trajectory(
            np.stack([*self.images[i], image]),
            np.stack(self.actions[i]).astype(np.float32),
            np.array(self.rewards[i], np.float32),
            terminated,
            embodiment=self.embodiment,
            source=FROM_WARM_UP if self.windows[i] == WARM_UP else FROM_LATER,
        )
        self.images[i] = []
        self.actions[i] = []
        self.rewards[i] = []
        return trajectory


def step_all(
    env: VecEnv, action: np.ndarray, meanwhile: Callable[[], None] | None = None
) -> VecEnvStepReturn:
    """Step every environment once.

    :param env: the n environments
    :param action: (n, A) in the bounds of their actions
    :param meanwhile: called while worker processes step
    :raises RuntimeError: a worker process died, or did not answer for `PATIENCE` seconds; what was
        learned and recorded is kept
    """
    try:
        env.step_async(action)
        try:
            if meanwhile is not None:
                meanwhile()
        finally:  # an answer left in the pipe would be taken for that of the next step
            wait_for_workers(env)
            outcome = env.step_wait()
        return outcome
    except (EOFError, ConnectionError) as error:  # SubprocVecEnv's pipes say no more than this
        raise RuntimeError(
            "A worker process of the vector environment died; if it left an error message, it is "
            f"printed above. {GO_ON}"
        ) from error


def wait_for_workers(env: VecEnv) -> None:
    """Wait until every worker process of a SubprocVecEnv has answered; end all if one does not.

    :raises RuntimeError: a worker that did not answer for `PATIENCE` seconds
    """
    workers = innermost(env)
    if not isinstance(workers, SubprocVecEnv):
        return
    end = time.monotonic() + PATIENCE
    for i, remote in enumerate(workers.remotes):
        if not remote.poll(max(0.0, end - time.monotonic())):
            pid = workers.processes[i].pid
            for process in workers.processes:
                process.kill()
                process.join()
            for pipe in workers.remotes:
                pipe.close()
            workers.closed = True  # there is nobody left to whom `close` could speak
            raise RuntimeError(
                f"Environment {i} of the vector environment, in process {pid}, did not answer for "
                f"{PATIENCE:g} seconds, so that all of its processes were ended. {GO_ON}"
            )


def last_images(
    env: VecEnv | None,
    infos: list[dict[str, Any]],
    dones: np.ndarray,
    new_obs: Any,
    full: np.ndarray,
) -> dict[int, tuple[np.ndarray, bool]]:
    """Return for each completed trajectory its last image and whether the episode terminated.

    An episode that is cut, or that a time limit ends, has not terminated.

    :param new_obs: (n, ...), what the step returned; where an episode ended, the first observation
        of the next
    :param full: (n,) bool, which episodes are cut after this step and go on
    """
    cut = {int(i): (to_images(new_obs[i])[0][0], False) for i in np.flatnonzero(full)}
    return cut | {
        int(i): (
            to_images(last_observation(env, infos, i, new_obs[i]))[0][0],
            not infos[i].get("TimeLimit.truncated", False),
        )
        for i in np.flatnonzero(dones)
    }
