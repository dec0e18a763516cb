"""Algorithms, one per file: WPT (Algorithm 1 of the paper) and the explorers."""
