"""Readers of other data formats: one module for each format, which reads one episode at a time.

Example::

    dataset = TrajectoryDataset.from_npz("exorl/walker", "walker-store", embodiment="walker")

Formats differ in which action belongs to which image. Each reader documents the convention of its
format, and converts it to that of `wpt_agents.data.trajectory`.
"""
