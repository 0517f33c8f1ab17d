"""Simulated worlds, drives, images, observations and changes, all seeded."""
