"""What stands beside the road: buildings, trees, poles."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]

OBJECT_COLUMNS = ("x", "y", "yaw", "length", "width", "bottom", "top", "r", "g", "b", "kind")
"""Columns of ``World.objects``: map frame, metres, RGB 0…255; kind 0 box, 1 crown of a tree."""

BUILDING, CROWN = 0.0, 1.0


def roadside(surface: Any, seed: int) -> Array:
    """(n, 11) objects along the outer edges of the asphalt, never on it; see OBJECT_COLUMNS."""
    rng = np.random.default_rng([seed, 47])
    if surface.is_empty:
        return np.zeros((0, len(OBJECT_COLUMNS)))
    density = rng.uniform(0.4, 1.0)
    rows: list[list[float]] = []
    edge = shapely.boundary(surface)
    for ring in shapely.get_parts(edge):
        at = 0.0
        while at < ring.length:
            p, q = ring.interpolate(at), ring.interpolate(min(at + 1.0, ring.length))
            at += rng.exponential(7.0 / density) + 2.0
            heading = float(np.arctan2(q.y - p.y, q.x - p.x))
            out = rng.uniform(1.6, 14.0) * rng.choice([-1.0, 1.0])
            x, y = p.x - np.sin(heading) * out, p.y + np.cos(heading) * out
            rows += _object(rng, x, y, heading, abs(out))
    table = np.array(rows).reshape(-1, len(OBJECT_COLUMNS))
    if not len(table):
        return table
    clearance = shapely.distance(surface, shapely.points(table[:, :2]))
    reach = np.hypot(table[:, 3], table[:, 4]) / 2
    return table[clearance > np.where(table[:, 10] == CROWN, 1.0, reach + 0.8)]


def _object(
    rng: np.random.Generator, x: float, y: float, heading: float, away: float
) -> list[list[float]]:
    kind = rng.random()
    if kind < 0.4 and away > 5:
        size = min(away - 1.0, 9.0)
        shade = np.array([1, 0.95, 0.9]) * rng.uniform(55, 190) * (1 + rng.normal(0, 0.06, 3))
        box = [x, y, heading, rng.uniform(1.0, 1.8) * size, size, 0.0, rng.uniform(4, 16)]
        return [[*box, *shade, BUILDING]]
    if kind < 0.72:
        trunk = [x, y, 0.0, 0.3, 0.3, 0.0, 2.6, 70.0, 60.0, 50.0, BUILDING]
        green = np.array([rng.uniform(35, 80), rng.uniform(60, 110), rng.uniform(25, 60)])
        size = rng.uniform(2.5, 5.0)
        low = rng.uniform(1.8, 2.6)
        return [trunk, [x, y, 0.0, size, size, low, low + size, *green, CROWN]]
    grey = rng.uniform(60, 170)
    return [[x, y, 0.0, 0.18, 0.18, 0.0, rng.uniform(2.2, 8.0), grey, grey, grey, BUILDING]]
