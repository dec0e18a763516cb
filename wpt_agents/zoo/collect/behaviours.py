"""Behaviours for collecting data: coloured noise, uniform actions, scripts with noise."""

from collections.abc import Callable
from typing import Any

import numpy as np
import wpt_envs

COLOURS = ("white", "pink", "ou-4", "ou-16", "ou-64")  # ou-n: correlated over n steps
EXPLORATION_KEYWORDS = ("steps",)  # for `collect --behaviour explore-state`
AMPLITUDES = (0.3, 1.5)  # standard deviation, drawn once per episode, before clipping to [-1, 1]

Act = Callable[[np.ndarray, dict[str, Any], int], np.ndarray]
"""(obs, info, step) -> action (A,) in [-1, 1]."""


def coloured_noise(rng: np.random.Generator, colour: str, length: int, width: int) -> np.ndarray:
    """Stationary noise of unit variance: white, pink (1/f), or Ornstein-Uhlenbeck.

    :return: (length, width)
    """
    white = rng.standard_normal((length, width))
    if colour == "white":
        return white
    if colour == "pink":
        frequency = np.maximum(np.fft.rfftfreq(length), 1 / length)
        gain = frequency**-0.5
        gain /= np.sqrt((gain[:-1] ** 2).mean())
        return np.fft.irfft(np.fft.rfft(white, axis=0) * gain[:, None], n=length, axis=0)
    keep = np.exp(-1 / int(colour.removeprefix("ou-")))
    noise = white.copy()
    for step in range(1, length):
        noise[step] = keep * noise[step - 1] + np.sqrt(1 - keep**2) * white[step]
    return noise


def noise_actions(rng: np.random.Generator, width: int, length: int) -> tuple[Act, str]:
    """Return the noise for an episode, of random colour and amplitude, and its name."""
    colour, amplitude = str(rng.choice(COLOURS)), rng.uniform(*AMPLITUDES)
    noise = np.clip(amplitude * coloured_noise(rng, colour, length, width), -1, 1)
    return lambda obs, info, step: noise[step], f"{colour} noise, amplitude {amplitude:.2f}"


def random_actions(rng: np.random.Generator, width: int, length: int) -> tuple[Act, str]:
    """Return uniform actions, drawn at every step, and their name."""
    return lambda obs, info, step: rng.uniform(-1, 1, width), "uniform random actions"


def scripted_actions(rng: np.random.Generator, task: str, sigma: float) -> tuple[Act, str]:
    """Return Meta-World's scripted policy with Gaussian noise, and its name."""
    from metaworld.policies import ENV_POLICY_MAP  # loads a simulator

    policy = ENV_POLICY_MAP[f"{wpt_envs.TASKS[task].name}-v3"]()  # type: ignore[abstract]

    def act(obs: np.ndarray, info: dict[str, Any], step: int) -> np.ndarray:
        action = policy.get_action(np.asarray(info["state"], np.float64))
        return np.clip(action + rng.normal(0, sigma, len(action)), -1, 1)

    return act, f"scripted policy, sigma {sigma}"
