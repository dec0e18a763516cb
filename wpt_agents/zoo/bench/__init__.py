"""Measurements of speed, size and memory, each a module with `rows`."""
