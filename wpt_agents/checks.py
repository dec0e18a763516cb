"""Refusals: what WPT cannot act in or learn from, each naming what came and what would do."""

import warnings

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from wpt_agents.dataset import TrajectoryDataset
from wpt_agents.trajectory import IMAGE_SIZE

IMAGE_SHAPE = (IMAGE_SIZE, IMAGE_SIZE, 3)


def check_spaces(env: VecEnv, max_action_dim: int) -> None:
    """Refuses an environment that WPT cannot act in; says when it will resize the images."""
    image, action = env.observation_space, env.action_space
    shape = getattr(image, "shape", None) or ()
    is_image = isinstance(image, spaces.Box) and image.dtype == np.uint8 and len(shape) == 3
    if not is_image or 3 not in (shape[0], shape[-1]):
        raise ValueError(
            f"WPT sees images, a Box of (64, 64, 3) uint8, but the environment's observations "
            f"are {image}: render it to pixels, e.g. with gymnasium's AddRenderObservation"
        )
    if not isinstance(action, spaces.Box) or len(action.shape) != 1:
        raise ValueError(
            f"WPT acts in a one-dimensional Box, the environment takes {action}: wrap it so that "
            "it takes continuous actions"
        )
    if not (np.isfinite(action.low).all() and np.isfinite(action.high).all()):
        raise ValueError(
            f"The action space must have finite bounds, it is {action}: wrap the environment "
            "with gymnasium's RescaleAction or ClipAction"
        )
    if action.shape[0] > max_action_dim:
        raise ValueError(
            f"The environment has {action.shape[0]} actions, the model was made for at most "
            f"max_action_dim={max_action_dim}: pre-train with a larger max_action_dim"
        )
    if sorted(shape) != sorted(IMAGE_SHAPE):
        warnings.warn(f"Observations of {shape} are resized to {IMAGE_SHAPE}", stacklevel=3)


def check_dataset(dataset: TrajectoryDataset, max_action_dim: int, batch_length: int) -> None:
    """Refuses a dataset that WPT cannot learn from."""
    if len(dataset) == 0:
        raise ValueError(f"The dataset {dataset.path} is empty: append trajectories to it")
    if dataset.image_size != IMAGE_SIZE:
        raise ValueError(
            f"The dataset {dataset.path} has images of {dataset.image_size} pixels, WPT takes "
            f"{IMAGE_SIZE}: resize them and store them anew"
        )
    widest, longest = max(dataset.action_dims), max(dataset.lengths) + 1
    if widest > max_action_dim:
        raise ValueError(
            f"The dataset {dataset.path} has {widest} actions, the model at most "
            f"max_action_dim={max_action_dim}: give max_action_dim={widest}"
        )
    if longest < batch_length:
        raise ValueError(
            f"The longest trajectory of {dataset.path} has {longest} images, a batch window "
            f"takes {batch_length}: give batch_length={longest} or less"
        )


def check_rewards(rewards: np.ndarray, step: int) -> None:
    """Refuses rewards that are not finite, before anything of them is stored."""
    if not np.isfinite(rewards).all():
        i = int(np.flatnonzero(~np.isfinite(rewards))[0])
        raise ValueError(
            f"Environment {i} returned the reward {rewards[i]} at step {step}; nothing of this "
            "episode was stored: mend the environment's reward"
        )
