"""The results below a folder of runs. A damaged file is left out with a warning that names it."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from wpt_agents.zoo.result import FILE, Result, read_result

Content = TypeVar("Content")


def unless_damaged(read: Callable[[Path], Content], path: Path) -> Content | None:
    """Return what `read` reads; None, with a warning, if it raises a ValueError.

    So a damaged file of one run does not hide the other runs.
    """
    try:
        return read(path)
    except ValueError as error:
        warnings.warn(f"Left out: {error}", stacklevel=1)
        return None


def find_every(folder: Path) -> dict[Path, Result]:
    """Return the result of every run folder below `folder`, also of copies, in their order."""
    folders = [file.parent for file in sorted(folder.glob(f"**/{FILE}"))]
    results = ((path, unless_damaged(read_result, path)) for path in folders)
    return {path: result for path, result in results if result is not None}


def find_results(folder: Path) -> dict[Path, Result]:
    """Return the result of every finished run below `folder`, in the order of their paths.

    :raises ValueError: if a run exists twice, which would count as two seeds
    """
    results = find_every(folder)
    seen: dict[object, Path] = {}
    for path, result in results.items():
        check_new(result.identity, path, seen)
    return results


def check_new(identity: object, folder: Path, seen: dict[object, Path]) -> None:
    """Raise an error if `seen` has a run of this identity; add it otherwise."""
    if identity in seen:
        raise ValueError(
            f"{seen[identity]} and {folder} are the same run: report one of their folders, or "
            "delete one of them"
        )
    seen[identity] = folder
