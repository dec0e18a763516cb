"""What the runner prints: the shared console, one line per stage, and progress bars."""

import sys

from rich.console import Console
from tqdm.auto import tqdm

console = Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 120)


def say(stage: str, text: str) -> None:
    """One line about a stage, above its progress bar."""
    console.print(f"[bold]{stage:<10}[/bold]{text}")


def progress(
    total: int | None, label: str, unit: str, done: int = 0, hide: bool = False
) -> "tqdm[None]":
    """A bar on the terminal, or a line every ten seconds in a log file."""
    interval = 0.2 if sys.stderr.isatty() else 10
    return tqdm(
        total=total, initial=done, desc=label, unit=f" {unit}", mininterval=interval, disable=hide
    )
