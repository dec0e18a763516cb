"""Locks on folders that several processes write to."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

PATIENCE = 0.5  # seconds to wait for a lock, because `zoo watch` acquires each one briefly


@contextmanager
def locked(path: Path, wait: bool = False) -> Iterator[None]:
    """Lock out other processes during the block; the lock ends with its process.

    :param path: the lock file
    :param wait: wait until it is free, instead of raising an error after `PATIENCE` seconds
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", encoding="utf-8") as file:
        until = time.monotonic() + PATIENCE
        while not _taken(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB)):
            if time.monotonic() > until:
                raise ValueError(
                    f"{path.parent} is being worked on by another process: wait for it, or use "
                    "another --out"
                )
            time.sleep(PATIENCE / 10)
        yield


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Wait until no other process is in such a block of the folder; this leaves no lock file."""
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Return whether a process is in a `locked` block, on any machine if the file system can."""
    if not path.exists():
        return False
    with open(path, encoding="utf-8") as file:
        return not _taken(file, fcntl.LOCK_SH | fcntl.LOCK_NB)


def _taken(file: IO[str], kind: int) -> bool:
    """Take a lock of `flock`; return False if another process has it."""
    try:
        fcntl.flock(file, kind)
    except BlockingIOError:
        return False
    return True
