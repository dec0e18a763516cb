"""Matplotlib without a display, and the colours that pictures share."""

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

INK = "#1f2933"
MUTED = "#8a94a0"
AGENT = "#2463a8"  # the colour of the agent, and of the query's own robot
CLONE = "#d98324"  # the colour of the prior actor, and of other robots

__all__ = ["AGENT", "CLONE", "INK", "MUTED", "plt"]
