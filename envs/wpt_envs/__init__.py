"""Pixel tasks under one Gymnasium namespace."""
