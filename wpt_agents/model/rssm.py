"""The recurrent state space model: h = f(h, z, a), q(z | h, o), p(z | h)."""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from wpt_agents.fast.scan import Constants, FilterScan
from wpt_agents.model.distributions import Noise, mode_one_hot, sample_one_hot, unimix_logits
from wpt_agents.model.networks import (
    BlockLinear,
    Linear,
    LinearNorm,
    Size,
    block_linear,
    linear,
    split_gates,
)

MIN_STD = 0.01  # entries of an embedding that vary less are not scaled up further
LOGITS_SCALE = 4.0  # found by held-out error and probes after 1,000 updates on cartpole


class Latent(NamedTuple):
    """s = [h, z]: `deter` (..., D) and `stoch` (..., S, K), one-hot in each group."""

    deter: Tensor
    stoch: Tensor

    @property
    def feat(self) -> Tensor:
        """(..., D + S*K)."""
        return torch.cat([self.deter, self.stoch.flatten(-2)], -1)

    def detach(self) -> "Latent":
        """The same state, cut off from the graph."""
        return Latent(self.deter.detach(), self.stoch.detach())

    def steps(self) -> list["Latent"]:
        """(N, H, ...) -> H times (N, ...)."""
        return [Latent(*step) for step in zip(*(x.unbind(1) for x in self), strict=True)]

    def but_last(self) -> "Latent":
        """(N, H + 1, ...) -> (N, H, ...)."""
        return Latent(self.deter[:, :-1], self.stoch[:, :-1])

    def pick(self, index: Tensor) -> "Latent":
        """(N, ...) -> (len(index), ...), the states of these numbers."""
        return Latent(self.deter[index], self.stoch[index])

    def flatten_time(self) -> "Latent":
        """(B, T, ...) -> (B*T, ...)."""
        return Latent(self.deter.flatten(0, 1), self.stoch.flatten(0, 1))


class BlockGRU(nn.Module):
    """f: a GRU whose recurrent weights are block-diagonal; every block sees all of z and a."""

    def __init__(self, size: Size, action_dim: int) -> None:
        super().__init__()
        deter, hidden, self.blocks = size.deter, size.hidden, size.blocks
        self.layout, eps = size.gates, size.norm_eps
        self.from_deter = LinearNorm(deter, hidden, eps)
        self.from_stoch = LinearNorm(size.stoch * size.classes, hidden, eps)
        self.from_action = LinearNorm(action_dim, hidden, eps)
        self.hidden = BlockLinear(deter + 3 * hidden * self.blocks, deter, self.blocks)
        self.norm = nn.LayerNorm(deter, eps=eps)
        self.gates = BlockLinear(deter, 3 * deter, self.blocks)

    def shared_weight(self) -> Tensor:
        """What every block makes of its view of h, z and a, as one matrix: (3 hidden, D)."""
        own = self.hidden.weight.shape[-1]
        return self.hidden.weight[:, own:].transpose(0, 1).flatten(1)

    def forward(
        self, deter: Tensor, stoch: Tensor, action_embed: Tensor, shared: Tensor | None = None
    ) -> Tensor:
        """One step: (N, D), (N, S, K), (N, hidden) -> (N, D).

        :param shared: `shared_weight`, worth making where it serves many states or steps
        """
        inputs = torch.cat(
            [self.from_deter(deter), self.from_stoch(stoch.flatten(1)), action_embed], -1
        )
        own = deter.unflatten(-1, (self.blocks, -1))
        if shared is None:
            views = torch.cat([own, inputs.unsqueeze(1).expand(-1, self.blocks, -1)], -1)
            hidden = self.hidden(views.flatten(1))
        else:  # the same sums without a copy of the inputs for each block
            weight = self.hidden.weight[:, : own.shape[-1]]
            hidden = linear(inputs, shared.t(), self.hidden.bias) + block_linear(deter, weight)
        hidden = F.silu(self.norm(hidden))
        reset, candidate, update = split_gates(self.gates(hidden), self.blocks, self.layout)
        update = torch.sigmoid(update - 1)  # starts out remembering
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        return (update * candidate + (1 - update) * own).flatten(1)


