"""The runner's progress bar: how much, how fast, and the time left."""

import sys

from tqdm.auto import tqdm


def progress(
    total: int | None, label: str, unit: str, done: int = 0, hide: bool = False
) -> "tqdm[None]":
    """A bar on the terminal, or a line every ten seconds in a log file."""
    interval = 0.2 if sys.stderr.isatty() else 10
    return tqdm(
        total=total, initial=done, desc=label, unit=f" {unit}", mininterval=interval, disable=hide
    )
