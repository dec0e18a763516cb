"""Measurements of the library, one module a subject; each has `rows`."""
