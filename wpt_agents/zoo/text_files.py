"""Text and JSON files: written atomically, and read with an error that names a damaged one."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from wpt_agents.files.archive import replacing

Content = TypeVar("Content")


def write_atomically(path: Path, text: str) -> None:
    """Write `text` to `path` atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write `value` to `path` atomically."""
    write_atomically(path, json.dumps(value, indent=1))


def read_json(path: Path, build: Callable[[Any], Content]) -> Content | None:
    """Return what `build` makes of the value in a file, None if there is no such file.

    :raises ValueError: if the file is damaged
    """
    if not path.exists():
        return None
    try:
        return build(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged ({error!r}); delete it and run again") from None
