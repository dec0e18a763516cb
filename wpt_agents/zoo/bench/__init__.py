"""What the library costs, measured: one module a subject, each with `rows`."""
