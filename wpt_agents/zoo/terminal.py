"""The runner's output: the shared console, one line per stage, and progress bars."""

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from tqdm.auto import tqdm

console = Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 120)


def say(stage: str, text: str, path: Path | None = None) -> None:
    """Print a line about a stage, above its progress bar, with the path of its result, if any."""
    where = "" if path is None else f"  {dim(path)}"
    console.print(f"[bold]{stage:<10}[/bold]{text}{where}")


def dim(path: Path) -> str:
    """Return a path as grey text; brackets in it are not markup."""
    return f"[dim]{escape(str(path))}[/dim]"


def progress(
    total: int | None, label: str, unit: str, done: int = 0, hide: bool = False
) -> "tqdm[None]":
    """Show a progress bar on a terminal, or print a line every ten seconds into a log file."""
    interval = 0.2 if sys.stderr.isatty() else 10
    return tqdm(
        total=total, initial=done, desc=label, unit=f" {unit}", mininterval=interval, disable=hide
    )


@contextmanager
def logged(path: Path) -> Iterator[None]:
    """Append to a file all that is printed, with progress bars, and the traceback of an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    streams = sys.stdout, sys.stderr
    with open(path, "a", buffering=1, encoding="utf-8") as file:
        sys.stdout = sys.stderr = file
        console.file = file
        try:
            yield
        except Exception:
            traceback.print_exc()
            raise
        finally:
            sys.stdout, sys.stderr = streams
            console.file = None  # type: ignore[assignment]  # in rich it means sys.stdout
