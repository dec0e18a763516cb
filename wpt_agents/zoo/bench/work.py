"""The work of an update, counted without measuring time, for sizes too large for this machine."""

from collections.abc import Callable, Iterator
from typing import Any

from torch.utils._python_dispatch import TorchDispatchMode

from wpt_agents.model.ops import definitions
from wpt_agents.zoo.bench.model import agent, count, synthetic_batch, whole_step, world_model_step
from wpt_agents.zoo.bench.timing import gflop

BATCH, LENGTH = 16, 64  # work is reported for this batch, scaled up from a smaller one
COUNTED = 1, 4
NO_LAUNCH = {  # operators that compute nothing
    *("view", "_unsafe_view", "t", "transpose", "permute", "as_strided", "expand", "slice"),
    *("select", "detach", "unsqueeze", "squeeze", "split", "split_with_sizes", "alias", "unbind"),
    *("unfold", "empty", "empty_like", "new_empty", "new_empty_strided", "empty_strided"),
}


def rows(quick: bool = False) -> Iterator[dict[str, Any]]:
    """Yield the TFLOP of a 16 x 64 batch by size; the operator calls do not depend on the size."""
    calls = _calls(4 if quick else LENGTH)
    for size in ("debug",) if quick else ("tiny", "small", "medium", "paper"):
        model = agent(size)
        data = synthetic_batch(*COUNTED)
        networks = model.policy
        scale = BATCH * LENGTH / (COUNTED[0] * COUNTED[1]) / 1e3
        params = (
            count(networks.world_model),
            count(networks.world_model, networks.actor, networks.critic),
        )
        steps = world_model_step(model, data), whole_step(model, data)
        for what, step, number in zip(("world model", "whole update"), steps, params, strict=True):
            columns = {
                "what": what,
                "size": size,
                "params": number,
                "batch": BATCH,
                "length": LENGTH,
            }
            yield {**columns, "tflop": scale * gflop(step), "operator_calls": calls[what]}


def _calls(length: int) -> dict[str, int]:
    """Return the operator calls without fast implementations, which is close to those on a GPU."""
    model = agent("debug")
    data = synthetic_batch(1, length)
    with definitions():
        return {
            "world model": launches(world_model_step(model, data)),
            "whole update": launches(whole_step(model, data)),
        }


def launches(step: Callable[[], Any]) -> int:
    """Return the number of computing operators in a call of `step`, forward and backward."""
    with _Calls() as counter:
        step()
    return counter.number


class _Calls(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.number = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.number += function.overloadpacket.__name__ not in NO_LAUNCH
        return function(*args, **(kwargs or {}))
