"""How the road lies under each frame, from what a log and a map know about heights.

A network reads the road as the plane z = 0 of its ego frame. A vehicle that pitches on its springs
or stands before a slope sees another plane, and thirty metres ahead a quarter of a degree moves
what it sees by metres (distance² / camera height · angle). Where the prior map has heights its
vertices around the pose say how the road lies; elsewhere the log's own path does: the ego origin
runs at one height above the road.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.geometry.poses import invert
from rtmap_cli.maps.element import VectorMap

Array = NDArray[np.float64]

REACH_M = 36.0
"""Places further from the vehicle than this say nothing about its road."""

HALF_M = 15.0
"""A place this far away counts half."""

MIN_POINTS = 8
"""Heights that a prior map must have around the vehicle to be asked."""

PLACE_SIGMA_M = 0.06
"""How well one place follows the plane, metres."""

SLOPE_SIGMA = 0.03
"""How much slopes vary that nothing measures (across a path, say): the weight of ground that is
level in the map frame (roads lean less against that than vehicles against their roads)."""

HEAVE_SIGMA_M = 0.03
"""How far a body rises and sinks on its springs, metres."""

STEEPEST = 0.2
"""Slopes beyond this are errors of poses, not roads; the frame is left as it is."""


class RoadUnder:
    """The plane of the road in the ego frame of any frame of a log.

    ``poses`` (F, 4, 4): map_SE3_ego of all frames, ``prior``: the map, with or without heights.
    """

    def __init__(self, poses: Sequence[Array], prior: VectorMap | None = None):
        self.path = _thinned(np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3))
        self.path_tree = cKDTree(self.path[:, :2])
        known = _heights(prior)
        self.known, self.known_tree = known, cKDTree(known[:, :2]) if len(known) else None

    def plane(self, map_SE3_ego: Array) -> Array:
        """(3,) a, b, c of the road z = a x + b y + c in the ego frame dropped to the road, metres.

        c is how far the path around lies above this pose: the body rises and sinks, the road does
        not. Zero where nothing is known.
        """
        here, back = map_SE3_ego[:2, 3], invert(map_SE3_ego)
        up = map_SE3_ego[2, :3]
        level = -up[:2] / max(up[2], 0.5)
        path = self.path[self.path_tree.query_ball_point(here, REACH_M)]
        path = path @ back[:3, :3].T + back[:3, 3]
        if self.known_tree is not None:
            near = self.known[self.known_tree.query_ball_point(here, REACH_M)]
            if len(near) >= MIN_POINTS:
                # The map's heights and the pose's may have different zeros.
                slopes = _fit(near @ back[:3, :3].T + back[:3, 3], level, np.inf)[:2]
                if np.abs(slopes).max() < STEEPEST:
                    fixed = _fit(path, slopes, HEAVE_SIGMA_M, slope=1e-6)
                    return np.append(slopes, fixed[2])
        plane = _fit(path, level, HEAVE_SIGMA_M)
        return plane if np.abs(plane[:2]).max() < STEEPEST else np.zeros(3)


def _fit(local: Array, level: Array, heave: float, slope: float = SLOPE_SIGMA) -> Array:
    """(3,) a, b, c by least squares through (n, 3) ego metres; as the prior, slopes are ``level``
    (2,) with a standard deviation ``slope`` and c is 0 with ``heave``."""
    rows = np.column_stack([local[:, :2], np.ones(len(local))])
    distance = np.hypot(local[:, 0], local[:, 1])
    weight = 1.0 / (1.0 + (distance / HALF_M) ** 2) / PLACE_SIGMA_M
    prior = np.array([slope**-2.0, slope**-2.0, max(heave**-2.0, 1e-6)])
    rows, z = rows * weight[:, None], local[:, 2] * weight
    solved: Array = np.linalg.solve(
        rows.T @ rows + np.diag(prior), rows.T @ z + prior * np.append(level, 0.0)
    )
    return solved


def _thinned(path: Array, step: float = 1.0) -> Array:
    """Places at least ``step`` metres apart along a path (n, 3): a standing vehicle counts once."""
    if len(path) == 0:
        return np.zeros((1, 3))
    keep = [0]
    for k in range(1, len(path)):
        if np.hypot(*(path[k, :2] - path[keep[-1], :2])) >= step:
            keep.append(k)
    return path[keep]


def _heights(vector_map: VectorMap | None) -> Array:
    """(n, 3) vertices of a map whose heights are known."""
    if vector_map is None:
        return np.zeros((0, 3))
    points = [e.points for e in vector_map if e.points.shape[1] == 3]
    every = np.concatenate([*points, np.zeros((0, 3))])
    return every[np.isfinite(every).all(axis=1)]
