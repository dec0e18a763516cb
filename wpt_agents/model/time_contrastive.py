"""R3M's pre-training objective (Nair et al., 2022): its loss, and the clips that it is made of.

Source: https://arxiv.org/abs/2203.12601, Eq. (1). Negatives are never the clip itself, where the
published code draws permutations in which a clip can meet itself.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor


def similarity(x: Tensor, y: Tensor) -> Tensor:
    """Return the similarity S(x, y) = -||x - y||_2: (..., Z), (..., Z) -> (...)."""
    # Clamped, because the square root has no gradient at 0.
    return -(x - y).square().sum(-1).clamp_min(1e-12).sqrt()


def time_contrastive_loss(z: Tensor, others: Tensor) -> Tensor:
    """The loss by which images that are near in time become more similar than others.

    For s0 < s1 <= s2 it is the mean of
    -log[e^S(s1,s2) / (e^S(s1,s2) + e^S(s0,s2) + Σ e^S(s2,s2'))] and
    -log[e^S(s0,s1) / (e^S(s0,s1) + e^S(s0,s2) + Σ e^S(s0,s0'))], where ' is another clip.

    :param z: (B, 3, Z), features of the images s0, s1, s2 of each clip
    :param others: (K, B), the numbers of the clips that each clip is contrasted with
    :return: scalar
    """
    assert z.shape[1] == 3 and others.shape[1] == len(z), (z.shape, others.shape)
    z0, z1, z2 = z.unbind(1)
    far = similarity(z0, z2)
    losses = []
    for near, anchor in ((similarity(z1, z2), z2), (similarity(z0, z1), z0)):
        elsewhere = similarity(anchor, anchor[others])  # (K, B)
        every = torch.cat([near[None], far[None], elsewhere])
        losses.append(every.logsumexp(0) - near)
    return torch.stack(losses).mean()


def r3m_loss(z: Tensor, others: Tensor) -> Tensor:
    """The time-contrastive loss + 1e-5 E||z||_1 + 1e-5 E||z||_2: (B, 3, Z), (K, B) -> scalar."""
    # 1e-5 and 1e-5: the weights of the published code.
    size = z.abs().sum(-1).mean() + z.square().sum(-1).clamp_min(1e-12).sqrt().mean()
    return time_contrastive_loss(z, others) + 1e-5 * size


def aligned(z: Tensor) -> Tensor:
    """Return the share of clips with S(s1, s2) > S(s0, s2): (B, 3, Z) -> scalar."""
    z0, z1, z2 = z.unbind(1)
    return (similarity(z1, z2) > similarity(z0, z2)).float().mean()


def draw_clips(
    lengths: np.ndarray,
    images: Callable[[int, list[int]], np.ndarray],
    size: int,
    rng: np.random.Generator,
) -> Tensor:
    """Draw images s0 < s1 <= s2 of random trajectories: (size, 3, 64, 64, 3) uint8.

    s1 is any image but the first, s0 any one before it, and s2 any one from it on.

    :param lengths: (N,), the number of actions of each trajectory, one less than its images
    :param images: returns the images of a trajectory, by its number, at some times
    """
    clips = []
    for i in rng.integers(len(lengths), size=size):
        end = int(lengths[i]) + 1
        # s1 first, as in the published code: with s0 first, s1 and s2 would crowd at the end.
        second = int(rng.integers(1, end))
        first = int(rng.integers(second))
        clips.append(images(int(i), [first, second, int(rng.integers(second, end))]))
    return torch.from_numpy(np.stack(clips))


def derangements(size: int, count: int, rng: np.random.Generator) -> Tensor:
    """Draw, `count` times, a clip other than itself for each of `size` clips: (count, size)."""
    assert size > 1, "a clip needs another one to be contrasted with"
    shift = rng.integers(1, size, (count, size))
    return torch.from_numpy((np.arange(size) + shift) % size)


def random_crop(clips: Tensor, rng: np.random.Generator) -> Tensor:
    """Cut out 20 to 100 % of the area and resize it; the same for all images of a clip.

    :param clips: (B, 3, 64, 64, 3) uint8
    :return: the same shape, float32 in 0 to 255
    """
    n = len(clips)
    area = rng.uniform(0.2, 1.0, n)  # these shares and ratios are those of the published code
    ratio = np.exp(rng.uniform(math.log(3 / 4), math.log(4 / 3), n))
    sides = np.minimum(np.sqrt(np.stack([area * ratio, area / ratio], 1)), 1.0)
    centre = rng.uniform(-1, 1, (n, 2)) * (1 - sides)
    theta = np.zeros((n, 2, 3), np.float32)
    theta[:, 0, 0], theta[:, 1, 1] = sides.T
    theta[:, :, 2] = centre
    planes = clips.permute(0, 1, 4, 2, 3).flatten(1, 2).float()
    grid = F.affine_grid(torch.from_numpy(theta).to(clips.device), list(planes.shape), False)
    cut = F.grid_sample(planes, grid, padding_mode="border", align_corners=False)
    frames: Tensor = cut.unflatten(1, (3, 3))
    return frames.permute(0, 1, 3, 4, 2)
