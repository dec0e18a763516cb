"""The recurrent state space model: h = f(h, z, a), q(z | h, o), p(z | h)."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from wpt_agents.model.distributions import Noise, mode_one_hot, sample_one_hot, unimix_logits
from wpt_agents.model.gru import BlockGRU
from wpt_agents.model.layers import Linear, LinearNorm
from wpt_agents.model.ops import linear, op
from wpt_agents.model.sizes import Size

MIN_STD = 0.01  # entries of an embedding that vary less are not scaled up further
LOGITS_SCALE = 4.0  # chosen by validation error and probes after 1,000 updates on cartpole


class Latent(NamedTuple):
    """Latent state s = [h, z]: `deter` (..., D) and `stoch` (..., S, K), one-hot in each group."""

    deter: Tensor
    stoch: Tensor

    @property
    def feat(self) -> Tensor:
        """Both parts as one vector: (..., D + S*K)."""
        return torch.cat([self.deter, self.stoch.flatten(-2)], -1)

    def detach(self) -> "Latent":
        """Return the same state without its graph."""
        return Latent(self.deter.detach(), self.stoch.detach())

    def steps(self) -> list["Latent"]:
        """Split (N, H, ...) into H states (N, ...)."""
        return [Latent(*step) for step in zip(*(x.unbind(1) for x in self), strict=True)]

    def but_last(self) -> "Latent":
        """Return all states but the last one: (N, H + 1, ...) -> (N, H, ...)."""
        return Latent(self.deter[:, :-1], self.stoch[:, :-1])

    def pick(self, index: Tensor) -> "Latent":
        """Return the states with these indices: (N, ...) -> (len(index), ...)."""
        return Latent(self.deter[index], self.stoch[index])

    def flatten_time(self) -> "Latent":
        """Merge batch and time: (B, T, ...) -> (B*T, ...)."""
        return Latent(self.deter.flatten(0, 1), self.stoch.flatten(0, 1))


def stack_time(states: list[Latent]) -> Latent:
    """Join T states (N, ...) into (N, T, ...)."""
    deters, stochs = zip(*states, strict=True)
    return Latent(torch.stack(deters, 1), torch.stack(stochs, 1))


class RSSM(nn.Module):
    """The RSSM, which filters with images (`observe`) and imagines without them (`imagine`).

    :param size: the widths
    :param action_dim: the padded action width
    :param embed_dim: width of the encoder's output
    :param unimix: share of the uniform distribution in every latent distribution
    """

    def __init__(self, size: Size, action_dim: int, embed_dim: int, unimix: float = 0.01) -> None:
        super().__init__()
        self.size = size
        self.action_dim = action_dim
        self.unimix = unimix
        code = size.stoch * size.classes
        self.gru = BlockGRU(size, action_dim)
        # Two hidden layers here and one in the posterior: the paper's 280 M parameters ask for it.
        self.prior_net = nn.Sequential(
            LinearNorm(size.deter, size.hidden, size.norm_eps),
            LinearNorm(size.hidden, size.hidden, size.norm_eps),
            Linear(size.hidden, code),
        )
        self.post_in = Linear(size.deter + embed_dim, size.hidden)
        self.post_out = nn.Sequential(
            nn.LayerNorm(size.hidden, eps=size.norm_eps), nn.SiLU(), Linear(size.hidden, code)
        )

    @torch.no_grad()
    def standardise(self, embed: Tensor) -> None:
        """Adapt the posterior's first and last layer to the data, before any update.

        Most of an encoder's initial output is the same for every image. Images therefore hardly
        change the initial posterior, its samples are noise, and the decoder learns the mean image
        for thousands of updates. The first layer is changed to see (e - mean) / std instead of e,
        and the last layer's weights are multiplied by 4, so that the samples depend on the image.

        :param embed: (N, E), encoded images of the data
        """
        std, mean = torch.std_mean(embed, 0)
        scaled = self.post_in.weight[:, self.size.deter :] / std.clamp_min(MIN_STD)
        self.post_in.weight[:, self.size.deter :] = scaled
        self.post_in.bias.sub_(scaled @ mean)
        last = self.post_out[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(LOGITS_SCALE)

    def initial(self, n: int) -> Latent:
        """Return the state before the first image of n episodes: zeros."""
        size = self.size
        zeros = self.post_in.weight.new_zeros
        return Latent(zeros(n, size.deter), zeros(n, size.stoch, size.classes))

    def step(self, state: Latent, action: Tensor) -> Tensor:
        """Return h_t = f(h_{t-1}, z_{t-1}, a_{t-1}): (N, ...), (N, A) -> (N, D)."""
        deter: Tensor = self.gru(state.deter, state.stoch, self.gru.from_action(action))
        return deter

    def prior(self, deter: Tensor) -> Tensor:
        """Return p(z | h) as log-probabilities: (..., D) -> (..., S, K)."""
        return self._log_probs(self.prior_net(deter))

    def posterior(self, deter: Tensor, embed: Tensor) -> Tensor:
        """Return q(z | h, o) as log-probabilities: (..., D), (..., E) -> (..., S, K)."""
        return self.posterior_of_halves(deter, self.embed_half(embed))

    def embed_half(self, embed: Tensor) -> Tensor:
        """Return the image's share of the posterior's first layer, which does not depend on h.

        For a whole sequence it is one product: (..., E) -> (..., hidden).
        """
        return linear(embed, self.post_in.weight[:, self.size.deter :], self.post_in.bias)

    def posterior_of_halves(self, deter: Tensor, embed_half: Tensor) -> Tensor:
        """Return q(z | h, o) from `embed_half`: (..., D), (..., hidden) -> (..., S, K)."""
        deter_half = linear(deter, self.post_in.weight[:, : self.size.deter])
        return self._log_probs(self.post_out(deter_half + embed_half))

    def _log_probs(self, logits: Tensor) -> Tensor:
        groups = logits.unflatten(-1, (self.size.stoch, self.size.classes))
        return unimix_logits(groups, self.unimix)

    def observe(
        self,
        embed: Tensor,
        action: Tensor,
        is_first: Tensor,
        state: Latent | None = None,
        generator: Noise = None,
        sample: bool = True,
    ) -> tuple[Latent, Tensor, Tensor]:
        """Filter a sequence.

        :param embed: (B, T, E), the encoded images
        :param action: (B, T, A), the action that led to each image
        :param is_first: (B, T) bool, where state and previous action are reset to zero
        :param state: the state before the first image, (B, ...); zeros if None
        :param generator: source of the random numbers; torch's own if None
        :param sample: draw z; if False, take the most likely class of each group
        :return: the posterior Latent (B, T, ...), and post_logits, prior_logits (B, T, S, K)
        """
        post, post_logits = self.filter(embed, action, is_first, state, generator, sample)
        # Filtering never needs the prior, so it is one product for all steps.
        return post, post_logits, self.prior(post.deter)

    def filter(
        self,
        embed: Tensor,
        action: Tensor,
        is_first: Tensor,
        state: Latent | None = None,
        generator: Noise = None,
        sample: bool = True,
    ) -> tuple[Latent, Tensor]:
        """Filter as `observe` does, with the same parameters, but without computing the prior.

        :return: the posterior Latent (B, T, ...), and post_logits (B, T, S, K)
        """
        batch, length = is_first.shape
        assert embed.shape[:2] == action.shape[:2] == (batch, length), (embed.shape, action.shape)
        keep = (~is_first[..., None]).to(embed.dtype)
        # The action that led to an episode's first image belongs to the episode before.
        action_embed = self.gru.from_action(action * keep)
        state = state or self.initial(batch)
        return filter_sequence(
            self, self.embed_half(embed), action_embed, is_first, state, generator, sample
        )

    def imagine(
        self,
        state: Latent,
        policy: Callable[[Latent, int], Tensor],
        horizon: int,
        generator: Noise = None,
        sample: bool = True,
    ) -> tuple[Latent, Tensor]:
        """Imagine a trajectory: sample p(z | h) step by step with the actions of a policy.

        :param state: where to start, (N, ...)
        :param policy: (state, t) -> action (N, A)
        :param horizon: H
        :param generator: source of the random numbers; torch's own if None
        :param sample: draw z; if False, take the most likely class of each group
        :return: the states at the steps 0 .. H, (N, H + 1, ...), the first being `state`, and the
            actions taken at the steps 0 .. H - 1, (N, H, A)
        """
        states = [state]
        actions = []
        for t in range(horizon):
            action = policy(state, t)
            deter = self.step(state, action)
            state = Latent(deter, draw_code(self.prior(deter), generator, sample))
            states.append(state)
            actions.append(action)
        return stack_time(states), torch.stack(actions, 1)


def draw_code(logits: Tensor, generator: Noise, sample: bool) -> Tensor:
    """Draw z from its distribution, or take the most likely class of each group.

    :param logits: (..., S, K) log-probabilities
    :return: (..., S, K), one-hot
    """
    return sample_one_hot(logits, generator) if sample else mode_one_hot(logits)


@op
def filter_step(
    rssm: RSSM,
    state: Latent,
    action_embed: Tensor,
    embed_half: Tensor,
    is_first: Tensor,
    generator: Noise = None,
    sample: bool = True,
) -> tuple[Latent, Tensor]:
    """Make one step of filtering: h_t = f(h_{t-1}, z_{t-1}, a_{t-1}), then z_t ~ q(z | h_t, o_t).

    :param state: the state of the step before, (N, ...)
    :param action_embed: (N, hidden), the embedded action that led to the image, or zeros where the
        state is reset
    :param embed_half: (N, hidden), the result of `RSSM.embed_half` for the encoded image
    :param is_first: (N,) bool, where the state is reset to zero
    :return: the posterior state and its log-probabilities (N, S, K)
    """
    keep = (~is_first).to(embed_half.dtype)[:, None]
    deter = rssm.gru(state.deter * keep, state.stoch * keep[..., None], action_embed)
    logits = rssm.posterior_of_halves(deter, embed_half)
    return Latent(deter, draw_code(logits, generator, sample)), logits


@op
def filter_sequence(
    rssm: RSSM,
    embed_half: Tensor,
    action_embed: Tensor,
    is_first: Tensor,
    state: Latent,
    generator: Noise = None,
    sample: bool = True,
) -> tuple[Latent, Tensor]:
    """Filter (B, T, ...) step by step: the posterior Latent and its log-probabilities.

    :param state: before the first image, (B, ...)
    """
    states = []
    logits = []
    for t in range(is_first.shape[1]):
        inputs = action_embed[:, t], embed_half[:, t], is_first[:, t]
        state, post_logits = filter_step(rssm, state, *inputs, generator, sample)
        states.append(state)
        logits.append(post_logits)
    return stack_time(states), torch.stack(logits, 1)


@op
def over_steps(head: Callable[[Tensor], Tensor], states: Latent) -> Tensor:
    """Apply a head to the features of states (N, H, ...), step by step: (N, H, ...)."""
    return head(states.feat)
