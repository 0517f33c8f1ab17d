"""Semantic rasters: their network, and simulated drives to learn from."""
