"""Define, in one plain line each, the tensor operations that have a faster twin.

The networks call these functions and know nothing of devices or memory layouts. The package `fast`
registers twins: functions that return the same values and gradients, and are faster wherever their
condition holds. Operations on whole networks, such as filtering a sequence, are marked with the
same decorator in the module that defines them::

    @op
    def square(x: Tensor) -> Tensor:
        return x * x

    @square.faster(when=on_cpu)
    def square_on_cpu(x: Tensor) -> Tensor:
        return x.square()

    with definitions():  # no twin is used in this block
        square(x)
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")

OPERATIONS: list["Op[..., Any]"] = []  # all of them, so that a test can check each twin
_twins_are_used = True


class Op(Generic[P, R]):
    """A function with a definition and faster twins; calling it picks the first twin that applies.

    :param definition: the readable function, which every twin must agree with
    """

    def __init__(self, definition: Callable[P, R]) -> None:
        self.definition = definition
        self.twins: list[tuple[Callable[P, bool], Callable[P, R]]] = []
        update_wrapper(self, definition)
        OPERATIONS.append(self)

    def faster(self, when: Callable[P, bool]) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """Return a decorator that registers a twin.

        :param when: takes the arguments of a call and returns whether the twin can be used
        """

        def register(twin: Callable[P, R]) -> Callable[P, R]:
            self.twins.append((when, twin))
            return twin

        return register

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the first twin whose condition holds, or else the definition."""
        if _twins_are_used:
            for when, twin in self.twins:
                if when(*args, **kwargs):
                    return twin(*args, **kwargs)
        return self.definition(*args, **kwargs)


op = Op  # the name of the decorator


@contextmanager
def definitions() -> Iterator[None]:
    """Use no twin inside the block, in any thread: for debugging, tests and benchmarks."""
    global _twins_are_used
    before = _twins_are_used
    _twins_are_used = False
    try:
        yield
    finally:
        _twins_are_used = before


@op
def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return x W^T + b: (..., inputs), (outputs, inputs) -> (..., outputs)."""
    return F.linear(x, weight, bias)


@op
def block_linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return the product with a block-diagonal weight.

    :param x: (N, inputs)
    :param weight: (b, inputs / b, outputs / b), the b blocks
    :return: (N, outputs)
    """
    out = torch.einsum("nbi,bio->nbo", x.unflatten(-1, (len(weight), -1)), weight).flatten(1)
    return out if bias is None else out + bias


@op
def shared_block_linear(private: Tensor, shared: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return a `block_linear` whose blocks each see their private and all shared inputs.

    :param private: (N, inputs), divided among the b blocks
    :param shared: (N, more inputs), which follow the private ones in the view of each block
    :param weight: (b, inputs / b + more inputs, outputs / b)
    :return: (N, outputs)
    """
    private = private.unflatten(-1, (len(weight), -1))
    views = torch.cat([private, shared.unsqueeze(1).expand(-1, len(weight), -1)], -1)
    return block_linear(views.flatten(1), weight, bias)


@op
def down_conv(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolve with stride 2: (N, inputs, H, W) -> (N, outputs, (H - K) // 2 + 1, ...)."""
    return F.conv2d(x, weight, bias, stride=2)


@op
def up_conv(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolve, transposed, with stride 2: (N, inputs, H, W) -> (N, outputs, 2H + K - 2, ...)."""
    return F.conv_transpose2d(x, weight, bias, stride=2)


@op
def over_rows(layers: Callable[..., Tensor], row_size: int, *inputs: Tensor) -> Tensor:
    """Apply layers that compute each row of a batch independently of the others.

    :param layers: a function of `inputs`
    :param row_size: numbers per row in the largest tensor that the layers compute
    :param inputs: tensors with N rows
    :return: the output of `layers`, with N rows
    """
    return layers(*inputs)
