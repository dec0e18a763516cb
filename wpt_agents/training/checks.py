"""Checks of user input; every error names the wrong value and the remedy."""

from typing import Any

import numpy as np
import torch

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import IMAGE_SIZE, Trajectory
from wpt_agents.training.keywords import is_number
from wpt_agents.training.spaces import IMAGE_SHAPE


def check_device(device: torch.device | str) -> None:
    """Raise a ValueError for a device that torch cannot use, instead of using the CPU."""
    if device == "auto":
        return
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(
            f"device={str(device)!r} does not work here (torch {torch.__version__} finds "
            f"{torch.cuda.device_count()} CUDA devices): pass device='auto' or 'cpu', or install a "
            "torch that was built for the device"
        ) from error


def check_images(dataset: TrajectoryDataset) -> None:
    """Raise a ValueError for a dataset without trajectories, or with images of another size."""
    if len(dataset) == 0:
        raise ValueError(f"The dataset {dataset.path} is empty: append trajectories to it")
    if dataset.image_size != IMAGE_SIZE:
        raise ValueError(
            f"The dataset {dataset.path} has images of {dataset.image_size} pixels, agents take "
            f"{IMAGE_SIZE}: make a resized copy, TrajectoryDataset.merge('NEW', "
            f"[TrajectoryDataset.of(dataset)], image_size={IMAGE_SIZE})"
        )


def check_dataset(dataset: TrajectoryDataset, max_action_dim: int, batch_length: int) -> None:
    """Raise a ValueError for a dataset that WPT cannot learn from."""
    check_images(dataset)
    widest = max(dataset.action_dims)
    longest = max(dataset.lengths) + 1
    if widest > max_action_dim:
        raise ValueError(
            f"The dataset {dataset.path} has {widest} actions, the model at most "
            f"max_action_dim={max_action_dim}: pass max_action_dim={widest} to a new model, or use "
            f"the other trajectories alone, dataset.subset(dataset.action_dims <= {max_action_dim})"
        )
    if longest < batch_length:
        raise ValueError(
            f"The longest trajectory of {dataset.path} has {longest} images, a batch window "
            f"takes {batch_length}: pass batch_length={longest} or less"
        )


def check_trajectory(trajectory: Trajectory, max_action_dim: int, context: int) -> None:
    """Raise a ValueError for a trajectory that a model cannot predict, or for no context."""
    if context < 1:
        raise ValueError(f"context, the number of images seen, must be at least 1, got {context}")
    if trajectory.image.shape[1:] != IMAGE_SHAPE:
        raise ValueError(
            f"The trajectory's images are {trajectory.image.shape[1:]}, the model takes "
            f"{IMAGE_SHAPE}: resize them by wpt_agents.data.images.resized(image, {IMAGE_SIZE})"
        )
    if trajectory.action_dim > max_action_dim:
        raise ValueError(
            f"The trajectory has {trajectory.action_dim} actions, the model takes at most "
            f"max_action_dim={max_action_dim}: train a new one with "
            f"max_action_dim={trajectory.action_dim}"
        )


def whole_steps(total_timesteps: Any) -> int:
    """Return the argument of `learn` as an int; raise a ValueError for other values."""
    if is_number(total_timesteps) and total_timesteps >= 0 and total_timesteps % 1 == 0:
        return int(total_timesteps)  # 2e4, too
    raise ValueError(
        f"total_timesteps must be a whole number of at least 0, got {total_timesteps!r}: pass the "
        "number of steps to collect, such as learn(10_000)"
    )


def check_rewards(rewards: np.ndarray, step: int) -> None:
    """Raise a ValueError for rewards that are not finite, before they are stored.

    :param rewards: (n,), of n environments
    :param step: the number of the step, for the message
    """
    if not np.isfinite(rewards).all():
        i = int(np.flatnonzero(~np.isfinite(rewards))[0])
        raise ValueError(
            f"Environment {i} returned the reward {rewards[i]} at step {step}; nothing of this "
            "episode was stored: correct the environment's reward"
        )
