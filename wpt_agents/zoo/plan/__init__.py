"""Presets, and the runs that a command asks for."""
