"""The weights that the paper's authors publish, as models of `WPT`, and the way back."""

import os
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from stable_baselines3.common.type_aliases import GymEnv
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from wpt_agents.data.convert import Data
from wpt_agents.files.official import (
    GATES,
    NORM_EPS,
    WORLD_MODEL,
    official_name,
    parameter_names,
    read_official,
    write_official,
)
from wpt_agents.model.policy import WPTPolicy
from wpt_agents.model.sizes import find_size

Path = str | os.PathLike[str]
FROM_FILE = ("size", "max_action_dim")


class Undrawn(TorchFunctionMode):
    """Skip the initialisation of new weights, so that untouched weights occupy no memory."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func`, or only return its tensor if it would draw weights."""
        kwargs = kwargs or {}
        if func in (nn.init.uniform_, nn.init.kaiming_uniform_, Tensor.uniform_):
            return kwargs["tensor"] if "tensor" in kwargs else args[0]
        return func(*args, **kwargs)


def import_model(
    agent: Callable[..., Any],
    path: Path,
    stoch: int | None,
    lean: bool,
    dataset: Data | None,
    env: GymEnv | str | None,
    **keywords: Any,
) -> Any:
    """Make an agent with the weights of the authors' file; see `WPT.from_official`.

    :param agent: `WPT` or a subclass
    :param path: the authors' file
    :param stoch: the number of groups of z, or None for the authors' 32
    :param lean: do not initialise the weights that are loaded next, to save memory and time; not
        for an agent that has other networks than those of its policy
    """
    for name in FROM_FILE:
        if name in keywords:
            raise ValueError(f"{name} is read from {path}: leave it out")
    size, width, tensors = read_official(path, stoch)
    with Undrawn() if lean else nullcontext():
        model = agent(size=find_size(size), max_action_dim=width, **keywords)
    check_shapes(model.policy, tensors, path)
    dynamics = {ours for part in WORLD_MODEL for _, ours in parameter_names(part)}
    heads = {name: tensors.pop(name) for name in tensors.keys() - dynamics}
    # assigned below and not copied: the paper's model has 1.1 GB
    tensors = {name: tensor.to(model.device) for name, tensor in tensors.items()}
    model.policy.load_state_dict(tensors, strict=False, assign=True)  # no second copy
    model.reset_task()  # draws the heads, and makes optimisers of the new tensors
    model.policy.load_state_dict(heads, strict=False)
    model.initialised = True  # the posterior is trained: not to be adapted to any data
    model.set_dataset(dataset)
    if env is not None:
        model.set_env(env)
    return model


def check_shapes(policy: WPTPolicy, tensors: dict[str, Tensor], path: Path) -> None:
    """Raise a ValueError for a tensor of another shape than the policy's."""
    for name, weight in policy.state_dict().items():
        if name in tensors and tensors[name].shape != weight.shape:
            raise ValueError(
                f"The tensors of {path} do not fit together: {official_name(name)} has the shape "
                f"{tuple(tensors[name].shape)}, but the others ask for {tuple(weight.shape)}"
            )


def export_model(policy: WPTPolicy, path: Path) -> None:
    """Write a policy's weights in the authors' format; see `WPT.save_official`."""
    size = policy.size
    if (size.gates, size.norm_eps) != (GATES, NORM_EPS):
        raise ValueError(
            f"The authors' code computes another function of these weights: it needs a model whose "
            f"size has gates={GATES!r} and norm_eps={NORM_EPS}, this one has "
            f"gates={size.gates!r} and norm_eps={size.norm_eps}"
        )
    weights = policy.state_dict()
    write_official(path, {name.replace("_orig_mod.", ""): w for name, w in weights.items()})
