"""The stochastic policy of soft actor-critic: a Gaussian that is squashed by tanh."""

import math

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from wpt_agents.model.frames import Trunk, mlp

LOG_STD = -20.0, 2.0  # bounds of the Gaussian's log standard deviation


class TanhActor(nn.Module):
    """The policy π(a | h), tanh of a Gaussian: a trunk, then an MLP to mean and log std.

    :param embed_dim: E, the width of the encoder's output
    :param features: width of the trunk's latent
    :param hidden: width of the MLP
    :param action_dim: A
    """

    def __init__(self, embed_dim: int, features: int, hidden: int, action_dim: int) -> None:
        super().__init__()
        self.trunk = Trunk(embed_dim, features)
        self.layers = mlp(features, hidden, 2 * action_dim)

    def forward(self, embed: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log std of the Gaussian before tanh: (N, E) -> (N, A), (N, A)."""
        mean, log_std = self.layers(self.trunk(embed)).chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD)


def tanh_sample(
    mean: Tensor, log_std: Tensor, generator: Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Draw a = tanh(u), u = μ + σ ε; log π(a) = Σ log N(u; μ, σ²) - log(1 - tanh² u).

    log(1 - tanh² u) = 2 (log 2 - u - softplus(-2 u)), which does not overflow.

    :param mean: (N, A)
    :param log_std: (N, A)
    :return: a, (N, A), and log π(a), (N,)
    """
    noise = torch.randn(mean.shape, device=mean.device, generator=generator)
    u = mean + log_std.exp() * noise
    normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    correction = 2 * (math.log(2) - u - F.softplus(-2 * u))
    return u.tanh(), (normal - correction).sum(-1)
