"""Trajectories, datasets, replay, retrieval, and importers of other formats."""

from wpt_agents.data.convert import open_dataset  # assigns constructors of TrajectoryDataset, too

__all__ = ["open_dataset"]
