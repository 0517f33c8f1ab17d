"""Fused maps: honesty of their sigmas, speed, growth."""
