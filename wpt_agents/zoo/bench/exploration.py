"""State coverage of the walker by each exploration method, at equal numbers of frames.

The measure: cells of a histogram over torso height (0 to 1.6 m, 16 bins), pitch (a full turn, 24
bins) and horizontal speed (-4 to 4 m/s, 16 bins) that at least one step ended in; values outside
the range count in the outermost bins.

Only the frames of recorded episodes count. `explore-state` first learns from the simulator's state
alone, and then alternates between the policies of five stages of its training.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np

from wpt_agents.agents.curious import EXPLORE, EXPLORERS
from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.collect.behaviours import noise_actions, random_actions
from wpt_agents.zoo.collect.episodes import STATE_CURIOSITY, record
from wpt_agents.zoo.collect.state_curiosity import (
    STEPS,
    by_state,
    explore_states,
    state_policy,
)

TASK = "wpt/dmc-walker-stand-v0"
BEHAVIOURS = ("random", "noise", STATE_CURIOSITY, "icm", "plan2explore")
ENV: dict[str, Any] = {"rendering": "fast", "state_in_info": True}
EPISODES = 20  # of 500 steps of 2 frames: 20,000 frames
SMALL = {  # quick enough for a processor
    **EXPLORE,
    "size": "debug",
    "batch_length": 16,
    "train_ratio": 8,  # an update of 8 x 16 replayed steps every 16 collected ones
    "imagine_horizon": 10,
}
LOW, HIGH, BINS = np.array([0, -np.pi, -4]), np.array([1.6, np.pi, 4]), np.array([16, 24, 16])


class Watched(gym.Wrapper):
    """Record the simulator's state after every step."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.states: list[np.ndarray] = []

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step and record the state that it ends in."""
        result = self.env.step(action)
        self.states.append(result[-1]["state"])
        return result


def coverage(states: np.ndarray) -> int:
    """Return the number of cells that contain the walker's states.

    :param states: (N, 24), dm_control's observation: xx and xz of each body's orientation, the
        torso's first; the torso's height; the joints' velocities, of which the second is rootx's
    """
    pitch = np.arctan2(states[:, 1], states[:, 0])
    place = np.stack([states[:, 14], pitch, states[:, 16]], 1)
    cells = np.floor((place - LOW) / (HIGH - LOW) * BINS).astype(int).clip(0, BINS - 1)
    return len(np.unique(cells, axis=0))


def explore(behaviour: str, seed: int, episodes: int, **settings: Any) -> np.ndarray:
    """Return the states (N, 24) that an exploration method visits."""
    learns = behaviour in EXPLORERS
    size = 64 if learns else 16  # these behaviours need no images
    stages = []
    if behaviour == STATE_CURIOSITY:
        stages = [state_policy(w) for w in explore_states(TASK, ENV, settings["steps"], seed)]
    with closing(Watched(gym.make(TASK, image_size=size, **ENV))) as env:
        if learns:
            model = EXPLORERS[behaviour]("WPTPolicy", env, max_action_dim=6, seed=seed, **settings)
            for _ in model.explore(episodes):
                pass
        else:
            actions = {"noise": noise_actions, "random": random_actions}
            for episode in range(episodes):
                rng = np.random.default_rng([seed, episode])
                if stages:
                    act = by_state(stages[episode % len(stages)], rng)
                else:
                    act = actions[behaviour](rng, 6, 500)[0]
                record(env, act, int(rng.integers(2**31)))
        return np.stack(env.states)


def rows(
    quick: bool = False, behaviours: Sequence[str] = BEHAVIOURS, steps: int = STEPS
) -> Iterator[dict[str, Any]]:
    """Yield the number of cells that each behaviour visits, for each seed.

    :param steps: calls of `env.step` during the training of `explore-state`
    """
    for behaviour in behaviours:
        if behaviour not in BEHAVIOURS:
            raise unknown_name("behaviour", behaviour, BEHAVIOURS)
        settings = {"steps": 500 if quick else steps} if behaviour == STATE_CURIOSITY else SMALL
        for seed in range(1 if quick else 3):
            start = time.process_time()
            states = explore(behaviour, seed, 2 if quick else EPISODES, **settings)
            yield {
                "behaviour": behaviour,
                "seed": seed,
                "frames": 2 * len(states),
                "cells, half way": coverage(states[: len(states) // 2]),
                "cells": coverage(states),
                "cpu seconds": round(time.process_time() - start),
            }
