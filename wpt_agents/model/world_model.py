"""The world model and its losses: Eq. (1) world_model_loss, and reward_loss of A.3."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wpt_agents.data.trajectory import Batch, MarkedBatch
from wpt_agents.files.names import unknown_name
from wpt_agents.model.distributions import (
    BIN_RANGE,
    BINS,
    Noise,
    kl_one_hot,
    two_hot_loss,
    two_hot_mean,
)
from wpt_agents.model.images import Decoder, Encoder, to_uint8, to_unit
from wpt_agents.model.layers import Head
from wpt_agents.model.ops import op
from wpt_agents.model.rssm import RSSM, Latent
from wpt_agents.model.sizes import Size


class WorldModelLoss(NamedTuple):
    """Eq. (1) and its terms: scalars, averaged over the batch and time."""

    total: Tensor
    reconstruction: Tensor
    kl: Tensor


def squared_error(image: Tensor, reconstruction: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return -ln p(o_t | z_t, h_t) of a Gaussian with fixed variance, up to constants.

    :param image: (..., H, W, C), the true frames in [-0.5, 0.5], their pixels in any order
    :param reconstruction: (..., H, W, C)
    :param weight: (..., H, W, C) or a shape that is broadcast to it, the weights of the pixels; 1
        in the paper. A weight of w means a variance that is w times smaller
    :return: (...), summed over a frame
    """
    assert image.shape == reconstruction.shape, (image.shape, reconstruction.shape)
    # Without the 1/2 of a unit variance, as in the authors' code: it would change what beta means.
    error = F.mse_loss(reconstruction, image, reduction="none")
    return (error if weight is None else weight * error).sum((-3, -2, -1))


def pixel_weights(moving: Tensor, pixel_weight: float) -> Tensor:
    """Return `pixel_weight` where pixels move and 1 elsewhere: (...) bool -> (...)."""
    return 1 + (pixel_weight - 1) * moving.float()


@op
def reconstruction_error(
    decoder: Decoder,
    latent: Latent,
    image: Tensor,
    moving: Tensor | None = None,
    pixel_weight: float = 1.0,
) -> Tensor:
    """Return the `squared_error` of N decoded states.

    :param latent: (N, ...)
    :param image: (N, 64, 64, 3) uint8
    :param moving: (N, 64, 64) bool, the pixels that weigh `pixel_weight`
    :return: (N,)
    """
    weight = None if moving is None else pixel_weights(moving[..., None], pixel_weight)
    return squared_error(to_unit(image), decoder(latent.deter, latent.stoch), weight)


def world_model_loss(
    error: Tensor,
    post_logits: Tensor,
    prior_logits: Tensor,
    dyn_scale: float = 1.0,
    rep_scale: float = 0.1,
    free_nats: float | Tensor = 1.0,
    free_nats_mode: str = "mean",
) -> WorldModelLoss:
    """Eq. (1): -ln p(o_t | z_t, h_t) + beta KL(q(z_t | h_t, o_t) || p(z_t | h_t)).

    The KL is balanced as in DreamerV3: `dyn_scale` weighs the term that trains the prior,
    `rep_scale` the term that trains the posterior. A term below `free_nats` has no gradient.

    :param error: (B, T), the first term, see `squared_error`
    :param post_logits: (B, T, S, K) log-probabilities of q
    :param prior_logits: (B, T, S, K) log-probabilities of p
    :param free_nats_mode: clip the mean over the batch ("mean", as WPT) or each element ("element",
        as DreamerV3)
    """
    assert post_logits.shape == prior_logits.shape, (post_logits.shape, prior_logits.shape)
    assert error.shape == post_logits.shape[:2], (error.shape, post_logits.shape)
    if free_nats_mode not in ("mean", "element"):
        raise unknown_name("free_nats_mode", free_nats_mode, ("mean", "element"))
    error = error.mean()
    dyn = kl_one_hot(post_logits.detach(), prior_logits)
    rep = kl_one_hot(post_logits, prior_logits.detach())
    if free_nats_mode == "mean":
        dyn = dyn.mean()
        rep = rep.mean()
    kl = dyn.mean().detach()  # for the log, before free nats clip it
    dyn = dyn.clamp_min(free_nats).mean()
    rep = rep.clamp_min(free_nats).mean()
    return WorldModelLoss(error + dyn_scale * dyn + rep_scale * rep, error, kl)


