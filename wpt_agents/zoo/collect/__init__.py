"""Collect non-curated data by playing tasks."""

import warnings
from typing import Any


def __getattr__(name: str) -> Any:
    """Serve `collect` under its import path of version 0.1, with a DeprecationWarning."""
    if name != "collect":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from wpt_agents.zoo.collect.collection import collect

    message = "wpt_agents.zoo.collect.collect moved: write `from wpt_agents import collect`"
    warnings.warn(message, DeprecationWarning, stacklevel=2)
    return collect
