"""Execution of runs: stages, checkpoints, engines."""
