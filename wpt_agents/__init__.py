"""WPT: generalist world-model pre-training for efficient reinforcement learning from pixels."""

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory

__all__ = ["WPT", "Trajectory", "TrajectoryDataset"]
__version__ = "0.1.0"
