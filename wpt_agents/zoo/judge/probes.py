"""Linear probes of the simulator's state from a world model's latents.

A ridge regression from [h, z] to quantities such as a pole's angle or a drawer's position is fitted
on some episodes and tested on others by R²: 1 is perfect, 0 is no better than the mean. Episodes
are from scripted policies if there are any, else from noise.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import wpt_envs
from torch import Generator

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.trajectory import Trajectory, led_to, stack_windows
from wpt_agents.zoo.collect.episodes import Job, Recipe, has_script, make_env, play_episode

PENALTY = 10.0  # regularisation of the ridge, on standardised features
Quantities = Mapping[str, Callable[[np.ndarray], np.ndarray]]  # (N, S) states -> (N,)


def entry(index: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that takes one entry of the states."""
    return lambda states: states[:, index]


# The quantities of interest by robot: entries of dm_control's and Meta-World's own observations.
# Meta-World's first object (entries 4 to 6) is the handle, the button, the hammer ...
QUANTITIES: Mapping[str, Quantities] = {
    "cartpole": {"cart": entry(0), "pole cos": entry(1), "pole sin": entry(2)},
    "acrobot": {
        **{"upper arm sin": entry(0), "lower arm sin": entry(1)},
        **{"upper arm cos": entry(2), "lower arm cos": entry(3)},
    },
    "walker": {"torso height": entry(14), "torso cos": entry(0), "torso sin": entry(1)},
    "cheetah": {"torso height": entry(0), "torso pitch": entry(1)},
    "quadruped": {"torso upright": entry(47)},
    "sawyer": {
        **{f"gripper {axis}": entry(i) for i, axis in enumerate("xyz")},
        **{f"object {axis}": entry(4 + i) for i, axis in enumerate("xyz")},
    },
}


@dataclass(frozen=True)
class Watched:
    """An episode and the simulator's states at its images.

    :param state: (T + 1, S)
    """

    trajectory: Trajectory
    state: np.ndarray


class KeepStates(gym.Wrapper):
    """Record `info["state"]` of every observation of an episode."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.states: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and clear the states of the last one."""
        obs, info = self.env.reset(**kwargs)
        self.states = [info["state"]]
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step and record the next state."""
        result = self.env.step(action)
        self.states.append(result[-1]["state"])
        return result


def watch(task: str, episodes: int, seed: int, rendering: str = "fast") -> Iterator[Watched]:
    """Play episodes of a task and record the states."""
    behaviour = "scripted" if has_script(task) else "noise"
    recipe = Recipe(seed, behaviour, {"rendering": rendering, "state_in_info": True})
    with closing(KeepStates(make_env(task, recipe))) as env:
        for episode in range(episodes):
            trajectory = play_episode(env, Job(task, 0, episodes, recipe), episode)
            yield Watched(trajectory, np.stack(env.states))


@torch.no_grad()
def latents(model: WPT, trajectory: Trajectory) -> np.ndarray:
    """Return the filtered states [h, z] at all images of an episode, (T + 1, D + S*K)."""
    stop = len(trajectory) + 1
    batch = stack_windows([led_to(trajectory, 0, stop, model.max_action_dim)]).to(model.device)
    generator = Generator(model.device).manual_seed(0)
    post, _, _ = model.policy.world_model.observe(batch, generator)
    return post.feat[0].float().cpu().numpy()


def ridge_r2(
    features: np.ndarray,
    targets: np.ndarray,
    held_features: np.ndarray,
    held_targets: np.ndarray,
    penalty: float = PENALTY,
) -> np.ndarray:
    """Return the R² of a ridge regression on held-out samples, one for each target.

    :param features: (N, F) to fit on; they are standardised
    :param targets: (N, K)
    :param held_features: (M, F) to judge on
    :param held_targets: (M, K)
    :return: (K,); nan for a target that does not vary in the held-out samples
    """
    mean = features.mean(0)
    std = features.std(0) + 1e-6
    x = (features - mean) / std
    center = targets.mean(0)
    weights = np.linalg.solve(x.T @ x + penalty * np.eye(x.shape[1]), x.T @ (targets - center))
    error = ((held_features - mean) / std) @ weights + center - held_targets
    spread = held_targets - held_targets.mean(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        r2 = 1 - (error**2).sum(0) / (spread**2).sum(0)
    return np.where((spread**2).sum(0) > 1e-12, r2, np.nan)


def probe(
    model: WPT,
    tasks: Sequence[str],
    episodes: int = 10,
    seed: int = 1000,
    rendering: str = "fast",
) -> Iterator[dict[str, Any]]:
    """Yield a row for each quantity of a task, with the R² of predicting it from the latents.

    :param tasks: ids of `gymnasium.make`, of robots in `QUANTITIES`
    :param episodes: half of them are for fitting, half for testing
    :param seed: seed of the episodes; collections for training use small seeds
    """
    for task in tasks:
        robot = wpt_envs.TASKS[task].embodiment
        seen = list(watch(task, episodes, seed, rendering))
        features = [latents(model, episode.trajectory) for episode in seen]
        names = QUANTITIES[robot]
        targets = [np.stack([of(e.state) for of in names.values()], 1) for e in seen]
        half = episodes // 2
        r2 = ridge_r2(
            np.concatenate(features[:half]),
            np.concatenate(targets[:half]),
            np.concatenate(features[half:]),
            np.concatenate(targets[half:]),
        )
        for name, value in zip(names, r2, strict=True):
            yield {"task": task, "quantity": name, "r2": round(float(value), 3)}


def beside_untrained(
    model: WPT, tasks: Sequence[str], episodes: int, seed: int, rendering: str
) -> Iterator[dict[str, Any]]:
    """Yield the rows of `probe`, with the R² of an untrained model of the same size.

    :raises ValueError: for a task whose robot has no quantities, or more actions than the model
    """
    width = model.max_action_dim
    for task in tasks:
        robot, actions = wpt_envs.TASKS[task].embodiment, wpt_envs.TASKS[task].action_dim
        if robot not in QUANTITIES:
            known = ", ".join(QUANTITIES)
            raise ValueError(f"{task}: the robot {robot} has no quantities to probe, only {known}")
        if actions > width:
            raise ValueError(
                f"{task} has {actions} actions, the model takes at most {width}: use other --tasks "
                "(and their --suite), or a model that was pre-trained for as many"
            )
    untrained = WPT(
        "WPTPolicy", size=model.policy.size, max_action_dim=width, seed=0, device=model.device
    )
    how = tasks, episodes, seed, rendering
    for row, other in zip(probe(model, *how), probe(untrained, *how), strict=True):
        yield row | {"r2, untrained": other["r2"]}
