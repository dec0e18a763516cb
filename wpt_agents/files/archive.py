"""Atomic files: arrays and JSON in one file with checksums, without pickle.

Such a file is an uncompressed zip archive; reading verifies the checksum of each member.
"""

import errno
import glob
import json
import os
import socket
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

VERSION = 1  # increased when the layout changes, so that older versions reject new files
# What zipfile, zlib, json and NumPy raise on damaged files.
FAULTS: tuple[type[Exception], ...] = (zipfile.BadZipFile, zlib.error, EOFError, OSError, KeyError)
FAULTS += (RuntimeError, TypeError, ValueError)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` if the block succeeds.

    The file is synced to disk before it is renamed, so a crash at any moment leaves either the old
    or the new file complete. If the block raises, `path` is unchanged and the temporary file is
    deleted. Temporary files of killed processes are removed by the next write to `path` on the
    same machine.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    here = f".{path.name}.tmp-{socket.gethostname()}-"
    for left in path.parent.glob(f"{glob.escape(here)}*"):
        if not _alive(left.name.removeprefix(here)):
            left.unlink(missing_ok=True)
    temporary = path.with_name(f"{here}{os.getpid()}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(FileNotFoundError):
            temporary.unlink()
        if isinstance(error, OSError) and error.filename is None:  # for example if the disk is full
            error.filename = str(path)
        raise
    sync_folder(path.parent)


def _alive(pid: str) -> bool:
    """Return whether a process with this ID exists on this machine; True if that is unknown."""
    if os.name == "nt":  # on Windows, signal 0 is Ctrl-C
        return True
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except (OSError, ValueError):  # another user's process, or a file that is not ours
        return True
    return True


def sync_folder(folder: Path) -> None:
    """Sync the directory entries of `folder` to disk.

    Nothing happens where that is not supported: on Windows, and on some network file systems.
    """
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        except OSError as error:
            if error.errno not in (errno.EBADF, errno.EINVAL):
                raise
        finally:
            os.close(descriptor)


def save_arrays(
    path: str | os.PathLike[str],
    kind: str,
    header: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Write `header` (JSON) and `arrays` atomically to one file of this `kind`."""
    head = {"kind": kind, "version": VERSION, **header}
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        archive.writestr("about.json", json.dumps(head))
        for name, array in arrays.items():
            # zip64, because the size is not known before the array is written
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(  # type: ignore[no-untyped-call]
                    member, array, allow_pickle=False
                )


def load_arrays(
    path: str | os.PathLike[str], kind: str
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a file of `save_arrays` and verify every byte.

    :raises ValueError: if the file is truncated, damaged, of another kind or of a newer version
    """
    with open(path, "rb") as file:
        try:
            return _read_arrays(file, kind)
        except FAULTS as error:
            raise ValueError(
                f"{path} is damaged or not a {kind} of version {VERSION} ({error}); make it again"
            ) from error


def _read_arrays(file: IO[bytes], kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    with zipfile.ZipFile(file) as archive:
        header = json.loads(archive.read("about.json"))
        if header["kind"] != kind or header["version"] > VERSION:
            raise ValueError(f"it holds a {header['kind']} of version {header['version']}")
        arrays = {}
        for name in archive.namelist():
            if name.endswith(".npy"):
                with archive.open(name) as member:
                    arrays[name[:-4]] = _read_array(member)
        return header, arrays


def _read_array(file: IO[bytes]) -> np.ndarray:
    array: np.ndarray = np.lib.format.read_array(  # type: ignore[no-untyped-call]
        file, allow_pickle=False
    )
    return array
