"""A second device, as strict as a GPU about where tensors lie, and computed by the CPU.

A tensor of the device "other" holds one of the CPU's. An operator over both kinds fails, as it
would on a GPU, and so does `numpy()` without `cpu()` before it. What is computed must be what the
CPU computes.
"""

from collections import Counter
from functools import partial

import pytest
import torch
from torch import library
from torch.utils import backend_registration
from torch.utils._pytree import tree_leaves, tree_map

if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
    why = f"torch {torch.__version__} takes no device that is made in Python"
    pytest.skip(why, allow_module_level=True)

aten = torch.ops.aten
waits = Counter()  # calls that a GPU would have to be waited for, by operator


class Elsewhere(torch.Tensor):
    """A tensor on the device "other"."""

    @staticmethod
    def __new__(cls, tensor):
        wrapper = torch.Tensor._make_wrapper_subclass(
            cls,
            tensor.size(),
            strides=tensor.stride(),
            storage_offset=tensor.storage_offset(),
            dtype=tensor.dtype,
            device="other:0",
            requires_grad=tensor.requires_grad,
        )
        wrapper.tensor = tensor
        return wrapper

    def __repr__(self):
        return f"Elsewhere({self.tensor})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return compute(func, args, kwargs or {})


def compute(func, args, kwargs):
    """What the CPU makes of it, on the device where a GPU would have it."""
    leaves = tree_leaves((args, kwargs))
    here = {id(x.tensor): x for x in leaves if isinstance(x, Elsewhere)}
    strays = [x for x in leaves if type(x) is torch.Tensor and x.dim()]
    named = [x for x in leaves if isinstance(x, torch.device)]  # where the result is to lie
    copies = func is aten.copy_.default
    if strays and not named and not copies:
        raise RuntimeError(f"{func} over two devices; on the CPU: {tuple(strays[0].shape)}")
    out = func(*tree_map(on_cpu, args), **tree_map(on_cpu, kwargs))
    away = isinstance(args[0], Elsewhere) if copies else not named or named[0].type == "other"
    waits[str(func)] += not away or isinstance(out, bool | int | float)
    with torch.inference_mode(False):  # in which such wrappers cannot be viewed
        return tree_map(lambda x: here.get(id(x), on_other(x)), out) if away else out


def on_cpu(x):
    if isinstance(x, torch.device):
        return torch.device("cpu")
    return x.tensor if isinstance(x, Elsewhere) else x


def on_other(x):
    return Elsewhere(x) if isinstance(x, torch.Tensor) else x


class Backend(backend_registration._DummyBackendModule):
    """What torch asks of a device, and of `torch.autocast` there."""

    def get_amp_supported_dtype(self):
        return [torch.bfloat16]


def made(maker, *args, device, **kwargs):
    return Elsewhere(maker(*args, device="cpu", **kwargs))


def copied(source, target, non_blocking=False):
    on_cpu(target).copy_(on_cpu(source))
    return target


# When it is imported, as autograd's first way back, of whatever test, counts the devices there are.
backend_registration._setup_privateuseone_for_python_backend("other", Backend())
for maker in aten.empty.memory_format, aten.empty_strided.default:
    library.impl(maker.name(), "other", partial(made, maker))
library.impl(aten._copy_from.default.name(), "other", copied)  # for `torch.tensor`
