"""Find the files below a folder, through links to folders, too."""

import os
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path


def files_below(
    folder: str | os.PathLike[str], pattern: str = "*", above: frozenset[str] = frozenset()
) -> Iterator[Path]:
    """Yield the files in a folder and in all folders below it, as `Path.rglob` does.

    `rglob` does not follow links to folders, so it would leave out data that are linked, for
    example from another disk.

    :param pattern: of the files' names
    :param above: the folders that contain this one, to which a link may lead back
    """
    real = os.path.realpath(folder)
    if real in above:
        return
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return
    for entry in entries:
        linked = entry.is_symlink() and os.path.isdir(entry.path)
        if linked or entry.is_dir(follow_symlinks=False):
            yield from files_below(entry.path, pattern, above | {real})
        elif fnmatchcase(entry.name, pattern):
            yield Path(entry.path)
