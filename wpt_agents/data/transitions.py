"""n-step transitions of stacked frames, drawn from whole episodes: the batches of DrQ-v2 and RLPD.

An episode is stored once. A transition's six frames are looked up when it is drawn, so a replay
buffer of 75,000 steps takes 0.9 GB, where one that stores stacked observations takes 5.5 GB.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.windows import draw_places


@dataclass(frozen=True)
class Transitions:
    """N transitions over n steps: what was done at step s, and what followed until step s + n.

    :param image: (N, F, 64, 64, 3) uint8, the frames up to o_s, oldest first; or their features
    :param action: (N, A) float32, a_s
    :param reward: (N,) float32, R of `n_step_return`; 0 where rewards are unknown
    :param discount: (N,) float32, D of `n_step_return`, the weight of the value at `next_image`
    :param next_image: (N, F, 64, 64, 3) uint8, the frames up to o_{s+n}
    """

    image: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_image: Tensor

    def __post_init__(self) -> None:
        sizes = {f.name: len(getattr(self, f.name)) for f in fields(self)}
        assert len(set(sizes.values())) == 1, sizes
        assert self.image.shape == self.next_image.shape, (self.image.shape, self.next_image.shape)

    def __len__(self) -> int:
        return len(self.action)

    def to(self, device: torch.device | str) -> "Transitions":
        """Return the same transitions on `device`."""
        return Transitions(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


@dataclass(frozen=True)
class Steps:
    """N times H steps in a row, of one episode each: what MR.Q's encoder learns to predict.

    :param image: (N, F, 64, 64, 3) uint8, the frames up to the first step, oldest first
    :param action: (N, H, A) float32
    :param reward: (N, H) float32
    :param end: (N, H) float32, 1 where the step led to a terminal state
    :param inside: (N, H) float32, 0 for steps after the end of the episode
    :param next_image: (N, H, F, 64, 64, 3) uint8, the frames up to the image that each step led to
    """

    image: Tensor
    action: Tensor
    reward: Tensor
    end: Tensor
    inside: Tensor
    next_image: Tensor

    def to(self, device: torch.device | str) -> "Steps":
        """Return the same steps on `device`."""
        return Steps(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


def random_shift(image: np.ndarray, pad: int, rng: np.random.Generator) -> np.ndarray:
    """Shift each stack of frames by up to `pad` pixels in both directions, repeating the border.

    It is DrQ-v2's augmentation, whose bilinear sampling always falls on whole pixels.

    :param image: (N, F, H, W, C)
    :return: (N, F, H, W, C), the frames of one stack shifted alike
    """
    return cut_shifted(image, rng.integers(0, 2 * pad + 1, (len(image), 2)), pad)


def cut_shifted(image: np.ndarray, offset: np.ndarray, pad: int) -> np.ndarray:
    """Widen each stack of frames by `pad` border pixels and cut out images of the former size.

    :param image: (N, F, H, W, C)
    :param offset: (N, 2) int, from 0 to 2 * pad: the first row and column to cut out
    """
    n, frames, height, width, colours = image.shape
    middle = slice(pad, pad + height), slice(pad, pad + width)
    padded = np.empty((n, frames, height + 2 * pad, width + 2 * pad, colours), image.dtype)
    padded[:, :, middle[0], middle[1]] = image
    padded[:, :, middle[0], :pad] = image[:, :, :, :1]
    padded[:, :, middle[0], pad + width :] = image[:, :, :, -1:]
    padded[:, :, :pad] = padded[:, :, pad : pad + 1]
    padded[:, :, pad + height :] = padded[:, :, pad + height - 1 : pad + height]
    moved = [x[:, y : y + height, z : z + width] for x, (y, z) in zip(padded, offset, strict=True)]
    return np.stack(moved)


def concatenate(parts: Sequence[Transitions]) -> Transitions:
    """Return the rows of all parts, in order."""
    names = [f.name for f in fields(Transitions)]
    return Transitions(**{name: torch.cat([getattr(p, name) for p in parts]) for name in names})


def n_step_return(reward: np.ndarray, gamma: float, terminated: bool) -> tuple[float, float]:
    """Return R = Σ_i γ^i r_i and D = γ^n, or D = 0 if the last step led to a terminal state.

    A time limit is no terminal state: the value of the last image counts.

    :param reward: (n,), the rewards of the steps s .. s + n - 1
    :return: R and D of the target R + D Q(o_{s+n})
    """
    powers = gamma ** np.arange(len(reward) + 1)
    return float(powers[:-1] @ reward), 0.0 if terminated else float(powers[-1])


def draw_transitions(
    trajectories: Sequence[Trajectory],
    size: int,
    n_steps: int,
    gamma: float,
    action_dim: int,
    rng: np.random.Generator,
    pad: int = 0,
    frames: int = 3,
    seen: Sequence[np.ndarray] | None = None,
    tails: bool = False,
) -> Transitions:
    """Draw transitions whose n steps lie inside one episode, every start equally likely.

    Before an episode's third image, copies of its first image replace those that are missing, as in
    acting. A part of a long episode is treated like an episode, although in acting its first images
    are preceded by others. Episodes shorter than n steps are drawn whole. DrQ-v2 draws an episode
    and then a start in it, which is the same where all episodes are equally long.

    :param size: N, the number of transitions
    :param n_steps: n, at least 1
    :param action_dim: A; narrower actions are padded with zeros
    :param pad: largest shift of `image` and `next_image` in pixels, drawn independently
    :param frames: F, the images in a stack
    :param seen: for each trajectory an array (T + 1, ...) that replaces its images, such as their
        features
    :param tails: whether the last n - 1 steps of an episode that terminated are starts, too: no
        rewards follow its end, so sums of fewer rewards are complete there
    :raises ValueError: there is no trajectory
    """
    if not trajectories:
        raise ValueError("There are no episodes to draw transitions from; collect some first")
    numbers = [
        len(t) if tails and t.terminated else max(len(t) - n_steps, 0) + 1 for t in trajectories
    ]
    chosen, begin = draw_places(np.cumsum(numbers), size, rng)
    shown = [t.image for t in trajectories] if seen is None else seen
    # both ends of a transition in one array, which is filled row by row
    image = np.empty((2, size, frames, *shown[0].shape[1:]), shown[0].dtype)
    action = np.zeros((size, action_dim), np.float32)
    outcome = np.zeros((2, size), np.float32)
    before = np.arange(1 - frames, 1)
    for row, (i, s) in enumerate(zip(chosen, begin, strict=True)):
        trajectory = trajectories[i]
        end = min(s + n_steps, len(trajectory))
        for side, time in enumerate((s, end)):
            image[side, row] = shown[i][np.maximum(time + before, 0)]
        action[row, : trajectory.action_dim] = trajectory.action[s, : trajectory.action_dim]
        reward = np.zeros(end - s) if trajectory.reward is None else trajectory.reward[s:end]
        terminated = trajectory.terminated and end == len(trajectory)
        outcome[:, row] = n_step_return(reward, gamma, terminated)
    # Shifted independently, as in DrQ-v2.
    now, then = (random_shift(side, pad, rng) if pad else side for side in image)
    tensors = [torch.from_numpy(array) for array in (now, action, *outcome, then)]
    return Transitions(*tensors)


def draw_steps(
    trajectories: Sequence[Trajectory],
    size: int,
    horizon: int,
    action_dim: int,
    rng: np.random.Generator,
    pad: int = 0,
    frames: int = 3,
) -> Steps:
    """Draw sequences of H steps, every first step equally likely.

    An episode may end before the last of the H steps; its last step is then repeated.

    :param size: N
    :param horizon: H
    :param action_dim: A; narrower actions are padded with zeros
    :param pad: largest shift of each stack of frames in pixels, drawn independently
    :param frames: F, the images in a stack
    :raises ValueError: there is no trajectory
    """
    if not trajectories:
        raise ValueError("There are no episodes to draw steps from; collect some first")
    ends = np.cumsum([len(trajectory) for trajectory in trajectories])
    chosen, begin = draw_places(ends, size, rng)
    shape = trajectories[0].image.shape[1:]
    images = np.empty((size, horizon + 1, frames, *shape), np.uint8)
    action = np.zeros((size, horizon, action_dim), np.float32)
    outcome = np.zeros((3, size, horizon), np.float32)
    before = np.arange(1 - frames, 1)
    for row, (i, first) in enumerate(zip(chosen, begin, strict=True)):
        trajectory = trajectories[i]
        length = len(trajectory)
        times = np.minimum(first + np.arange(horizon + 1), length)
        images[row] = trajectory.image[np.maximum(times[:, None] + before, 0)]
        steps = np.minimum(times[:-1], length - 1)
        action[row, :, : trajectory.action_dim] = trajectory.action[steps, : trajectory.action_dim]
        if trajectory.reward is not None:
            outcome[0, row] = trajectory.reward[steps]
        outcome[1, row] = trajectory.terminated & (steps == length - 1)
        outcome[2, row] = first + np.arange(horizon) < length
    if pad:
        images = random_shift(images.reshape(-1, frames, *shape), pad, rng).reshape(images.shape)
    arrays = images[:, 0], action, *outcome, images[:, 1:]
    return Steps(*(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays))