def reward_loss(
    logits: Tensor, reward: Tensor, known: Tensor, bin_range: float = BIN_RANGE
) -> Tensor:
    """Return -ln p_xi(r_t | s_t), averaged over steps of known reward (A.3, Algorithm 1).

    :param logits: (B, T, bins), the reward head's output
    :param reward: (B, T)
    :param known: (B, T) bool, where the reward is known
    :param bin_range: largest bin, in symlog space
    :return: scalar
    """
    assert logits.shape[:-1] == reward.shape == known.shape, (logits.shape, known.shape)
    # a batch of retrieved rows alone has no known reward: its loss is 0, not NaN
    return (two_hot_loss(logits, reward, bin_range) * known).sum() / known.sum().clamp_min(1)


def pessimistic_reward(rewards: Tensor, pessimism: float) -> Tensor:
    """Return μ - β σ of an ensemble's predictions: less where its members disagree.

    :param rewards: (..., members)
    :param pessimism: β; 0 for the mean
    :return: (...)
    """
    mean = rewards.mean(-1)
    if not pessimism:
        return mean
    variance = rewards.var(-1, correction=0)
    return mean - pessimism * (variance + 1e-12).sqrt()  # whose slope at 0 would be infinite


class WorldModel(nn.Module):
    """Encoder, RSSM, decoder, and the heads of a task, which only fine-tuning trains.

    `continue_head` is None unless episodes of the task can end; `reward_members` are further heads
    like the reward head, of which there are none in the paper.

    :param size: the widths
    :param action_dim: A, the padded action width
    :param unimix: share of the uniform distribution in every latent distribution
    :param zero_init_heads: start the reward head at zero, as DreamerV3 does
    :param bin_range: largest bin of the reward head, in symlog space
    """

    def __init__(
        self,
        size: Size,
        action_dim: int,
        unimix: float = 0.01,
        zero_init_heads: bool = False,
        bin_range: float = BIN_RANGE,
    ) -> None:
        super().__init__()
        self.encoder = Encoder(size.depth)
        self.rssm = RSSM(size, action_dim, self.encoder.embed_dim, unimix)
        self.decoder = Decoder(size)
        self.size = size
        self.zero_init_heads = zero_init_heads
        self.bin_range = bin_range
        self.reset_heads()

    def reset_heads(self) -> None:
        """Initialise the reward head again and remove the other heads, for another task."""
        # Two layers, as in the authors' code; Table 2 says three for all heads.
        self.reward_head = Head(self.size, 2, BINS, self.zero_init_heads)
        self.reward_members = nn.ModuleList()
        self.continue_head: Head | None = None

    @property
    def heads(self) -> list[nn.Module]:
        """All heads, which are those of a task."""
        heads: list[nn.Module] = [self.reward_head, *self.reward_members]
        return heads if self.continue_head is None else [*heads, self.continue_head]

    def make_reward_members(self, seeds: Sequence[int]) -> None:
        """Replace the further reward heads by new ones, each initialised with its own seed."""
        heads = [self._seeded_head(BINS, self.zero_init_heads, seed) for seed in seeds]
        self.reward_members = nn.ModuleList(heads)

    def make_continue_head(self, log_odds: float, seed: int) -> None:
        """Add DreamerV3's continue head, which predicts whether the episode goes on after a state.

        :param log_odds: log-odds of continuing that the new head predicts
        :param seed: seed of its initial weights
        """
        self.continue_head = self._seeded_head(1, zero_init=True, seed=seed)
        nn.init.constant_(self.continue_head.layers[-1].get_parameter("bias"), log_odds)

    def _seeded_head(self, outputs: int, zero_init: bool, seed: int) -> Head:
        """Make a head from random numbers of its own, so that no other network changes."""
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            head = Head(self.size, 2, outputs, zero_init)
        return head.to(self.rssm.post_in.weight.device)

    def dynamics_parameters(self) -> list[nn.Parameter]:
        """Return θ of Eq. (1): the parameters of everything but the heads."""
        return [p for part in (self.encoder, self.rssm, self.decoder) for p in part.parameters()]

    @torch.no_grad()
    def standardise(self, image: Tensor) -> None:
        """Adapt the initial posterior to images of the data: (N, 64, 64, 3) uint8."""
        self.rssm.standardise(self.encoder(image).float())

    def observe(self, batch: Batch, generator: Noise = None) -> tuple[Latent, Tensor, Tensor]:
        """Filter a batch: posterior Latent (B, T, ...), post_logits, prior_logits (B, T, S, K)."""
        embed = self.encoder(batch.image)
        return self.rssm.observe(embed, batch.action, batch.is_first, generator=generator)

    def decode(self, latent: Latent) -> Tensor:
        """Decode states to images, about -0.5 .. 0.5: (B, T, ...) -> (B, T, 64, 64, 3)."""
        flat = latent.flatten_time()
        images: Tensor = self.decoder(flat.deter, flat.stoch)
        return images.view(*latent.deter.shape[:2], *images.shape[1:])

    def reconstruction_error(
        self, latent: Latent, image: Tensor, moving: Tensor | None = None, pixel_weight: float = 1.0
    ) -> Tensor:
        """Return `squared_error(to_unit(image), self.decode(latent))`, (B, T).

        :param latent: (B, T, ...)
        :param image: (B, T, 64, 64, 3) uint8
        :param moving: (B, T, 64, 64) bool, the pixels that weigh `pixel_weight`
        """
        marks = None if moving is None else moving.flatten(0, 1)
        error = reconstruction_error(
            self.decoder, latent.flatten_time(), image.flatten(0, 1), marks, pixel_weight
        )
        return error.view(image.shape[:2])

    def batch_error(self, latent: Latent, batch: Batch, pixel_weight: float = 1.0) -> Tensor:
        """Return `reconstruction_error` (B, T), weighted where a MarkedBatch says so."""
        moving = batch.moving if isinstance(batch, MarkedBatch) else None
        return self.reconstruction_error(latent, batch.image, moving, pixel_weight)

    def reward(self, feat: Tensor) -> Tensor:
        """Predict the reward for arriving in a state: (..., D + S*K) -> (...)."""
        if self.reward_members:
            return self.rewards(feat).mean(-1)
        return two_hot_mean(self.reward_head(feat), self.bin_range)

    def rewards(self, feat: Tensor) -> Tensor:
        """Predict the reward by each of the heads: (..., D + S*K) -> (..., members)."""
        heads = [self.reward_head, *self.reward_members]
        return torch.stack([two_hot_mean(head(feat), self.bin_range) for head in heads], -1)

    def goes_on(self, feat: Tensor) -> Tensor:
        """Predict the probability that the episode continues: (..., D + S*K) -> (...).

        The model must have the continue head.
        """
        assert self.continue_head is not None
        logits: Tensor = self.continue_head(feat)
        return logits.float().squeeze(-1).sigmoid()

    @torch.no_grad()
    def open_loop(self, batch: Batch, context: int, generator: Noise = None) -> Tensor:
        """Filter `context` images, then predict the rest from the actions alone.

        :return: (B, T, 64, 64, 3) uint8; the first `context` are reconstructions
        """
        embed = self.encoder(batch.image[:, :context])
        action = batch.action
        is_first = batch.is_first
        post, _, _ = self.rssm.observe(
            embed, action[:, :context], is_first[:, :context], generator=generator
        )
        if context >= action.shape[1]:
            return to_uint8(self.decode(post))
        last = Latent(post.deter[:, -1], post.stoch[:, -1])
        horizon = action.shape[1] - context
        dream, _ = self.rssm.imagine(last, lambda _, t: action[:, context + t], horizon, generator)
        # the dream's first state is the last filtered one
        deter = torch.cat([post.deter, dream.deter[:, 1:]], 1)
        stoch = torch.cat([post.stoch, dream.stoch[:, 1:]], 1)
        return to_uint8(self.decode(Latent(deter, stoch)))


def world_model_update_loss(
    model: WorldModel,
    batch: Batch,
    generator: Noise = None,
    pixel_weight: float = 1.0,
    **options: Any,
) -> tuple[WorldModelLoss, Latent]:
    """Return Eq. (1) on a batch, and the batch's posterior states.

    :param pixel_weight: weight of the pixels that a MarkedBatch marks
    :param options: the keywords of `world_model_loss`
    """
    post, post_logits, prior_logits = model.observe(batch, generator)
    error = model.batch_error(post, batch, pixel_weight)
    return world_model_loss(error, post_logits, prior_logits, **options), post
