"""The model files of the paper's authors: nested state dicts in a `torch.save` file.

`{"wm": {"encoder": ..., "rssm": ..., "decoder": ...}}` is a pre-trained world model; a fine-tuned
snapshot has "reward", "actor", "critic" and "target_critic" beside "wm". Each of these parts maps a
parameter's name to its tensor. All shapes are those of `WPTPolicy`, so that a table of names
(`PARTS`) converts one into the other. Source: https://github.com/zhaoyi11/ncrl (commit a7422f6).
"""

import math
import os
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import torch
from torch import Tensor

from wpt_agents.files.archive import replacing

GATES, NORM_EPS = "across", 1e-5  # the gate order of the authors' GRU; PyTorch's default eps
STOCH, UNITS = 32, 512  # from the authors' configurations: shapes may not determine them
FAULTS = (zipfile.BadZipFile, RuntimeError, EOFError, OSError, ValueError, KeyError, TypeError)


def _convolutions(layers: int, norms: int) -> dict[str, str]:
    """A stack of convolution, channel norm and SiLU; the last convolutions may have no norm."""
    names = {}
    for i in range(layers):
        names[f"_conv_model.{3 * i}"] = f"layers.{3 * i}"
        if i < norms:
            names[f"_conv_model.{3 * i + 1}._norm"] = f"layers.{3 * i + 1}"
    return names


def _head(layers: int, prefix: str = "") -> dict[str, str]:
    """A `Head` with this many hidden layers."""
    names = {f"_fc_deter.{i}": f"from_deter.{i}" for i in (0, 1, 3)}
    names["_fc_stoch"] = "from_stoch"
    for i in range(layers):
        names[f"_net.{3 * i}"] = f"layers.{i}.0"
        names[f"_net.{3 * i + 1}"] = f"layers.{i}.1"
    names[f"_net.{3 * layers}"] = f"layers.{layers}"
    return {prefix + name: ours for name, ours in names.items()}


RSSM = {
    "_gru._in_stoch.0": "gru.from_stoch.0",
    "_gru._in_stoch.1": "gru.from_stoch.1",
    "_gru._in_deter.0": "gru.from_deter.0",
    "_gru._in_deter.1": "gru.from_deter.1",
    "_gru._in_action.0": "gru.from_action.0",
    "_gru._in_action.1": "gru.from_action.1",
    "_gru._dynlayers.0": "gru.hidden",
    "_gru._dynlayers.1": "gru.norm",
    "_gru._dyngru": "gru.gates",
    "_prior.0": "prior_net.0.0",
    "_prior.1": "prior_net.0.1",
    "_prior.3": "prior_net.1.0",
    "_prior.4": "prior_net.1.1",
    "_prior.6": "prior_net.2",
    "_posterior.0": "post_in",
    "_posterior.1": "post_out.0",
    "_posterior.3": "post_out.2",
}
DECODER = {
    "_fc_deter.0": "from_deter.0",
    "_fc_deter.1": "from_deter.1",
    "_fc_deter.3": "from_deter.3",
    "_fc_stoch.0": "from_stoch.0.0",
    "_fc_stoch.1": "from_stoch.0.1",
    "_fc_stoch.3": "from_stoch.1",
    **_convolutions(4, 3),
}
WORLD_MODEL = ("wm.encoder", "wm.rssm", "wm.decoder")
# For each part of a file: the corresponding module of `WPTPolicy`, and our names of its layers.
PARTS: dict[str, tuple[str, dict[str, str]]] = {
    "wm.encoder": ("world_model.encoder", _convolutions(4, 4)),
    "wm.rssm": ("world_model.rssm", RSSM),
    "wm.decoder": ("world_model.decoder", DECODER),
    "reward": ("world_model.reward_head", _head(2)),
    "actor": ("actor", _head(3, "mlp.")),
    "critic": ("critic", _head(3)),
    "target_critic": ("target_critic", _head(3)),
}


class Official(NamedTuple):
    """The content of a model file of the paper's authors.

    :param size: the fields of a `Size`, inferred from the shapes
    :param max_action_dim: the padded action width; 21 in the published files
    :param tensors: by their names in `WPTPolicy.state_dict()`
    """

    size: dict[str, Any]
    max_action_dim: int
    tensors: dict[str, Tensor]


def parameter_names(part: str) -> Iterator[tuple[str, str]]:
    """Return each parameter's name in a part of the authors' file, and in `WPTPolicy`."""
    module, layers = PARTS[part]
    for theirs, ours in layers.items():
        for kind in ("weight", "bias"):
            yield f"{theirs}.{kind}", f"{module}.{ours}.{kind}"


def official_name(name: str) -> str:
    """Return the authors' name of a parameter of `WPTPolicy`."""
    names = {ours: f"{part}.{theirs}" for part in PARTS for theirs, ours in parameter_names(part)}
    return names[name]


