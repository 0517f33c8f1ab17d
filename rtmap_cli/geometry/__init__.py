"""Poses, polylines, Chamfer distances, matching, cameras: pure functions on numpy arrays."""
