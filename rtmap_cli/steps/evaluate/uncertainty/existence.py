"""Is what a map or a prior claims still in the world? The truth behind a probability to exist."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample_step
from rtmap_cli.maps.element import RING_CLASSES, VectorMap

Array = NDArray[np.float64]

REACH = 1.0
"""A point of a line is in the world when a true line of its class is within this, metres …"""
LEAST_SHARE = 0.5
"""… and a line or a crossing is when this share of its length or area is."""
STEP = 0.5
"""Lines are probed at points so far apart, metres."""


class World:
    """The true map, asked whether something is in it."""

    def __init__(self, truth: VectorMap) -> None:
        import shapely

        self.trees: dict[str, Any] = {}
        for name in dict.fromkeys(e.class_name for e in truth):
            shapes = [_shape(e.xy, name) for e in truth.of_class(name)]
            self.trees[name] = shapely.STRtree(shapes)

    def holds(self, points: Array, class_name: str, region: Any | None = None) -> bool | None:
        """Whether half of a line (n, 2) lies within 1 m of true lines of its class, or half of
        the area of a ring on true crossings.

        Only the part inside ``region`` (a prepared shapely polygon) counts; None where less than
        half of a crossing or less than 1 m of a line is in it.
        """
        import shapely

        if class_name in RING_CLASSES:
            return self._holds_ring(_shape(points, class_name), class_name, region)
        probes = shapely.points(resample_step(points, STEP)[:, :2])
        if region is not None:
            probes = probes[shapely.intersects(region, probes)]
            if len(probes) < 1 + 1.0 / STEP:
                return None
        tree = self.trees.get(class_name)
        if tree is None:
            return False
        found = np.unique(tree.query(probes, predicate="dwithin", distance=REACH)[0])
        return len(found) >= LEAST_SHARE * len(probes)

    def _holds_ring(self, ring: Any, class_name: str, region: Any | None) -> bool | None:
        import shapely

        area = shapely.area(ring)
        seen = ring if region is None else shapely.intersection(ring, region)
        if shapely.area(seen) < LEAST_SHARE * area:
            return None
        tree = self.trees.get(class_name)
        if tree is None or not area:
            return False
        true = shapely.union_all(tree.geometries[tree.query(ring, predicate="intersects")])
        return bool(shapely.area(shapely.intersection(ring, true)) >= LEAST_SHARE * area)


def _shape(points: Array, class_name: str) -> Any:
    import shapely

    if class_name not in RING_CLASSES or len(points) < 3:
        return shapely.LineString(points[:, :2])
    polygon = shapely.Polygon(points[:, :2])
    return polygon if polygon.is_valid else polygon.buffer(0)
