"""The import path of version 0.1; `wpt_agents.zoo.plan.presets` is the module now."""

import warnings
from typing import Any

from wpt_agents.zoo.plan import presets


def __getattr__(name: str) -> Any:
    """Serve the public names of `plan.presets`, with a DeprecationWarning."""
    if name.startswith("_") or not hasattr(presets, name):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    message = f"wpt_agents.zoo.presets moved: write `from {presets.__name__} import {name}`"
    warnings.warn(message, DeprecationWarning, stacklevel=2)
    return getattr(presets, name)
