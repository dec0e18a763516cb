"""Locks on folders that several processes write to, and files that are written as a whole."""

import fcntl
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from wpt_agents.files.archive import replacing

PATIENCE = 0.5  # seconds to wait for a lock: `zoo watch` takes each one for an instant


@contextmanager
def locked(path: Path, wait: bool = False) -> Iterator[None]:
    """Keeps other processes out while the block runs; the lock ends with its process.

    :param path: a file that stands for what is locked
    :param wait: until it is free, instead of refusing after `PATIENCE`
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", encoding="utf-8") as file:
        until = time.monotonic() + PATIENCE
        while not _taken(file, wait):
            if time.monotonic() > until:
                raise ValueError(
                    f"{path.parent} is being worked on by another process: wait for it, or use "
                    "another --out"
                )
            time.sleep(PATIENCE / 10)
        yield


def _taken(file: IO[str], wait: bool) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    return True


def write_json(path: Path, value: Any) -> None:
    """Writes `value` to `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1), encoding="utf-8")
