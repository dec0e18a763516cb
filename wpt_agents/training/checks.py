"""Refusals: what WPT cannot act in or learn from, each naming what came and what would do."""

from collections.abc import Collection, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import IMAGE_SIZE, Trajectory
from wpt_agents.files.names import unknown_name
from wpt_agents.model.networks import find_size
from wpt_agents.training.spaces import IMAGE_SHAPE

COUNTS = (  # keywords of WPT that count something there must be one of
    *("max_action_dim", "batch_size", "batch_length", "imagine_horizon"),
    *("num_retrieve", "bc_steps", "bc_batch_size", "episode_length"),
)
OPTIONAL = (  # keywords that may be None
    *("learning_rate", "actor_critic_learning_rate", "episode_length", "embodiment", "seed"),
    *("return_norm", "zero_init_heads", "imagine_starts"),
)
WHOLE = ("imagine_starts", "actor_delay")  # keywords that must be whole numbers, of at least 0
SWITCHES = "return_norm", "zero_init_heads", "compile", "data_dependent_init"
SHARES = ("gamma", "lam", "target_fraction", "unimix", "offline_ratio")
AMOUNTS = (  # and those that may be 0 but not less
    *("learning_rate", "actor_critic_learning_rate", "bc_learning_rate", "weight_decay"),
    *("grad_clip", "ent_coef", "dyn_scale", "rep_scale", "free_nats", "actor_outscale"),
    *("train_ratio", "learning_starts", "warmup_steps"),
)


CHOICES: dict[str, Collection[str]] = {
    "precision": ("fp32", "bf16"),
    "free_nats_mode": ("mean", "element"),
    "retrieval": ("nearest", "random"),
    "train_freq": ("episode", "step"),
}


def plain(value: Any) -> Any:
    """NumPy's numbers as Python's, which a model file can hold."""
    return value.item() if isinstance(value, np.generic) else value


def check_hyperparameters(given: Mapping[str, Any]) -> None:
    """Refuses values of WPT's keywords that make no sense, each by name.

    :raises ValueError: a count that is no whole number from 1 on, a share outside [0, 1], something
        else that is no number from 0 on, an unknown choice
    """
    find_size(given["size"])
    for name, value in given.items():
        if name in OPTIONAL and value is None:
            continue
        if name in CHOICES and value not in tuple(CHOICES[name]):
            raise unknown_name(name, value, CHOICES[name])
        number = isinstance(value, Real) and not isinstance(value, bool)
        least = 2 if name == "imagine_horizon" else 1  # the first state's value is no action's
        if name in COUNTS and not (number and isinstance(value, Integral) and int(value) >= least):
            raise ValueError(f"{name} is a whole number from {least} on, got {value!r}")
        if name in WHOLE and not (number and isinstance(value, Integral) and int(value) >= 0):
            raise ValueError(f"{name} must be a whole number of at least 0, got {value!r}")
        if name in SWITCHES and not isinstance(value, bool):
            raise ValueError(f"{name} is True or False, got {value!r}")
        if name in SHARES and not (number and 0 <= value <= 1):
            raise ValueError(f"{name} is a share in [0, 1], got {value!r}")
        if name == "unimix" and value == 0:
            raise ValueError("unimix=0 allows latents of probability 0, whose KL is infinite")
        if name in AMOUNTS and not (number and 0 <= value < np.inf):
            raise ValueError(f"{name} is a number from 0 on, got {value!r}")


def check_device(device: torch.device | str) -> None:
    """Refuses a device that torch cannot compute on here, instead of falling back to the CPU."""
    if device == "auto":
        return
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(
            f"device={str(device)!r} does not work here (torch {torch.__version__} finds "
            f"{torch.cuda.device_count()} CUDA devices): give device='auto' or 'cpu', or install a "
            "torch that was built for the device"
        ) from error


def check_images(dataset: TrajectoryDataset) -> None:
    """Refuses a dataset that shows WPT nothing, or images of another size."""
    if len(dataset) == 0:
        raise ValueError(f"The dataset {dataset.path} is empty: append trajectories to it")
    if dataset.image_size != IMAGE_SIZE:
        raise ValueError(
            f"The dataset {dataset.path} has images of {dataset.image_size} pixels, WPT takes "
            f"{IMAGE_SIZE}: resize them and store them anew"
        )


def check_dataset(dataset: TrajectoryDataset, max_action_dim: int, batch_length: int) -> None:
    """Refuses a dataset that WPT cannot learn from."""
    check_images(dataset)
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


def check_trajectory(trajectory: Trajectory, max_action_dim: int) -> None:
    """Refuses a trajectory that a model cannot look at."""
    if trajectory.image.shape[1:] != IMAGE_SHAPE:
        raise ValueError(f"The trajectory's images are {trajectory.image.shape[1:]}: resize to 64")
    if trajectory.action_dim > max_action_dim:
        raise ValueError(
            f"The trajectory has {trajectory.action_dim} actions, the model takes at most "
            f"max_action_dim={max_action_dim}: pre-train with a larger max_action_dim"
        )


def check_rewards(rewards: np.ndarray, step: int) -> None:
    """Refuses rewards that are not finite, before anything of them is stored."""
    if not np.isfinite(rewards).all():
        i = int(np.flatnonzero(~np.isfinite(rewards))[0])
        raise ValueError(
            f"Environment {i} returned the reward {rewards[i]} at step {step}; nothing of this "
            "episode was stored: mend the environment's reward"
        )
