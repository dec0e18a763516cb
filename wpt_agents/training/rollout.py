"""The open episodes of n environments: what is being recorded, and who drives."""

from collections.abc import Callable

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.policy import State, WPTPolicy, prior_action, stack_frames, to_images

Window = tuple[int, int]


class Rollout:
    """Records steps until an episode ends, and lets the prior actor drive inside its window.

    :param policy: acts
    :param n_envs: how many episodes are open at once
    :param draw: called when an episode begins; the steps (start, stop) at which the guide drives
    :param embodiment: written on each trajectory
    """

    def __init__(
        self,
        policy: WPTPolicy,
        n_envs: int,
        draw: Callable[[], Window],
        embodiment: str | None = None,
    ) -> None:
        self.policy, self.draw, self.embodiment = policy, draw, embodiment
        self.state: State = policy.initial_state(n_envs)
        self.frames: np.ndarray | None = None
        self.first = np.ones(n_envs, bool)
        self.windows: list[Window] = [(0, 0)] * n_envs
        self.images: list[list[np.ndarray]] = [[] for _ in range(n_envs)]
        self.actions: list[list[np.ndarray]] = [[] for _ in range(n_envs)]
        self.rewards: list[list[float]] = [[] for _ in range(n_envs)]

    def act(self, image: np.ndarray, guide: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """One action per environment; the latent is filtered whoever drives.

        :param image: (n, 64, 64, 3) uint8
        :param guide: (k, F, 64, 64, 3) frames -> (k, A), the prior actor
        :return: (n, A) in [-1, 1]
        """
        for i in np.flatnonzero(self.first):
            self.windows[i] = self.draw()
        self.frames = stack_frames(image, self.frames, self.first)
        action, state = self.policy.act(
            image, self.state, self.first, generator=self.policy.generator
        )
        time = np.array([len(actions) for actions in self.actions])
        start, stop = np.array(self.windows).T
        guided = (start <= time) & (time < stop)
        if guided.any():
            action[guided] = guide(self.frames[guided])
        self.state = (state[0], state[1], action)
        for i, (frame, each) in enumerate(zip(image, action, strict=True)):
            self.images[i].append(frame.copy())
            self.actions[i].append(each[: self.policy.action_space.shape[0]].copy())
        return action

    def end_step(
        self, reward: np.ndarray, done: np.ndarray, last: dict[int, tuple[np.ndarray, bool]]
    ) -> list[Trajectory]:
        """Takes in the step's outcome; returns the episodes that it ended.

        :param reward: (n,)
        :param done: (n,) bool
        :param last: for each ended episode its last image (64, 64, 3) and whether it terminated
        """
        finished = []
        for i, each in enumerate(reward):
            self.rewards[i].append(float(each))
            if done[i]:
                image, terminated = last[i]
                finished.append(self._finish(i, image, terminated))
        self.first = done.copy()
        return finished

    def _finish(self, i: int, image: np.ndarray, terminated: bool) -> Trajectory:
        trajectory = Trajectory(
            np.stack([*self.images[i], image]),
            np.stack(self.actions[i]).astype(np.float32),
            np.array(self.rewards[i], np.float32),
            terminated,
            embodiment=self.embodiment,
        )
        self.images[i], self.actions[i], self.rewards[i] = [], [], []
        return trajectory


def step_all(
    env: VecEnv, action: np.ndarray, meanwhile: Callable[[], None] | None = None
) -> VecEnvStepReturn:
    """One step of every environment.

    :param meanwhile: what to do while worker processes step
    :raises RuntimeError: a worker process is gone; what was learnt and recorded is not
    """
    try:
        env.step_async(action)
        try:
            if meanwhile is not None:
                meanwhile()
        finally:  # an answer left in the pipe would be taken for the next one
            outcome = env.step_wait()
        return outcome
    except (EOFError, ConnectionError) as error:  # all that SubprocVecEnv's pipes tell
        raise RuntimeError(
            "A worker process of the vector environment died; its own error stands above, if it "
            "left one. The model is whole: give set_env() a new environment and call "
            "learn(..., reset_num_timesteps=False)"
        ) from error


def clone_guide(policy: WPTPolicy) -> Callable[[np.ndarray], np.ndarray]:
    """The prior actor as a guide."""
    return lambda frames: prior_action(policy, frames)


def random_guide(policy: WPTPolicy, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Uniform random actions, for the warm-up where there is no clone."""
    mask = policy.action_mask.cpu().numpy()

    def guide(frames: np.ndarray) -> np.ndarray:
        return (rng.uniform(-1, 1, (len(frames), len(mask))) * mask).astype(np.float32)

    return guide


def last_images(infos: list[dict], dones: np.ndarray) -> dict[int, tuple[np.ndarray, bool]]:
    """For each ended episode its last image and whether it terminated (not a time limit)."""
    return {
        int(i): (
            to_images(infos[i]["terminal_observation"])[0][0],
            not infos[i].get("TimeLimit.truncated", False),
        )
        for i in np.flatnonzero(dones)
    }
