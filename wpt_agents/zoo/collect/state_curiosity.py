"""Curiosity on the simulator's state: data for image datasets within minutes of CPU time.

Soft actor-critic (Stable-Baselines3's) seeks states that random network distillation
(https://arxiv.org/abs/1810.12894) finds novel. It observes the simulator's state, not images, so
100,000 steps take minutes, and it does not use the task's reward. The policies of five stages of
its training, including early ones, are then played and recorded as images.

Example::

    stages = explore_states("wpt/dmc-walker-stand-v0", steps=100_000, seed=0)
    action = state_policy(stages[-1])(state, np.random.default_rng(0))
"""

import io
import zlib
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import wpt_envs
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN
from torch import Tensor, nn

from wpt_agents.files.archive import replacing
from wpt_agents.zoo.collect.behaviours import Act
from wpt_agents.zoo.machine import one_thread

STEPS = 100_000  # calls of `env.step` in an exploration
STAGES = 5  # number of policies to keep, evenly spaced
WIDTH = 256  # width of the novelty networks
CODES = 64  # outputs of the random network, which the predictor learns to predict
CLIP = 5.0  # normalised states are clipped at this number of standard deviations

StatePolicy = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""(state (S,), rng) -> action (A,) in [-1, 1], sampled."""


class StateTask(gym.Wrapper):
    """A task that returns its simulator's state, with repeated actions and without rendering.

    :param env: a task of `wpt_envs`, wrapped as `gymnasium.make` returns it
    :param repeat: control steps in a step
    """

    def __init__(self, env: gym.Env, repeat: int) -> None:
        super().__init__(env.unwrapped)
        self.repeat = repeat
        space = env.unwrapped.observation_space
        assert isinstance(space, gym.spaces.Box), space
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, space.shape, np.float32)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode."""
        state, info = self.env.reset(**kwargs)
        return state.astype(np.float32), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Repeat the action; the task's reward is dropped."""
        for _ in range(self.repeat):
            state, _, terminated, truncated, info = self.env.step(action)
            if terminated or truncated:
                break
        return state.astype(np.float32), 0.0, terminated, truncated, info


class Novelty(nn.Module):
    """Random network distillation: the error of predicting a random network's output.

    :param states: width of a state
    """

    mean: Tensor
    var: Tensor
    count: Tensor
    scale: Tensor

    def __init__(self, states: int) -> None:
        super().__init__()
        self.random = _network(states).requires_grad_(False)
        self.predictor = _network(states)
        for name in ("mean", "var"):
            self.register_buffer(name, torch.full((states,), float(name == "var")))
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("scale", torch.zeros(()))
        self.optimizer = torch.optim.Adam(self.predictor.parameters(), 1e-4)

    def error(self, state: Tensor) -> Tensor:
        """Squared error of the prediction, averaged over the outputs: (N, S) -> (N,)."""
        x = ((state - self.mean) / (self.var.sqrt() + 1e-6)).clamp(-CLIP, CLIP)
        return (self.predictor(x) - self.random(x)).square().mean(-1)

    def reward(self, state: Tensor) -> Tensor:
        """Learn from the states, and return their novelty divided by its running mean: (N,)."""
        self._see(state)
        error = self.error(state)
        self.optimizer.zero_grad()
        error.mean().backward()
        self.optimizer.step()
        error = error.detach()
        first = self.scale == 0
        self.scale.copy_(torch.where(first, error.mean(), self.scale.lerp(error.mean(), 0.01)))
        return error / self.scale.clamp_min(1e-8)

    def _see(self, state: Tensor) -> None:
        """Update the running mean and variance of the states (Welford's, in batches)."""
        count = self.count + len(state)
        delta = state.mean(0) - self.mean
        share = len(state) / count
        new = state.var(0, correction=0) * share + self.var * (1 - share)
        self.var.copy_(new + delta.square() * share * (1 - share))
        self.mean.add_(delta * share)
        self.count.copy_(count)


