"""ExPLORe (Li et al., 2023): label reward-free data by a reward model that is optimistic.

Source: https://arxiv.org/abs/2311.05067. It adds a bonus by random network distillation; here an
ensemble of reward heads stands in its place, as in appendix G of the ICLR 2026 version of the WPT
paper. The deviation of the heads is in units of reward.
"""

import torch
from torch import Generator, Tensor
from torch.optim import Optimizer

from wpt_agents.model.ensembles import RewardEnsemble
from wpt_agents.training.descent import descend

SHOWN = 0.8  # share of the online rows that each reward head learns from, so that they differ


def reward_ensemble_loss(prediction: Tensor, reward: Tensor, shown: Tensor) -> Tensor:
    """E[(r_k(z) - r)²] over the rows that are shown to member k.

    :param prediction: (K, N), the rewards that the members predict
    :param reward: (N,), the environment's
    :param shown: (K, N) bool, the rows that each member learns from
    :return: scalar
    """
    assert prediction.shape == shown.shape, (prediction.shape, shown.shape)
    return ((prediction - reward).square() * shown).sum() / shown.sum().clamp_min(1)


def optimistic_reward(prediction: Tensor, beta: float) -> tuple[Tensor, Tensor]:
    """ExPLORe's label by an ensemble: r = mean_k r_k(z) + β std_k r_k(z).

    :param prediction: (K, N), the rewards that the members predict
    :param beta: β
    :return: the label and the bonus in it, β std, (N,) each
    """
    bonus = beta * prediction.std(0, correction=0)
    return prediction.mean(0) + bonus, bonus


def label(
    ensemble: RewardEnsemble,
    optimizer: Optimizer,
    reward: Tensor,
    latent: Tensor,
    online: int,
    beta: float,
    generator: Generator | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Train the ensemble on the environment's rows, then label the offline rows with it.

    :param reward: (N,), whose rows from `online` on are not read
    :param latent: (N, Z), of the images that the steps led to; the ensemble does not train it
    :param online: the number of first rows that are of the environment
    :param beta: β, the weight of the bonus
    :return: (N,) rewards, and metrics
    """
    prediction = ensemble(latent[:online])
    draw = torch.rand(prediction.shape, device=reward.device, generator=generator)
    loss = reward_ensemble_loss(prediction, reward[:online], draw < SHOWN)
    descend(optimizer, loss, "reward")
    metrics = {"explore/reward_loss": loss.detach()}
    with torch.no_grad():
        optimistic, bonus = optimistic_reward(ensemble(latent[online:]), beta)
    if len(optimistic):
        metrics["explore/bonus"] = bonus.mean()
        metrics["explore/bonus_share"] = bonus.mean() / optimistic.abs().mean().clamp_min(1e-8)
    return torch.cat([reward[:online], optimistic]), metrics
