"""Evaluation and diagnosis of policies and world models."""
