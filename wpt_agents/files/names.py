"""Text for messages: errors for unknown names, and nouns with their number."""

import difflib
from collections.abc import Iterable


def unknown_name(
    kind: str, name: object, valid: Iterable[str], listed: Iterable[str] | None = None
) -> ValueError:
    """Return the error for an unknown name, with similar names and all valid ones.

    :param listed: what is listed instead of the valid names, if they are too many
    """
    names = sorted(valid)
    near = difflib.get_close_matches(str(name), names, n=3, cutoff=0.5)
    hint = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
    there = ", ".join(names if listed is None else sorted(listed))
    return ValueError(f"No {kind} {name!r}. {hint}There are: {there}")


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: '1 task', '2,000 tasks'."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
