"""MR.Q's networks and losses (Fujimoto et al., 2025): value learning on model-based features.

Source: https://arxiv.org/abs/2501.16142; equations and widths are those of the paper. An encoder
z_s = f(o) and z_sa = g(z_s, a) learn to predict reward, next z_s and the end of the episode by a
linear map; actor and value functions learn on these features, which they do not train.
"""

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from wpt_agents.data.trajectory import IMAGE_SIZE
from wpt_agents.data.transitions import Steps
from wpt_agents.model.behavior_cloning import FRAMES
from wpt_agents.model.distributions import symexp

BINS = 65  # of the rewards, symexp-spaced over [-e^10, e^10]
STRIDES = (2, 2, 2, 1)  # of 3x3 kernels: 64 > 31 > 15 > 7 > 5 pixels a side


class NormedMLP(nn.Module):
    """Two hidden layers, each followed by a layer norm without weights and an activation.

    :param inputs: width of the input
    :param hidden: width of the hidden layers
    :param outputs: width of the output
    :param activation: "elu" or "relu"
    """

    def __init__(self, inputs: int, hidden: int, outputs: int, activation: str = "elu") -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(inputs, hidden), nn.Linear(hidden, hidden)])
        self.last = nn.Linear(hidden, outputs)
        self.activation = getattr(F, activation)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs) -> (N, outputs)."""
        for layer in self.layers:
            x = self.activation(normed(layer(x)))
        out: Tensor = self.last(x)
        return out


class StateEncoder(nn.Module):
    """The encoder z_s = f(o): four convolutions with ELU, a linear layer, a layer norm, ELU.

    :param channels: number of channels of each convolution
    :param width: Z, of z_s
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        inputs = [3 * FRAMES, *[channels] * 3]
        self.layers = nn.ModuleList(
            nn.Conv2d(i, channels, 3, stride) for i, stride in zip(inputs, STRIDES, strict=True)
        )
        side = IMAGE_SIZE
        for stride in STRIDES:
            side = (side - 3) // stride + 1
        self.last = nn.Linear(channels * side**2, width)

    def forward(self, image: Tensor) -> Tensor:
        """Encode stacks of frames, oldest first: (N, F, 64, 64, 3) uint8 -> (N, Z)."""
        x = image.permute(0, 1, 4, 2, 3).flatten(1, 2).float() / 255 - 0.5
        for layer in self.layers:
            x = F.elu(layer(x))
        return F.elu(normed(self.last(x.flatten(1))))


