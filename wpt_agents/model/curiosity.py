"""What is new: the intrinsic curiosity module (Pathak 2017), and an ensemble (Plan2Explore)."""

import torch
from torch import Tensor, nn

from wpt_agents.model.images import Encoder
from wpt_agents.model.layers import Linear, LinearNorm
from wpt_agents.model.sizes import Size

MEMBERS = 5  # of the ensemble, as in Plan2Explore


class Scale(nn.Module):
    """Divide by a running mean, so that rewards stay near 1 while the surprise decreases."""

    mean: Tensor
    weight: Tensor

    def __init__(self, keep: float = 0.99) -> None:  # our choice: a mean over about 100 updates
        super().__init__()
        self.keep = keep
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("weight", torch.zeros(()))

    def see(self, surprise: Tensor) -> None:
        """Update the mean with one batch; the first batch counts in full."""
        self.mean.mul_(self.keep).add_((1 - self.keep) * surprise.detach().mean())
        # the sum of the weights so far: dividing by it removes the bias towards the initial 0
        self.weight.mul_(self.keep).add_(1 - self.keep)

    def forward(self, surprise: Tensor) -> Tensor:
        """Return the scaled surprise: (...) -> (...)."""
        return surprise * (self.weight / self.mean.clamp_min(1e-8))  # all surprises may be 0


class ICM(nn.Module):
    """The intrinsic curiosity module: features, their forward model, and an inverse model.

    :param size: the widths
    :param action_dim: the padded action width, A
    :param forward_share: β of Pathak et al., the forward model's share of the loss
    """

    # 0.2 is the β of the paper's experiments.
    def __init__(self, size: Size, action_dim: int, forward_share: float = 0.2) -> None:
        super().__init__()
        self.forward_share = forward_share
        features = size.units
        units = size.units
        self.encoder = Encoder(size.depth)
        self.project = Linear(self.encoder.embed_dim, features)
        self.inverse = nn.Sequential(LinearNorm(2 * features, units), Linear(units, action_dim))
        self.dynamics = nn.Sequential(
            LinearNorm(features + action_dim, units), Linear(units, features)
        )
        self.scale = Scale()

    def features(self, image: Tensor) -> Tensor:
        """φ(o): (..., 64, 64, 3) uint8 -> (..., F)."""
        projected: Tensor = self.project(self.encoder(image))
        return projected

    def forward(self, image: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Apply both models to sequences.

        :param image: (B, T, 64, 64, 3) uint8
        :param action: (B, T, A), what led to each image
        :return: the actions that the inverse model reads from pairs of images (B, T - 1, A), and
            the surprise of each next image, the forward model's error (B, T - 1)
        """
        phi = self.features(image)
        before = phi[:, :-1]
        after = phi[:, 1:]
        read = self.inverse(torch.cat([before, after], -1))
        predicted = self.dynamics(torch.cat([before, action[:, 1:]], -1))
        return read, forward_error(predicted, after)


def forward_error(predicted: Tensor, features: Tensor) -> Tensor:
    """Pathak et al. (5) and (6), the curiosity: ½ ||φ^(o') - φ(o')||², (..., F) -> (...)."""
    return 0.5 * (predicted - features).square().sum(-1)


def icm_loss(
    read: Tensor, action: Tensor, surprise: Tensor, within: Tensor, forward_share: float = 0.2
) -> Tensor:
    """Pathak et al. (7) without its policy term: (1 - β) inverse loss + β forward loss.

    :param read: (..., A), the inverse model's actions; continuous, so their error is squared
    :param action: (..., A)
    :param surprise: (...), the `forward_error`
    :param within: (...) bool, False where the two images are of different episodes
    :param forward_share: β
    :return: scalar
    """
    assert read.shape == action.shape and surprise.shape == within.shape, (read.shape, within.shape)
    inverse = (read - action).square().sum(-1)
    loss = (1 - forward_share) * inverse + forward_share * surprise
    return (loss * within).sum() / within.sum().clamp_min(1)


class Ensemble(nn.Module):
    """One-step models that differ only in their first weights, and agree where there are data.

    :param size: the widths
    :param action_dim: the padded action width, A
    :param outputs: width of the prediction, the encoded next image
    :param members: number of models
    """

    def __init__(self, size: Size, action_dim: int, outputs: int, members: int = MEMBERS) -> None:
        super().__init__()
        inputs = size.deter + size.stoch * size.classes + action_dim
        self.members = nn.ModuleList(
            nn.Sequential(
                LinearNorm(inputs, size.units),
                LinearNorm(size.units, size.units),
                Linear(size.units, outputs),
            )
            for _ in range(members)
        )
        self.scale = Scale()

    def forward(self, feat: Tensor, action: Tensor) -> Tensor:
        """(..., D + S*K), (..., A) -> (members, ..., outputs)."""
        inputs = torch.cat([feat, action], -1)
        return torch.stack([member(inputs) for member in self.members])


def ensemble_loss(prediction: Tensor, target: Tensor, within: Tensor) -> Tensor:
    """Return -log p of Gaussians of fixed variance, up to constants, averaged over the members.

    :param prediction: (members, ..., E)
    :param target: (..., E); no gradient reaches it
    :param within: (...) bool, False where the target is of another episode
    :return: scalar
    """
    error = (prediction - target.detach()).square().mean(-1)
    return (error * within).sum() / (len(prediction) * within.sum()).clamp_min(1)


def disagreement(prediction: Tensor) -> Tensor:
    """Sekar et al. (1): the variance over the members, averaged: (members, ..., E) -> (...)."""
    return prediction.var(0, correction=0).mean(-1)
