"""The model file: one zip of JSON and safetensors, written atomically, without pickle."""

import json
import os
import zipfile
from collections.abc import Mapping
from io import BufferedIOBase
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.optim import Optimizer

from wpt_agents.files.archive import replacing
from wpt_agents.files.tensors import read_tensors, write_tensors

KIND, VERSION = "wpt_agents model", 1
ABOUT, TENSORS = "about.json", ".safetensors"
FAULTS: tuple[type[Exception], ...] = (zipfile.BadZipFile, EOFError, OSError, KeyError)
# zipfile and json raise these for invalid files
FAULTS += (AttributeError, RuntimeError, TypeError, ValueError)


def write_model(
    path: str | os.PathLike[str] | BufferedIOBase,
    header: Mapping[str, Any],
    tensors: Mapping[str, Mapping[str, Tensor]],
) -> None:
    """Write JSON and named groups of tensors to `path`, or to an open binary file."""
    if isinstance(path, str | os.PathLike):
        with replacing(path) as temporary, open(temporary, "wb") as file:
            _write(file, header, tensors)
    else:
        _write(path, header, tensors)


def _write(
    file: BufferedIOBase, header: Mapping[str, Any], tensors: Mapping[str, Mapping[str, Tensor]]
) -> None:
    # ZipInfo without a time stamp: equal models give identical files
    with zipfile.ZipFile(file, "w") as archive:
        head = {"kind": KIND, "version": VERSION, "groups": list(tensors), **header}
        archive.writestr(zipfile.ZipInfo(ABOUT), json.dumps(head, indent=1))
        for name, group in tensors.items():
            with archive.open(zipfile.ZipInfo(name + TENSORS), "w", force_zip64=True) as member:
                write_tensors(member, group)


def read_model(
    path: str | os.PathLike[str] | BufferedIOBase,
) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
    """Read a file of `write_model` and verify every byte.

    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file is truncated, damaged, of another kind, or of a newer version
    """
    if not isinstance(path, str | os.PathLike):
        return _read(path, "The file")
    if not Path(path).exists():
        raise FileNotFoundError(f"There is no model file {path}; pass the path that save() wrote")
    with open(path, "rb") as file:
        return _read(file, str(path))


def agent_of(path: str | os.PathLike[str]) -> str | None:
    """Return the class that wrote a model file; None if the file is none, as `read_model` tells."""
    try:
        return str(read_header(path)["class"])
    except FAULTS:
        return None


def is_of_sb3(path: str | os.PathLike[str]) -> bool:
    """Return whether Stable-Baselines3 itself wrote a file, for one of its own algorithms."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "_stable_baselines3_version" in archive.namelist()


def read_header(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the JSON of a model file without reading or verifying its tensors."""
    with zipfile.ZipFile(path) as archive:
        header: dict[str, Any] = json.loads(archive.read(ABOUT))
        return header


def _read(file: BufferedIOBase, name: str) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
    try:
        with zipfile.ZipFile(file) as archive:
            groups = _members(archive)
            header = json.loads(archive.read(ABOUT))
            if header["kind"] != KIND:
                raise ValueError(f"it is a {header['kind']!r}")
            if header["version"] > VERSION:
                raise ValueError(f"it is of version {header['version']}: update wpt_agents")
            if header.get("groups", groups) != groups:
                raise ValueError(f"it should contain {header['groups']} but contains {groups}")
            return header, {name: _tensors(archive, name) for name in groups}
    except FAULTS as error:
        raise ValueError(
            f"{name} is not a {KIND} of version {VERSION}, or is damaged ({error}); "
            "load another copy or an earlier checkpoint"
        ) from error


def _tensors(archive: zipfile.ZipFile, group: str) -> dict[str, Tensor]:
    with archive.open(group + TENSORS) as member:
        return read_tensors(member, archive.getinfo(group + TENSORS).file_size)


def _members(archive: zipfile.ZipFile) -> list[str]:
    """Return the names of the groups of tensors; raise an error for any other member."""
    names = archive.namelist()
    if ABOUT not in names:
        raise ValueError(f"it has no {ABOUT}: not a model of wpt_agents")
    for info in archive.infolist():
        known = info.filename == ABOUT or info.filename.endswith(TENSORS)
        if not known or info.compress_type != zipfile.ZIP_STORED:
            raise ValueError(f"it contains {info.filename!r}, which wpt_agents does not write")
    return [name.removesuffix(TENSORS) for name in names if name != ABOUT]


def optimizer_tensors(optimizer: Optimizer) -> dict[str, Tensor]:
    """Return the running averages of an optimiser, named by parameter number and kind."""
    state = optimizer.state_dict()["state"]
    return {f"{i}.{key}": value for i, group in state.items() for key, value in group.items()}


def load_optimizer(optimizer: Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Restore the tensors of `optimizer_tensors`; learning rates do not change."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split(".")
        state.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
