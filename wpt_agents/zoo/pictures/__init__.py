"""Figures, videos and contact sheets."""