def read_official(path: str | os.PathLike[str], stoch: int | None = None) -> Official:
    """Read a model file of the paper's authors without running any code in it.

    :param stoch: groups of z. The shapes hold only the product of groups and classes; by default
        there are 32 groups, as in every configuration of the authors
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file is truncated, damaged, contains more than weights or is not a
        model of the authors
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"There is no model file {path}: pass the path of a .pt file")
    tensors: dict[str, Tensor] = {}
    for part, state in _parts(path, _load(path)).items():
        names = dict(parameter_names(part))
        _check_state(path, part, names, state)
        tensors |= {ours: state[theirs].contiguous() for theirs, ours in names.items()}
    return Official(*_infer(path, tensors, stoch), tensors)


def write_official(path: str | os.PathLike[str], tensors: Mapping[str, Tensor]) -> None:
    """Write a model file that the authors' scripts read.

    :param tensors: by their names in `WPTPolicy.state_dict()`; others are ignored
    """
    content: dict[str, Any] = {"wm": {}}
    for part in PARTS:
        state = {theirs: tensors[ours].detach().cpu() for theirs, ours in parameter_names(part)}
        group, _, name = part.rpartition(".")
        (content[group] if group else content)[name] = state
    with replacing(path) as temporary:
        torch.save(content, temporary)


def _load(path: Path) -> Any:
    """Verify the checksums, then read with `torch.load(weights_only=True)`."""
    if not _is_archive(path):
        raise ValueError(
            f"{path} is not an archive of torch.save (a model file of wpt_agents is for WPT.load)"
        )
    try:
        with zipfile.ZipFile(path) as archive:  # torch.load does not verify the checksums
            broken = archive.testzip()
        if broken is not None:
            raise zipfile.BadZipFile(f"the checksum of {broken} is wrong")
        return torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        raise ValueError(
            f"{path} holds objects besides weights, and loading them could run foreign code: ask "
            f"its author for the state dicts only ({_first_sentence(error)})"
        ) from error
    except FAULTS as error:
        raise ValueError(
            f"{path} is cut short or damaged ({_first_sentence(error)}): download it again"
        ) from error


def _is_archive(path: Path) -> bool:
    """Return whether this is an archive of `torch.save`, possibly a damaged one."""
    with open(path, "rb") as file:
        if file.read(2) not in (b"PK", b""):
            return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith("/data.pkl") for name in archive.namelist())
    except FAULTS:
        return True


def _first_sentence(error: BaseException) -> str:
    return str(error).split("\n")[0].split(". ")[0].rstrip(".")


def _parts(path: Path, content: Any) -> dict[str, Any]:
    """Return the parts of a file by their names in `PARTS`."""
    if not isinstance(content, Mapping) or not isinstance(content.get("wm"), Mapping):
        raise ValueError(
            f"{path} is not a model of the paper's authors: it has no world model under 'wm'"
        )
    parts = {f"wm.{name}": part for name, part in content["wm"].items()}
    parts |= {str(name): part for name, part in content.items() if name != "wm"}
    wrong = [name for name in WORLD_MODEL if name not in parts] or parts.keys() - PARTS.keys()
    if wrong:
        raise ValueError(
            f"{path} is not a model of the paper's authors, whose parts are {', '.join(PARTS)}: "
            f"it has {', '.join(sorted(parts))}"
        )
    return {name: parts[name] for name in PARTS if name in parts}


def _check_state(path: Path, part: str, names: Mapping[str, str], state: Any) -> None:
    """Raise an error if a part lacks a tensor, has an unknown one, or one of another type."""
    if not isinstance(state, Mapping):
        raise ValueError(f"{path} is not a model of the paper's authors: {part} is no state dict")
    for name in [*names, *state]:
        if name not in state or name not in names:
            verb = "lacks" if name in names else "has an unknown"
            raise ValueError(f"{path} has another architecture: its {part} {verb} {name}")
        tensor = state[name]
        if not isinstance(tensor, Tensor) or tensor.dtype != torch.float32:
            kind = getattr(tensor, "dtype", type(tensor).__name__)
            raise ValueError(f"{path} must hold float32 tensors, but {part}.{name} is {kind}")


def _infer(
    path: Path, tensors: Mapping[str, Tensor], stoch: int | None
) -> tuple[dict[str, Any], int]:
    """Return the fields of `Size`, and the padded action width."""
    rssm, shapes = "world_model.rssm", {name: tuple(t.shape) for name, t in tensors.items()}
    try:
        hidden, deter = shapes[f"{rssm}.gru.from_deter.0.weight"]
        _, code = shapes[f"{rssm}.gru.from_stoch.0.weight"]
        _, width = shapes[f"{rssm}.gru.from_action.0.weight"]
        blocks, _, _ = shapes[f"{rssm}.gru.gates.weight"]
        depth, _, _, _ = shapes["world_model.encoder.layers.0.weight"]
        heads = [f"{name}.from_stoch.weight" for name, _ in list(PARTS.values())[3:]]
        units, _ = next((shapes[head] for head in heads if head in shapes), (UNITS, code))
    except ValueError as error:  # another number of dimensions
        raise ValueError(f"{path} has another architecture: {error}") from error
    groups = _groups(path, code, stoch)
    size = {"deter": deter, "hidden": hidden, "stoch": groups, "classes": code // groups}
    size |= {"depth": depth, "units": units, "blocks": blocks, "stabilised": False}
    return size | {"gates": GATES, "norm_eps": NORM_EPS}, width


def _groups(path: Path, code: int, stoch: int | None) -> int:
    """Return the number of groups in a z of `code` numbers."""
    if stoch is not None:
        if stoch < 1 or code % stoch:
            raise ValueError(f"{path} has a z of {code} numbers, no multiple of stoch={stoch}")
        return stoch
    if code % STOCH == 0:
        return STOCH
    groups = max(k for k in range(1, math.isqrt(code) + 1) if code % k == 0)
    warnings.warn(
        f"{path} has a z of {code} numbers, which do not divide into the authors' {STOCH} groups: "
        f"assuming {groups} groups of {code // groups} classes; pass stoch= if that is wrong",
        stacklevel=5,
    )
    return groups