class ModelEncoder(nn.Module):
    """The encoders f and g, and the linear map m from z_sa to end, next z_s and reward.

    :param channels: number of channels of each convolution
    :param width: Z, of z_s and z_sa
    :param hidden: width of the MLP of g
    :param action_dim: A
    """

    def __init__(self, channels: int, width: int, hidden: int, action_dim: int) -> None:
        super().__init__()
        self.width = width
        self.state = StateEncoder(channels, width)
        self.action = nn.Linear(action_dim, width // 2)
        self.pair = NormedMLP(width + width // 2, hidden, width)
        self.model = nn.Linear(width, 1 + width + BINS)

    def forward(self, z: Tensor, action: Tensor) -> Tensor:
        """z_sa = g(z_s, a): (N, Z), (N, A) -> (N, Z)."""
        z_sa: Tensor = self.pair(torch.cat([z, F.elu(self.action(action))], -1))
        return z_sa

    def predict(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """m(z_sa): the end of the episode (N,), the next z_s (N, Z), reward logits (N, BINS)."""
        end, next_z, reward = self.model(self(z, action)).split([1, self.width, BINS], -1)
        return end.squeeze(-1), next_z, reward


class ValuePair(nn.Module):
    """The value functions Q_1 and Q_2 of z_sa: three hidden layers with layer norm and ELU.

    :param width: Z
    :param hidden: width of the hidden layers
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.bodies = nn.ModuleList(NormedMLP(width, hidden, hidden) for _ in range(2))
        self.heads = nn.ModuleList(nn.Linear(hidden, 1) for _ in range(2))

    def forward(self, z_sa: Tensor) -> Tensor:
        """Return both values: (N, Z) -> (2, N)."""
        both = zip(self.bodies, self.heads, strict=True)
        return torch.stack([head(F.elu(normed(body(z_sa)))) for body, head in both]).squeeze(-1)


def normed(x: Tensor) -> Tensor:
    """Apply a layer norm without weights over the last axis: (..., W) -> (..., W)."""
    return F.layer_norm(x, x.shape[-1:])


def xavier_relu(module: nn.Module) -> None:
    """Set MR.Q's initial weights: Xavier uniform times sqrt 2, zero biases; for `apply`."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.xavier_uniform_(module.weight, nn.init.calculate_gain("relu"))
        assert module.bias is not None
        nn.init.zeros_(module.bias)


def reward_bins(device: torch.device | str = "cpu") -> Tensor:
    """Return the values of the bins, (BINS,): symexp of evenly spaced numbers in [-10, 10]."""
    return symexp(torch.linspace(-10, 10, BINS, device=device))


def reward_two_hot(reward: Tensor) -> Tensor:
    """Express a reward as weights of the two nearest bins: (...) -> (..., BINS).

    The weighted mean of the bins is the reward; DreamerV3's `two_hot` interpolates symlog(reward)
    instead.
    """
    bins = reward_bins(reward.device)
    reward = reward.clamp(bins[0], bins[-1])
    below = (torch.searchsorted(bins, reward.contiguous(), right=True) - 1).clamp(0, BINS - 2)
    upper = (reward - bins[below]) / (bins[below + 1] - bins[below])
    weights = torch.zeros(*reward.shape, BINS, device=reward.device)
    index = below.unsqueeze(-1)
    weights.scatter_(-1, index, 1 - upper.unsqueeze(-1))
    return weights.scatter_(-1, index + 1, upper.unsqueeze(-1))


def encoder_loss(
    encoder: ModelEncoder,
    batch: Steps,
    target: Tensor,
    weights: tuple[float, float, float],
) -> Tensor:
    """Sum over H steps of `λ_d |m_z - z̄|² + λ_r CE(m_r, r) + λ_e (m_e - end)²`.

    The prediction of each step is the input of the next one. Steps after the end of an episode do
    not count.

    :param target: (N, H, Z), z̄ of what each step led to, by the target encoder
    :param weights: λ_d, λ_r, λ_e of dynamics, reward and end
    :return: scalar
    """
    dynamics, of_reward, of_end = weights
    z = encoder.state(batch.image)
    loss = target.new_zeros(())
    for step in range(batch.action.shape[1]):
        end, z, logits = encoder.predict(z, batch.action[:, step])
        missed = (z - target[:, step]).square().mean(-1)
        surprise = -(reward_two_hot(batch.reward[:, step]) * logits.log_softmax(-1)).sum(-1)
        wrong = (end - batch.end[:, step]).square()
        errors = dynamics * missed + of_reward * surprise + of_end * wrong
        loss = loss + (batch.inside[:, step] * errors).mean()
    return loss


def scaled_target(
    reward: Tensor, discount: Tensor, next_q: Tensor, scale: float, next_scale: float
) -> Tensor:
    """Target y = (R + D s' min_k Qbar_k) / s: values in units of the mean absolute reward s.

    :param reward: (N,), the n-step sum
    :param discount: (N,), D = γ^n, or 0 after a terminal state
    :param next_q: (2, N), the values of the target networks, in units of `next_scale`
    :param scale: s
    :param next_scale: s'
    :return: (N,), y
    """
    assert reward.shape == discount.shape == next_q.shape[1:], (reward.shape, next_q.shape)
    return (reward + discount * next_scale * next_q.amin(0)) / scale


def value_loss(q: Tensor, target: Tensor, alpha: float = 0.4) -> Tensor:
    """Huber loss, in which a row weighs `p = max(δ_1, δ_2, 1)^α` over the mean p; δ are errors.

    MR.Q draws transitions in proportion to p, the larger error of both value functions. On uniform
    draws these weights give the same expected gradient, and there are no priorities to keep
    (https://arxiv.org/abs/2007.06049).

    :param q: (2, N)
    :param target: (N,); no gradient reaches it
    :return: scalar
    """
    target = target.detach().expand_as(q)
    error = (q.detach() - target).abs()
    priority = error.amax(0).clamp_min(1).pow(alpha)  # α = 0.4 and the 1 are MR.Q's, of its replay
    loss = F.smooth_l1_loss(q, target, reduction="none")
    return (priority * loss).mean() / priority.mean()


def actor_loss(q: Tensor, before_tanh: Tensor, weight: float = 1e-5) -> Tensor:
    """`-E[(Q_1 + Q_2) / 2] + λ |u|²`: the second term keeps tanh(u) from saturating.

    :param q: (2, N), of the actor's actions
    :param before_tanh: (N, A), u
    :return: scalar
    """
    return -q.mean() + weight * before_tanh.square().mean()


def noisy(action: Tensor, std: float, clip: float, generator: Generator | None) -> Tensor:
    """Return clamp(a + clip(ε, -c, c)), ε ~ N(0, σ²): (N, A) -> (N, A)."""
    noise = std * torch.randn(action.shape, device=action.device, generator=generator)
    return (action + noise.clamp(-clip, clip)).clamp(-1, 1)
