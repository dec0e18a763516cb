"""Recording of datasets."""
