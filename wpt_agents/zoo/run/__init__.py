"""Doing runs: stages, checkpoints, engines."""
