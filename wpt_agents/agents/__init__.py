"""Algorithms, one per file: WPT (Algorithm 1 of the paper), explorers and baselines."""
