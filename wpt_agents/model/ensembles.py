"""Ensembles whose members are computed together: RLPD's critics and ExPLORe's reward heads."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wpt_agents.model.frames import Trunk


class EnsembleLinear(nn.Module):
    """K linear layers in one product: (K, N, inputs) -> (K, N, outputs)."""

    def __init__(self, members: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(members, inputs, outputs))
        self.bias = nn.Parameter(torch.zeros(members, 1, outputs))
        for matrix in self.weight:
            nn.init.xavier_uniform_(matrix.data)

    def forward(self, x: Tensor) -> Tensor:
        """Member k's layer acts on x[k]: (K, N, inputs) -> (K, N, outputs)."""
        return torch.baddbmm(self.bias, x, self.weight)


class EnsembleNorm(nn.Module):
    """Layer norm of each member with a scale and an offset of its own: (K, N, W) -> (K, N, W)."""

    def __init__(self, members: int, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(members, 1, width))
        self.bias = nn.Parameter(torch.zeros(members, 1, width))

    def forward(self, x: Tensor) -> Tensor:
        """Member k's norm acts on x[k]: (K, N, W) -> (K, N, W)."""
        return F.layer_norm(x, x.shape[-1:]) * self.weight + self.bias


class CriticEnsemble(nn.Module):
    """The value functions Q_1 .. Q_K on a common trunk, with layer norm before each ReLU.

    :param embed_dim: E, the width of the encoder's output
    :param features: width of the trunk's latent z
    :param hidden: width of the two hidden layers
    :param action_dim: A
    :param members: K
    """

    def __init__(
        self, embed_dim: int, features: int, hidden: int, action_dim: int, members: int
    ) -> None:
        super().__init__()
        self.trunk = Trunk(embed_dim, features)
        self.members = members
        self.layers = nn.Sequential(
            EnsembleLinear(members, features + action_dim, hidden),
            EnsembleNorm(members, hidden),
            nn.ReLU(),
            EnsembleLinear(members, hidden, hidden),
            EnsembleNorm(members, hidden),
            nn.ReLU(),
            EnsembleLinear(members, hidden, 1),
        )

    def forward(self, embed: Tensor, action: Tensor) -> Tensor:
        """Return the values by all members: (N, E), (N, A) -> (K, N)."""
        inputs = torch.cat([self.trunk(embed), action], -1)
        values: Tensor = self.layers(inputs.expand(self.members, -1, -1))
        return values.squeeze(-1)


class RewardEnsemble(nn.Module):
    """Reward heads r_1(z) .. r_K(z), which differ in initial weights and in their training rows.

    :param features: width of z, the critics' latent
    :param hidden: width of the two hidden layers
    :param members: K
    """

    def __init__(self, features: int, hidden: int, members: int) -> None:
        super().__init__()
        self.members = members
        self.layers = nn.Sequential(
            EnsembleLinear(members, features, hidden),
            nn.ReLU(),
            EnsembleLinear(members, hidden, hidden),
            nn.ReLU(),
            EnsembleLinear(members, hidden, 1),
        )

    def forward(self, latent: Tensor) -> Tensor:
        """Return the rewards by all members: (N, Z) -> (K, N)."""
        rewards: Tensor = self.layers(latent.expand(self.members, -1, -1))
        return rewards.squeeze(-1)
