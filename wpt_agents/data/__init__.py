"""Trajectories, datasets, replay, retrieval, and importers of other formats."""