class RSSM(nn.Module):
    """Filters with images (`observe`) and dreams without (`imagine`).

    :param size: the widths
    :param action_dim: the padded action width
    :param embed_dim: width of the encoder's output
    :param unimix: share of the uniform in every latent distribution
    """

    def __init__(self, size: Size, action_dim: int, embed_dim: int, unimix: float = 0.01) -> None:
        super().__init__()
        self.size, self.action_dim, self.unimix = size, action_dim, unimix
        code = size.stoch * size.classes
        self.gru = BlockGRU(size, action_dim)
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
        for parameter in self.post_out[-1].parameters():
            if parameter.dim() == 2:
                parameter.mul_(LOGITS_SCALE)

    def initial(self, n: int) -> Latent:
        """The state before an episode's first image: zeros."""
        size, like = self.size, self.post_in.weight
        zeros = like.new_zeros
        return Latent(zeros(n, size.deter), zeros(n, size.stoch, size.classes))

    def step(self, state: Latent, action: Tensor, shared: Tensor | None = None) -> Tensor:
        """h_t = f(h_{t-1}, z_{t-1}, a_{t-1}): (N, D)."""
        return self.gru(state.deter, state.stoch, self.gru.from_action(action), shared)

    def prior(self, deter: Tensor) -> Tensor:
        """p(z | h): (..., D) -> (..., S, K) log-probabilities."""
        return self._log_probs(self.prior_net(deter))

    def posterior(self, deter: Tensor, embed: Tensor) -> Tensor:
        """q(z | h, o): (..., D), (..., E) -> (..., S, K) log-probabilities."""
        return self._posterior(deter, self._embed_half(embed))

    def _embed_half(self, embed: Tensor) -> Tensor:
        """The image's share of the posterior's first layer, which needs no h."""
        return linear(embed, self.post_in.weight[:, self.size.deter :], self.post_in.bias)

    def _posterior(self, deter: Tensor, embed_half: Tensor) -> Tensor:
        deter_half = linear(deter, self.post_in.weight[:, : self.size.deter])
        return self._log_probs(self.post_out(deter_half + embed_half))

    def _log_probs(self, logits: Tensor) -> Tensor:
        return unimix_logits(
            logits.unflatten(-1, (self.size.stoch, self.size.classes)), self.unimix
        )

    def observe(
        self,
        embed: Tensor,
        action: Tensor,
        is_first: Tensor,
        state: Latent | None = None,
        generator: Generator | None = None,
        sample: bool = True,
    ) -> tuple[Latent, Tensor, Tensor]:
        """Filters a sequence.

        :param embed: (B, T, E), the encoded images
        :param action: (B, T, A), what led to each image
        :param is_first: (B, T) bool, where state and previous action are reset to zero
        :param state: the state before the first image; zeros when not given
        :param sample: draw z; else take the likeliest
        :return: the posterior Latent (B, T, ...), and post_logits, prior_logits (B, T, S, K)
        """
        batch, length = is_first.shape
        assert embed.shape[:2] == action.shape[:2] == (batch, length), (embed.shape, action.shape)
        state = state or self.initial(batch)
        action_embed = self.gru.from_action(action * (~is_first[..., None]).to(embed.dtype))
        embed_half = self._embed_half(embed)
        # a device with a queue of its own would gain less
        if embed.device.type == "cpu" and sample and torch.is_grad_enabled():
            with torch.autocast("cpu", enabled=False):  # which knows no such function
                post, post_logits = self._scan(
                    embed_half.float(), action_embed.float(), is_first, state, generator
                )
        else:
            post, post_logits = self._filter(
                embed_half, action_embed, is_first, state, generator, sample
            )
        return post, post_logits, self.prior(post.deter)

    def _filter(
        self,
        embed_half: Tensor,
        action_embed: Tensor,
        is_first: Tensor,
        state: Latent,
        generator: Generator | None = None,
        sample: bool = True,
    ) -> tuple[Latent, Tensor]:
        """Step by step: the posterior Latent (B, T, ...) and its log-probabilities."""
        deter, stoch = state
        keep = (~is_first).to(embed_half.dtype)
        deters, stochs, logits = [], [], []
        for t, mask in enumerate(keep.unbind(1)):
            inputs = embed_half[:, t], action_embed[:, t], mask
            deter, stoch, post_logits = self.loop_body(deter, stoch, *inputs, generator, sample)
            deters.append(deter)
            stochs.append(stoch)
            logits.append(post_logits)
        return Latent(torch.stack(deters, 1), torch.stack(stochs, 1)), torch.stack(logits, 1)

    def loop_body(
        self,
        deter: Tensor,
        stoch: Tensor,
        embed_half: Tensor,
        action_embed: Tensor,
        keep: Tensor,
        generator: Noise = None,
        sample: bool = True,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step of `_filter`: the posterior state and its log-probabilities."""
        deter, stoch = deter * keep[:, None], stoch * keep[:, None, None]
        deter = self.gru(deter, stoch, action_embed)
        post_logits = self._posterior(deter, embed_half)
        stoch = sample_one_hot(post_logits, generator) if sample else mode_one_hot(post_logits)
        return deter, stoch, post_logits

    def _scan(
        self,
        embed_half: Tensor,
        action_embed: Tensor,
        is_first: Tensor,
        state: Latent,
        generator: Generator | None = None,
    ) -> tuple[Latent, Tensor]:
        """What `_filter` returns, in far fewer operators."""
        gru, hidden = self.gru, self.size.hidden
        state_part, action_part = gru.shared_weight().split([2 * hidden, hidden])
        own = gru.hidden.weight[:, : self.size.deter // gru.blocks]
        action_half = action_embed.transpose(0, 1) @ action_part + gru.hidden.bias
        deters, stochs, logits = FilterScan.apply(
            Constants(self.unimix, self.size.gates, self.size.norm_eps),
            generator,
            is_first.t(),
            action_half,
            embed_half.transpose(0, 1),
            *state,
            *(p for layers in (gru.from_deter, gru.from_stoch) for p in layers.parameters()),
            *(state_part.t(), own, *gru.norm.parameters(), *gru.gates.parameters()),
            *(self.post_in.weight[:, : self.size.deter], *self.post_out.parameters()),
        )
        post = Latent(deters.transpose(0, 1), stochs.transpose(0, 1))
        return post, logits.transpose(0, 1)

    def filter_step(
        self,
        state: Latent,
        action: Tensor,
        embed: Tensor,
        is_first: Tensor,
        generator: Generator | None = None,
        sample: bool = True,
    ) -> Latent:
        """One step of `observe` without the prior, which acting has no use for.

        :param state: (N, ...)
        :param action: (N, A), what led to the image
        :param embed: (N, E)
        :param is_first: (N,) bool
        """
        keep = (~is_first).to(embed.dtype)[:, None]
        state = Latent(state.deter * keep, state.stoch * keep[..., None])
        deter = self.step(state, action * keep)
        logits = self.posterior(deter, embed)
        draw = sample_one_hot(logits, generator) if sample else mode_one_hot(logits)
        return Latent(deter, draw)

    def imagine(
        self,
        state: Latent,
        policy: Callable[[Latent, int], Tensor],
        horizon: int,
        generator: Noise = None,
        sample: bool = True,
    ) -> tuple[Latent, Tensor]:
        """Rolls p(z | h) out under a policy.

        :param state: where to start, (N, ...)
        :param policy: (state, t) -> action (N, A)
        :return: the states at the steps 0 .. H, (N, H + 1, ...), the first being `state`, and the
            actions taken at the steps 0 .. H - 1, (N, H, A)
        """
        states, actions = [state], []
        shared = self.gru.shared_weight()
        for t in range(horizon):
            action = policy(state, t)
            deter = self.step(state, action, shared)
            log_probs = self.prior(deter)
            stoch = sample_one_hot(log_probs, generator) if sample else mode_one_hot(log_probs)
            state = Latent(deter, stoch)
            states.append(state)
            actions.append(action)
        deters, stochs = zip(*states, strict=True)
        return Latent(torch.stack(deters, 1), torch.stack(stochs, 1)), torch.stack(actions, 1)
