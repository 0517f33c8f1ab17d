"""A map judged as a whole: precision by cells, coverage, and the honesty of its sigmas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import normals
from rtmap_cli.geometry.poses import se3_from_xyyaw, transform
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.element import VectorMap

Array = NDArray[np.float64]

CELL = 18.0
"""Edge of a cell, metres."""
CELL_SHARE = 0.9
"""A cell counts when this share of it lay in range of some frame."""
REACH = 1.0
"""A line is covered when the other map has one of its class within this distance, metres."""
GATE = 2.0
"""A fused vertex is compared with the nearest true line of its class within this, metres."""


def region_in_range(poses: Array, range_m: Range) -> Any:
    """Union (shapely) of the range boxes of frames with poses (n, 4, 4)."""
    import shapely

    x0, y0, x1, y1 = range_m
    box = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return shapely.union_all(shapely.polygons([transform(pose, box) for pose in poses]))


def cells_in(region: Any, size: float = CELL, share: float = CELL_SHARE) -> Array:
    """(n, 4, 4) poses, heading east, of the centres of the cells that lie in ``region``.

    Edges are at multiples of ``size`` in the map frame.
    """
    import shapely

    if region.is_empty:
        return np.zeros((0, 4, 4))
    x0, y0, x1, y1 = np.floor(np.array(region.bounds) / size).astype(int)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(x0, x1 + 1), np.arange(y0, y1 + 1)))
    boxes = shapely.box(i * size, j * size, (i + 1) * size, (j + 1) * size)
    kept = shapely.area(shapely.intersection(boxes, region)) >= share * size * size
    return se3_from_xyyaw((i[kept] + 0.5) * size, (j[kept] + 0.5) * size, np.zeros(kept.sum()))


def cell_range(size: float = CELL) -> Range:
    """The range of a cell around its centre."""
    return (-size / 2, -size / 2, size / 2, size / 2)


def _lines(vector_map: VectorMap, class_name: str, region: Any) -> Any:
    import shapely

    lines = [shapely.LineString(e.xy) for e in vector_map.of_class(class_name)]
    return shapely.union_all(lines).intersection(region) if lines else shapely.LineString()


@dataclass(frozen=True)
class Coverage:
    """Lengths in metres inside the region that was in range, for one class."""

    true: float
    covered: float
    fused: float
    extra: float

    def as_json(self) -> dict[str, float | None]:
        """Share of the true length found, share of the fused length that is not in the world."""
        return {
            "true_m": self.true,
            "fused_m": self.fused,
            "covered": self.covered / self.true if self.true else None,
            "extra": self.extra / self.fused if self.fused else None,
        }


def coverage(
    fused: VectorMap, truth: VectorMap, region: Any, classes: list[str], reach: float = REACH
) -> dict[str, Coverage]:
    """How much of the true length the map has within ``reach`` (m), and how much it invents."""
    out = {}
    for name in classes:
        have, want = _lines(fused, name, region), _lines(truth, name, region)
        out[name] = Coverage(
            true=want.length,
            covered=want.intersection(have.buffer(reach)).length if have.length else 0.0,
            fused=have.length,
            extra=have.difference(want.buffer(reach)).length if want.length else have.length,
        )
    return out


@dataclass(frozen=True)
class Honesty:
    """Errors across the line of vertices against their stated sigmas.

    ``ratio`` (n,) is |error| / sigma; ``error`` (n,) in metres; ``unmatched`` counts vertices
    without a true line of their class within ``GATE``, ``silent`` those without a covariance.
    """

    ratio: Array
    error: Array
    unmatched: int
    silent: int

    def as_json(self) -> dict[str, Any]:
        """Shares within 1, 2 and 3 sigmas (honest and Gaussian: 0.683, 0.954, 0.997)."""
        n = len(self.ratio)
        return {
            "n": n,
            "within": {str(k): float((self.ratio <= k).mean()) if n else None for k in (1, 2, 3)},
            "rms_error_m": float(np.sqrt((self.error**2).mean())) if n else None,
            "unmatched": self.unmatched,
            "without_covariance": self.silent,
        }


def honesty(fused: VectorMap, truth: VectorMap, region: Any, classes: list[str]) -> Honesty:
    """Compare every vertex inside ``region`` with the nearest true line of its class.

    The error is the part of the way to the foot point that lies across the fused line; its sigma
    is √(nᵀ C n) with the line's unit normal n and the vertex's planar covariance C.
    """
    import shapely

    ratios, errors, unmatched, silent = [np.zeros(0)], [np.zeros(0)], 0, 0
    for name in classes:
        target = shapely.union_all([shapely.LineString(e.xy) for e in truth.of_class(name)])
        for element in fused.of_class(name):
            places = shapely.points(element.xy)
            kept = shapely.intersects(places, region)
            if element.covariance is None:
                silent += int(kept.sum())
                continue
            xx, xy, yy = element.covariance[:, :3].T
            n = normals(element.points)
            variance = n[:, 0] ** 2 * xx + 2 * n[:, 0] * n[:, 1] * xy + n[:, 1] ** 2 * yy
            known = kept & (variance > 0)
            silent += int((kept & ~known).sum())
            near = known & (shapely.distance(places, target) <= GATE)
            unmatched += int((known & ~near).sum())
            if near.any():
                ways = shapely.get_coordinates(shapely.shortest_line(places[near], target))
                way = np.diff(ways.reshape(-1, 2, 2), axis=1)[:, 0]
                error = np.abs((way * n[near]).sum(axis=1))
                errors.append(error)
                ratios.append(error / np.sqrt(variance[near]))
    return Honesty(np.concatenate(ratios), np.concatenate(errors), unmatched, silent)
