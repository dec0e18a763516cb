"""The prior actor: a behaviour clone of the retrieved trajectories (A.3, Algorithm 1)."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import one_hot

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.windows import draw_places
from wpt_agents.model.images import Encoder
from wpt_agents.model.layers import Linear, LinearNorm
from wpt_agents.model.ops import op
from wpt_agents.model.sizes import Size

FRAMES = 3  # a single image does not show velocities
BC_VARIANCES = ("fixed", "trajectory")


def bc_loss(
    prediction: Tensor, action: Tensor, mask: Tensor, weight: Tensor | None = None
) -> Tensor:
    """Return -log π_bc(a | o) of a Gaussian up to constants: the mean squared error.

    :param prediction: (N, A), the Gaussian's mean
    :param action: (N, A), taken at the observation
    :param mask: (A,) bool, False in the padding, which does not count
    :param weight: (N,), factors of the squared errors, proportional to one over the variance; None
        for a fixed variance
    :return: scalar
    """
    assert prediction.shape == action.shape, (prediction.shape, action.shape)
    squares = (prediction - action).square() * mask
    if weight is not None:
        squares = squares * weight[:, None]
    return squares.sum() / (mask.sum() * len(action))


class TrajectoryVariances:
    """The variance σ_i² of the actions of each trajectory i around the prior actor's.

    They are running maximum-likelihood estimates, if the actions of trajectory i are Gaussian
    around the prior actor's with a variance of their own. The squared errors of a trajectory then
    count in proportion to 1 / σ_i², so that a noisy demonstrator has less influence. Not in the
    paper. Source of the idea, for discrete actions: https://arxiv.org/abs/2202.01288

    :param n: number of trajectories
    """

    least = 0.01  # a standard deviation of 0.1, so that no trajectory can outweigh all others
    rate = 0.05  # of the running mean

    def __init__(self, n: int, device: torch.device | None = None) -> None:
        self.values = torch.ones(n, device=device)

    def update(self, prediction: Tensor, action: Tensor, mask: Tensor, chosen: Tensor) -> None:
        """Update the variances with the errors of a batch.

        :param prediction: (N, A), the prior actor's actions
        :param action: (N, A), the recorded ones
        :param mask: (A,) bool, False in the padding
        :param chosen: (N,), the index of the trajectory that each row is of
        """
        error = ((prediction.detach() - action).square() * mask).sum(1) / mask.sum()
        drawn = one_hot(chosen, len(self.values)).to(error.dtype)  # a sum in a fixed order
        number = drawn.sum(0)
        mean = (error @ drawn) / number.clamp_min(1)
        self.values = torch.where(number > 0, self.values.lerp(mean, self.rate), self.values)

    def weights(self) -> Tensor:
        """Return the weight of each trajectory, (n,), 1 on average."""
        precision = 1 / self.values.clamp_min(self.least)
        return precision / precision.mean()


def draw_pairs(
    trajectories: Sequence[Trajectory], n: int, action_dim: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw n steps of all trajectories: the last images, and the action that was then taken.

    Before an episode's third image, its first image takes the place of the missing ones, as in
    acting.

    :return: images (n, F, 64, 64, 3) uint8, oldest first, actions (n, A), padded with zeros, and
        the indices of the trajectories, (n,)
    """
    ends = np.cumsum([len(trajectory) for trajectory in trajectories])
    chosen, steps = draw_places(ends, n, rng)
    times = np.maximum(steps[:, None] + np.arange(1 - FRAMES, 1), 0)
    image = np.stack([trajectories[i].image[t] for i, t in zip(chosen, times, strict=True)])
    action = np.zeros((n, action_dim), np.float32)
    for row, i, t in zip(action, chosen, steps, strict=True):
        used = trajectories[i].action_dim  # behind it may be padding of another width
        row[:used] = trajectories[i].action[t, :used]
    return torch.from_numpy(image), torch.from_numpy(action), torch.from_numpy(chosen)


def random_shift(image: Tensor, pad: int, generator: Generator | None = None) -> Tensor:
    """Shift each stack of frames by up to `pad` pixels, repeating the border.

    The paper does not state the largest shift. The authors' code has 3 pixels, and DrQ-v2 has 4 at
    84 x 84 pixels. With smaller shifts, the positions of objects are more precise
    (docs/experiments.md).

    :param image: (N, F, H, W, C)
    :return: (N, F, H, W, C), the frames of one stack shifted alike
    """
    shape = len(image), 2
    shift = torch.randint(-pad, pad + 1, shape, device=image.device, generator=generator)
    return shifted(image, shift, pad)


@op
def shifted(image: Tensor, shift: Tensor, pad: int) -> Tensor:
    """Replace pixel (i, j) of each stack by its pixel (i + y, j + x), or the nearest one there is.

    :param image: (N, F, H, W, C)
    :param shift: (N, 2) int, y and x of each stack
    :param pad: the largest entry of `shift`
    """
    n, _, height, width, _ = image.shape
    rows = (torch.arange(height, device=image.device) + shift[:, :1]).clamp(0, height - 1)
    columns = (torch.arange(width, device=image.device) + shift[:, 1:]).clamp(0, width - 1)
    index = torch.arange(n, device=image.device)[:, None, None]
    frames_last = image.permute(0, 2, 3, 1, 4)  # (N, H, W, F, C): one index moves all frames
    return frames_last[index, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2, 4)


def recent_frames(image: Tensor, is_first: Tensor) -> Tensor:
    """Return what the prior actor sees at each image of a sequence, from its third image on.

    Where an episode begins inside the sequence, its first image takes the place of missing ones.

    :param image: (B, T, 64, 64, 3)
    :param is_first: (B, T) bool
    :return: (B, T - 2, F, 64, 64, 3), oldest first
    """
    time = torch.arange(image.shape[1], device=image.device)
    begun = torch.where(is_first, time, 0).cummax(1).values
    before = torch.arange(1 - FRAMES, 1, device=image.device)
    times = torch.maximum(time[:, None] + before, begun[..., None])[:, FRAMES - 1 :]
    return image[torch.arange(len(image), device=image.device)[:, None, None], times]


class PriorActor(nn.Module):
    """π_bc(a | o): its own encoder over three stacked frames, then an MLP.

    :param size: the widths; the encoder has half the depth, at least 8
    :param action_dim: the padded action width, A
    """

    def __init__(self, size: Size, action_dim: int) -> None:
        super().__init__()
        # 48 channels at the paper's size, as the authors' clone has.
        self.encoder = Encoder(max(size.depth // 2, 8), 3 * FRAMES)
        self.layers = nn.Sequential(
            LinearNorm(self.encoder.embed_dim, size.units),
            LinearNorm(size.units, size.units),
            Linear(size.units, action_dim),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Return actions without clipping: (N, F, 64, 64, 3) uint8, oldest first -> (N, A)."""
        stacked = image.permute(0, 2, 3, 1, 4).flatten(-2)
        action: Tensor = self.layers(self.encoder(stacked))
        return action

    def act(self, image: Tensor, mask: Tensor) -> Tensor:
        """Return actions in [-1, 1], 0 in the padding: (N, F, 64, 64, 3) uint8 -> (N, A)."""
        action: Tensor = self(image)
        # Clipped only here: a loss on clipped actions has no gradient beyond the limits.
        return action.clamp(-1, 1) * mask
