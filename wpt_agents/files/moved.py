"""Keep the import paths of version 0.1 working in this version, with a DeprecationWarning.

`import wpt_agents.policy` finds a module that looks up its names in `wpt_agents.model.policy`.
"""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

PACKAGE = "wpt_agents"
FOLDERS = {  # modules of version 0.2, and the names of those of version 0.1 in them
    "data": (
        *("codecs", "convert", "dataset", "images", "importers", "index", "replay", "retrieval"),
        *("shards", "trajectory", "windows"),
    ),
    "fast": ("acting", "compiled", "scan"),
    "files": ("archive", "model_file", "names"),
    "model": (
        *("actor_critic", "behavior_cloning", "distributions", "policy", "rssm"),
        "world_model",
    ),
    "training": ("checks", "distributed", "guidance", "pretraining", "rollout"),
}
MOVED = {
    f"{PACKAGE}.{name}": f"{PACKAGE}.{folder}.{name}"
    for folder, names in FOLDERS.items()
    for name in names
}
MOVED |= {
    "wpt_agents.exploration": "wpt_agents.agents.curious",
    "wpt_agents.importers.convert": "wpt_agents.data.convert",
    "wpt_agents.saving": "wpt_agents.agents.saved",
    "wpt_agents.updates": "wpt_agents.training.learner",
    "wpt_agents.wpt": "wpt_agents.agents.wpt",
}
MOVED |= {
    f"wpt_agents.importers.{name}": f"wpt_agents.data.importers.{name}"
    for name in ("episodes", "hdf5", "lerobot", "minari", "npz", "rlds", "sb3")
}


# Modules that were split into several; names are looked up in all of them.
SPLIT = {
    f"{PACKAGE}.{old}": tuple(f"{PACKAGE}.{name}" for name in names)
    for old, names in {
        "acting": ("fast.acting", "fast.acting_networks", "fast.tape"),
        "checks": ("training.checks", "training.spaces", "training.keywords"),
        "networks": (
            *("model.images", "model.layers", "model.sizes"),
            *("fast.convolutions", "fast.products", "fast.pieces", "fast.conditions"),
        ),
        "policy": ("model.policy", "model.prior_policy", "model.observations"),
        "scan": ("fast.scan", "fast.tape"),
        "updates": ("training.learner", "training.randomness"),
    }.items()
}
MOVED["wpt_agents.networks"] = "wpt_agents.model.images"


def new_modules(old: str) -> list[ModuleType]:
    """Return the modules that contain the names of an old one."""
    return [import_module(name) for name in SPLIT.get(old, (MOVED[old],))]


class MovedModule(ModuleType):
    """A module at an old path, with the names of the module at the new path."""

    def __getattr__(self, name: str) -> Any:
        """Return a name of the module at the new path."""
        if name.startswith("__"):  # the import system looks some of them up
            raise AttributeError(name)
        for module in new_modules(self.__name__):
            if hasattr(module, name):
                return getattr(module, name)
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        """Return the names of the module at the new path."""
        return [name for module in new_modules(self.__name__) for name in dir(module)]


class MovedFinder(MetaPathFinder, Loader):
    """A finder for the modules of version 0.1."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a spec for an old path, None for any other path."""
        if fullname not in MOVED:
            return None
        return ModuleSpec(fullname, self, is_package=fullname == "wpt_agents.importers")

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Make a module that looks its names up at the new path."""
        return MovedModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Warn that the path is old."""
        new = MOVED[module.__name__]
        warnings.warn(
            f"{module.__name__} has moved to {new}. The old path works in this version only",
            DeprecationWarning,
            stacklevel=2,
        )


def install() -> None:
    """Add the finder of old paths to the import system, after all others."""
    if not any(isinstance(finder, MovedFinder) for finder in sys.meta_path):
        sys.meta_path.append(MovedFinder())
