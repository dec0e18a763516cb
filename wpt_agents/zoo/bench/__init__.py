"""Benchmarks of the library: one module per subject, each with a function `rows`."""
