"""Clouds, lifting and lanes: accuracy against references, speed against peers."""
