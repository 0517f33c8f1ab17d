"""Frames by themselves: single-frame MAP, and the error model that a run shows."""
