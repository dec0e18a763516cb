"""WPT: generalist world-model pre-training for efficient reinforcement learning from pixels."""

from wpt_agents.dataset import TrajectoryDataset
from wpt_agents.trajectory import Trajectory
from wpt_agents.wpt import WPT

__all__ = ["WPT", "Trajectory", "TrajectoryDataset"]
__version__ = "0.1.0"
