"""Locks on files by which processes exclude each other.

The kernel releases such a lock when its process ends, so a killed process leaves no stale lock.
`fcntl` is imported on use, so that reading works on systems without it.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def lock(descriptor: int, wait: bool = False) -> None:
    """Lock an open file exclusively.

    :param wait: block until another holder is done
    :raises BlockingIOError: if another process has the lock and `wait` is False
    :raises OSError: if the system or the file system has no such locks
    """
    try:
        import fcntl
    except ImportError as error:
        raise OSError(
            "Writing a dataset needs file locks (fcntl), which this system does not have: write it "
            "on Linux or macOS; it can be read anywhere"
        ) from error
    fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def unlock(descriptor: int) -> None:
    """Release the lock. Closing the file is not enough if a forked process has it open, too."""
    import fcntl

    fcntl.flock(descriptor, fcntl.LOCK_UN)


@contextmanager
def locked(path: str | os.PathLike[str]) -> Iterator[None]:
    """Hold an exclusive lock on the file at `path`, which is created; wait for other holders."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "ab") as file:
        lock(file.fileno(), wait=True)
        try:
            yield
        finally:
            unlock(file.fileno())
