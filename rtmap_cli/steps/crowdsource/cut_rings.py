"""Closed elements that the range cuts: where they lie is told by the part that was in view.

Of an element at the border of the range the drives that err towards the vehicle see all, the
others a part. Taking whole detections alone would pull every such element towards the road that
was driven.
"""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.rings import align, open_ring, polygon

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

BORDER = 0.7
"""Outline so near (m) to the border of the range is where it was cut, not where the element is."""
ROUNDS = 3
"""Where the range cuts the element depends on where that lies: so often it is worked out."""
LEAST = 0.35
"""Share of the element's outline that must have been in view."""


def cut_offsets(
    rings: Array, windows: Array, reference: Array, gate: Array
) -> tuple[Int, Array, Array]:
    """How far detections ``rings`` (n, 80, 2), which their ranges ``windows`` (n, 4, 2) cut, lie
    from an outline (80, 2): the rows (k,) of those that may be the element, offsets (k, 80, 2) of
    the points of the outline, and the share (k,) of it that was in view.

    A detection may be the element when its middle is at most ``gate`` (n,), m, from that of the
    part of the outline in its range. What was not in view has the mean offset of what was.
    """
    kept, offsets, shares = [], [], []
    for k, (ring, window) in enumerate(zip(rings, windows, strict=True)):
        found = _offset(ring, window, reference, float(gate[k]))
        if found is not None:
            kept.append(k)
            offsets.append(found[0])
            shares.append(found[1])
    rows = np.array(kept, np.int64)
    return rows, np.array(offsets).reshape(-1, *reference.shape), np.array(shares, np.float64)


def _offset(
    ring: Array, window: Array, reference: Array, gate: float
) -> tuple[Array, float] | None:
    """Offsets of the outline and the share in view by one detection; None where it says nothing."""
    view = shapely.polygons(window)
    mean, offset, share = np.zeros(2), reference, 0.0
    for k in range(ROUNDS):
        moved = reference + mean
        part = _part(moved, view)
        if part is None or (k == 0 and np.hypot(*(ring - part).mean(axis=0)) > gate):
            return None
        fitted = align(ring, part)
        both = _inside(part, window) & _inside(fitted, window)
        point = np.hypot(*np.moveaxis(part[both, None] - moved, -1, 0)).argmin(axis=1)
        own, row = np.unique(point, return_inverse=True)
        share = len(own) / len(reference)
        if share < LEAST:
            return None
        gap = (fitted - part)[both]
        step = np.stack([np.bincount(row, g) for g in gap.T], axis=-1) / np.bincount(row)[:, None]
        offset = np.tile(mean + step.mean(axis=0), (len(reference), 1))
        offset[own] = mean + step
        mean = mean + step.mean(axis=0)
    return offset, share


def _part(outline: Array, view: shapely.Polygon) -> Array | None:
    """(80, 2) the outline of the largest part of an outline in view; None where there is none."""
    part = shapely.intersection(polygon(outline), view)
    parts = [g for g in shapely.get_parts(part) if g.geom_type == "Polygon" and g.area > 0]
    if not parts:
        return None
    return open_ring(shapely.get_coordinates(max(parts, key=lambda g: g.area).exterior))


def _inside(points: Array, window: Array) -> Mask:
    """(n,) points (n, 2) farther than ``BORDER`` inside a counter-clockwise rectangle (4, 2)."""
    side = np.roll(window, -1, axis=0) - window
    side /= np.hypot(*side.T)[:, None]
    d = points[:, None] - window
    left = side[:, 0] * d[..., 1] - side[:, 1] * d[..., 0]
    return np.asarray((left > BORDER).all(axis=1))
