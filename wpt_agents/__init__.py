"""WPT: generalist world-model pre-training for efficient reinforcement learning from pixels.

The names below are imported when they are first used, so that `import wpt_agents` takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from wpt_agents.files import moved

if TYPE_CHECKING:  # for editors and type checkers
    from wpt_agents.agents.drqv2 import DrQv2
    from wpt_agents.agents.jsrl import JSRL
    from wpt_agents.agents.mrq import MRQ
    from wpt_agents.agents.packnet import PackNet
    from wpt_agents.agents.r3m import R3M
    from wpt_agents.agents.rlpd import RLPD
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.data.dataset import TrajectoryDataset
    from wpt_agents.data.trajectory import Trajectory
    from wpt_agents.zoo.collect.collection import collect

PUBLIC = {
    "WPT": "wpt_agents.agents.wpt",
    "TrajectoryDataset": "wpt_agents.data.dataset",
    "Trajectory": "wpt_agents.data.trajectory",
    "DrQv2": "wpt_agents.agents.drqv2",
    "JSRL": "wpt_agents.agents.jsrl",
    "MRQ": "wpt_agents.agents.mrq",
    "PackNet": "wpt_agents.agents.packnet",
    "R3M": "wpt_agents.agents.r3m",
    "RLPD": "wpt_agents.agents.rlpd",
    "collect": "wpt_agents.zoo.collect.collection",
}
__all__ = [
    "JSRL",
    "MRQ",
    "R3M",
    "RLPD",
    "WPT",
    "DrQv2",
    "PackNet",
    "Trajectory",
    "TrajectoryDataset",
    "collect",
]
__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """Import a public name (PEP 562)."""
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(PUBLIC[name]), name)


def __dir__() -> list[str]:
    """Return the module's names, also those that are not imported yet."""
    return sorted({*globals(), *__all__})


moved.install()
