"""The content of model files: keywords, counters, weights and optimisers, without pickle."""

import os
from collections.abc import Mapping
from io import BufferedIOBase
from pathlib import Path
from typing import Any

from stable_baselines3.common.policies import BasePolicy
from torch import Tensor
from torch.optim import Optimizer

from wpt_agents.files.model_file import load_optimizer, optimizer_tensors, write_model

WORLD_MODEL = "world_model"  # the group of tensors of a file that holds no other network
ModelPath = str | os.PathLike[str] | BufferedIOBase


def optimizers(learner: object) -> dict[str, Optimizer]:
    """Return the optimisers among a learner's attributes by their names."""
    return {name: value for name, value in vars(learner).items() if isinstance(value, Optimizer)}


def write(path: ModelPath, header: Mapping[str, Any], policy: BasePolicy, learner: object) -> None:
    """Write a model file, completely or not at all; the suffix .zip is added if there is none."""
    if isinstance(path, str | os.PathLike) and not Path(path).suffix:
        path = Path(path).with_suffix(".zip")
    weights = policy.state_dict()  # of which compiled parts have other names
    tensors = {"policy": {name.replace("_orig_mod.", ""): w for name, w in weights.items()}}
    tensors |= {name: optimizer_tensors(value) for name, value in optimizers(learner).items()}
    write_model(path, header, tensors)


def restore(
    tensors: Mapping[str, Mapping[str, Tensor]], policy: BasePolicy, learner: object
) -> None:
    """Load the weights and the optimiser states of a model file; learning rates stay.

    If the file contains a world model alone, the policy's other networks do not change.
    """
    if WORLD_MODEL in tensors:
        policy.load_state_dict({**policy.state_dict(), **tensors[WORLD_MODEL]})
        return
    policy.load_state_dict(tensors["policy"])
    for name, value in optimizers(learner).items():
        load_optimizer(value, tensors[name])


def write_world_model(path: ModelPath, header: Mapping[str, Any], policy: BasePolicy) -> None:
    """Write encoder, RSSM and decoder alone, in bfloat16: a small file to share."""
    kept = tuple(f"world_model.{part}." for part in ("encoder", "rssm", "decoder"))
    # half the size; float32 is restored when they are loaded
    weights = {k: w.bfloat16() for k, w in policy.state_dict().items() if k.startswith(kept)}
    write_model(path, header, {WORLD_MODEL: weights})


def shipped() -> dict[str, Path]:
    """Return the pre-trained world models that come with the library, by name."""
    package = Path(__file__).parents[1]
    folders = (package / "zoo" / "presets" / "models", package.parent / "zoo" / "models")
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.zip"))}


def check_class(header: Mapping[str, Any], path: ModelPath, expected: str) -> None:
    """Check that a model file was written by the expected agent.

    :param header: the header of the file
    :param path: the file, for the message
    :param expected: the name of the agent that reads the file
    :raises ValueError: another agent wrote it; the message names that agent
    """
    kind = header.get("class", expected)
    if kind != expected:
        raise ValueError(f"{path} is of {kind}: read it with {kind}.load, not {expected}.load")


def check_same(before: Mapping[str, Any], now: Mapping[str, Any], names: tuple[str, ...]) -> None:
    """Check that weights were trained with the same values of some keywords.

    :param before: the keywords of the model file
    :param now: the keywords of the agent that loads the file
    :param names: the keywords to compare
    :raises ValueError: a value differs; the message names both
    """
    for name in names:
        if before[name] != now[name]:
            raise ValueError(
                f"The model was trained with {name}={before[name]!r}, now it is {now[name]!r}. "
                "Pass the old value, or use another model file or run_dir"
            )


def find(path: ModelPath) -> ModelPath:
    """Return the path of an existing file, with the suffix that `write` adds where there is none.

    :param path: a file, or the name of a shipped model if there is no such file
    :raises FileNotFoundError: a folder, or neither a file nor a shipped model; the message lists
        the model files in the folder, or the shipped models
    """
    if not isinstance(path, str | os.PathLike):
        return path
    path = Path(path)
    if not path.exists() and str(path) in shipped():
        return shipped()[str(path)]
    file = path if path.suffix or not path.name else path.with_suffix(".zip")  # "." has no name
    if path.is_dir() and not file.is_file():
        names = ", ".join(sorted(item.name for item in path.glob("*.zip"))) or "no model file"
        raise FileNotFoundError(f"{path} is a folder, which holds {names}: pass the file to load")
    if not file.exists() and path.parent == Path() and not path.suffix:
        names = ", ".join(shipped())
        raise FileNotFoundError(
            f"There is no model file {file}, nor a model of this name that comes with the library "
            f"({names}); pass the path that save() wrote, or one of these names"
        )
    return file
