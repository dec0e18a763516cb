"""Other people's data as trajectories: one module a format, read one episode at a time.

Example::

    episodes = open_episodes("exorl/walker", embodiment="walker")
    dataset = convert(episodes, "walker-store", progress_bar=True)

Formats differ in when an action stands (`wpt_agents.trajectory` has ours); each reader says which
convention it converts from.
"""
