"""Filtering steps and imagination with `torch.compile`, for a GPU.

On a GPU, launching an operator takes as long as computing it, and compiled code launches fewer.
The functions of `wpt_agents.model` are compiled unchanged. Compiled code cannot use generators, so
random numbers are drawn in advance in the same order: the same seed gives the same results.
"""

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from wpt_agents.model.distributions import Drawn, Noise, exponential, uniform
from wpt_agents.model.policy import Dream, WPTPolicy, dream
from wpt_agents.model.rssm import RSSM, Latent, filter_step

Step = Callable[..., tuple[Latent, Tensor]]

# The networks that `compile_loops` was called for, without copies of them.
_steps: WeakKeyDictionary[RSSM, Step] = WeakKeyDictionary()
_dreams: WeakKeyDictionary[WPTPolicy, Callable[..., Dream]] = WeakKeyDictionary()


def compile_loops(policy: WPTPolicy, backend: str | Callable[..., Any] = "inductor") -> None:
    """Compile a policy's filtering steps and imagination at their first call.

    On a CPU, sequences are still filtered by scan.py, and only imagination is compiled.

    :param backend: the backend of `torch.compile`
    """
    # the functions must not reference their keys, or these would never be garbage-collected
    # fullgraph: a graph break would bring back the launches that compilation avoids
    _steps[policy.world_model.rssm] = torch.compile(
        _step, backend=backend, dynamic=False, fullgraph=True
    )
    _dreams[policy] = torch.compile(_dream, backend=backend, dynamic=False, fullgraph=True)


def _step(
    rssm: RSSM, state: Latent, inputs: tuple[Tensor, Tensor, Tensor], draw: Tensor
) -> tuple[Latent, Tensor]:
    return filter_step.definition(rssm, state, *inputs, Drawn([draw]))


def _dream(policy: WPTPolicy, start: Latent, horizon: int, draws: list[Tensor]) -> Dream:
    return dream.definition(policy, start, horizon, Drawn(draws))


def step_is_compiled(
    rssm: RSSM,
    state: Latent,
    action_embed: Tensor,
    embed_half: Tensor,
    is_first: Tensor,
    generator: Noise = None,
    sample: bool = True,
) -> bool:
    """Return whether the step samples, in an RSSM that `compile_loops` was called for."""
    return sample and rssm in _steps


@filter_step.faster(when=step_is_compiled)
def compiled_filter_step(
    rssm: RSSM,
    state: Latent,
    action_embed: Tensor,
    embed_half: Tensor,
    is_first: Tensor,
    generator: Noise = None,
    sample: bool = True,
) -> tuple[Latent, Tensor]:
    """`filter_step`, compiled."""
    draw = exponential(torch.empty_like(state.stoch, dtype=torch.float32), generator)
    inputs = dense(action_embed), dense(embed_half), dense(is_first)
    return _steps[rssm](rssm, state, inputs, draw)


def dense(x: Tensor) -> Tensor:
    """Return a step's inputs with strides that do not depend on the length of their sequence.

    For other strides the step would be compiled again, and after eight times not at all. Batches
    have one length, and are not copied; single episodes have many.
    """
    return x.clone(memory_format=torch.contiguous_format) if len(x) == 1 else x


def dream_is_compiled(
    policy: WPTPolicy, start: Latent, horizon: int, generator: Noise = None
) -> bool:
    """Return whether `compile_loops` was called for the policy."""
    return policy in _dreams


@dream.faster(when=dream_is_compiled)
def compiled_dream(
    policy: WPTPolicy, start: Latent, horizon: int, generator: Noise = None
) -> Dream:
    """`dream`, compiled."""
    action = start.stoch.new_empty(len(start.stoch), policy.max_action_dim, dtype=torch.float32)
    code = torch.empty_like(start.stoch, dtype=torch.float32)
    draws = []
    for _ in range(horizon):
        draws += [uniform(action, generator), exponential(code, generator)]
    return _dreams[policy](policy, start, horizon, draws)
