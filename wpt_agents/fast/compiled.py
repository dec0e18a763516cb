"""The two loops of an update for `torch.compile`, where launches take as long as arithmetic: a GPU.

What is compiled are the definitions, `RSSM.loop_body` and `WPTPolicy.imagine`. Compiled code knows
no generators, so random numbers are drawn before, in the same order: the same seed gives the same.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Generator, Tensor

from wpt_agents.model.distributions import Drawn, exponential, uniform
from wpt_agents.model.policy import Dream, WPTPolicy
from wpt_agents.model.rssm import RSSM, Latent

LoopBody = Callable[..., tuple[Tensor, Tensor, Tensor]]


def compile_loops(policy: WPTPolicy, backend: str = "inductor") -> None:
    """Has a policy run the scan's steps and its dreams compiled, from their first call on.

    On a CPU the scan by hand (scan.py) goes on, and only the dreams are compiled.

    :param backend: of `torch.compile`
    """
    rssm = policy.world_model.rssm
    rssm.loop_body = _loop_body(rssm, backend)  # type: ignore[method-assign]
    policy.imagine = _imagine(policy, backend)  # type: ignore[method-assign]


def _loop_body(rssm: RSSM, backend: str) -> LoopBody:
    define: LoopBody = rssm.loop_body
    size = rssm.size

    def sampling(*inputs: Tensor, draw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return define(*inputs, Drawn([draw]))

    compiled = torch.compile(sampling, backend=backend, dynamic=False, fullgraph=True)

    def loop_body(*inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        *tensors, generator, sample = inputs
        if not sample:
            return define(*inputs)
        like = tensors[0].new_empty(len(tensors[0]), size.stoch, size.classes, dtype=torch.float32)
        return compiled(*tensors, draw=exponential(like, generator))

    return loop_body


def _imagine(policy: WPTPolicy, backend: str) -> Callable[..., Dream]:
    define = policy.imagine

    def drawn(start: Latent, horizon: int, draws: list[Tensor]) -> Dream:
        return define(start, horizon, Drawn(draws))

    compiled = torch.compile(drawn, backend=backend, dynamic=False, fullgraph=True)

    def imagine(start: Latent, horizon: int, generator: Generator | None = None) -> Dream:
        action = start.stoch.new_empty(len(start.stoch), policy.max_action_dim, dtype=torch.float32)
        code, draws = torch.empty_like(start.stoch, dtype=torch.float32), list[Tensor]()
        for _ in range(horizon):
            draws += [uniform(action, generator), exponential(code, generator)]
        return compiled(start, horizon, draws)

    return imagine
