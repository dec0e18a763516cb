"""Other people's data as trajectories: one module a format, read one episode at a time.

Example::

    dataset = TrajectoryDataset.from_npz("exorl/walker", "walker-store", embodiment="walker")

Formats differ in when an action stands (`wpt_agents.data.trajectory` has ours); each reader says
which convention it converts from.
"""