def _network(states: int) -> nn.Sequential:
    return nn.Sequential(
        *(nn.Linear(states, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU()),
        nn.Linear(WIDTH, CODES),
    )


class NovelReplay(ReplayBuffer):
    """A replay buffer whose rewards are the current novelty of the sampled next states."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        assert self.obs_shape is not None
        self.novelty = Novelty(int(self.obs_shape[0])).to(self.device)

    def _get_samples(
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> ReplayBufferSamples:
        samples = super()._get_samples(batch_inds, env)
        return samples._replace(rewards=self.novelty.reward(samples.next_observations)[:, None])


def explore_states(
    task: str,
    env: Mapping[str, Any] | None = None,
    steps: int = STEPS,
    seed: int = 0,
    stages: int = STAGES,
) -> list[bytes]:
    """Explore a task by curiosity on its state.

    :param task: an id for `gymnasium.make`, of the suites dmc, metaworld or robotics
    :param env: keyword arguments of `gymnasium.make`
    :param steps: calls of `env.step` in all
    :param seed: seed of all random numbers
    :param stages: number of policies to keep, evenly spaced over the steps
    :return: the policies' weights, oldest first, for `state_policy`
    """
    keywords = dict(env or {})
    repeat = int(keywords.get("action_repeat", wpt_envs.TASKS[task].action_repeat))
    with closing(StateTask(gym.make(task, **keywords), repeat)) as states:
        torch.manual_seed(seed)
        model = SAC(
            "MlpPolicy",
            states,
            replay_buffer_class=NovelReplay,
            buffer_size=steps,
            learning_starts=min(1000, steps // 2),
            train_freq=2,
            seed=seed,
            device="cpu",
        )
        kept = []
        for stage in range(1, stages + 1):
            left = stage * steps // stages - model.num_timesteps
            model.learn(left, reset_num_timesteps=False)
            file = io.BytesIO()
            torch.save(model.actor.state_dict(), file)
            kept.append(file.getvalue())
    return kept


def exploration_folder(dataset: Path, task: str) -> Path:
    """Return the folder for the exploration of a task, below that of the dataset."""
    return dataset / f"exploring-{zlib.crc32(task.encode()):08x}"


def stage_files(dataset: Path, task: str) -> list[Path]:
    """Return the files of the stages of a task's exploration."""
    folder = exploration_folder(dataset, task)
    return [folder / f"stage-{stage}.pt" for stage in range(STAGES)]


def write_stages(
    folder: Path, task: str, env: Mapping[str, Any], seed: int, settings: Mapping[str, Any]
) -> None:
    """Explore a task and save the stages, unless they exist already."""
    files = stage_files(folder, task)
    if files[-1].exists():  # written last
        return
    files[0].parent.mkdir(parents=True, exist_ok=True)
    with one_thread():  # so that the data depend only on the seed
        stages = explore_states(task, env, seed=seed, **settings)
    for file, weights in zip(files, stages, strict=True):
        with replacing(file) as temporary:
            temporary.write_bytes(weights)


def by_state(policy: StatePolicy, rng: np.random.Generator) -> Act:
    """Convert a policy on the simulator's state into one that plays an episode."""
    return lambda obs, info, step: policy(info["state"], rng)


def state_policy(weights: bytes) -> StatePolicy:
    """Return a stage of an exploration as a stochastic policy.

    :param weights: of `explore_states`
    """
    tensors = torch.load(io.BytesIO(weights), weights_only=True)
    arrays = {name: tensor.numpy().astype(np.float64) for name, tensor in tensors.items()}
    layers = sorted(name for name in arrays if name.startswith("latent_pi") and "weight" in name)

    def act(state: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        x = np.asarray(state, np.float64)
        for name in layers:
            x = np.maximum(arrays[name] @ x + arrays[name.replace("weight", "bias")], 0)
        mean = arrays["mu.weight"] @ x + arrays["mu.bias"]
        log_std = arrays["log_std.weight"] @ x + arrays["log_std.bias"]
        std = np.exp(log_std.clip(LOG_STD_MIN, LOG_STD_MAX))
        return np.tanh(mean + std * rng.standard_normal(len(mean)))

    return act
