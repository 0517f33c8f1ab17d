"""Closed outlines (crossings): alignment vertex by vertex, means, overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample

Array = NDArray[np.float64]

RING_POINTS = 80
"""Points at equal arc length that a ring is compared with."""


def signed_area(ring: Array) -> float:
    """Area of a ring (closed or not), positive when counter-clockwise."""
    x, y = ring[:, 0] - ring[0, 0], ring[:, 1] - ring[0, 1]
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


def open_ring(ring: Array, count: int = RING_POINTS) -> Array:
    """(count, 2) points at equal arc length, counter-clockwise, the first one not repeated."""
    p = np.asarray(ring, np.float64)[:, :2]
    if np.abs(p[0] - p[-1]).max() > 1e-9:
        p = np.concatenate([p, p[:1]])
    out = resample(p, count + 1)[:-1]
    return out if signed_area(out) >= 0 else out[::-1]


def open_rings(rings: Array, count: int = RING_POINTS) -> Array:
    """(n, count, 2): ``open_ring`` of rings (n, v, 2) at once."""
    p = np.asarray(rings, np.float64)[..., :2]
    if not len(p):
        return np.zeros((0, count, 2))
    # A closing segment of no length changes nothing.
    p = np.concatenate([p, p[:, :1]], axis=1)
    step = np.hypot(*np.moveaxis(np.diff(p, axis=1), -1, 0))
    s = np.concatenate([np.zeros((len(p), 1)), np.cumsum(step, axis=1)], axis=1)
    at = s[:, -1:] * (np.arange(count) / count)
    segment = (s[:, None, 1:-1] <= at[..., None]).sum(axis=-1)
    row = np.arange(len(p))[:, None]
    share = (at - s[row, segment]) / np.maximum(step[row, segment], 1e-12)
    out = p[row, segment] + share[..., None] * (p[row, segment + 1] - p[row, segment])
    x, y = out[..., 0] - out[:, :1, 0], out[..., 1] - out[:, :1, 1]
    area = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    turned = area < 0
    out[turned] = out[turned, ::-1]
    return out


def align(rings: Array, reference: Array) -> Array:
    """``rings`` (..., n, 2), each with its start moved to where it fits ``reference`` (n, 2) best.

    The cyclic shift of least squared distance, by circular correlation (FFT); all rings run
    counter-clockwise.
    """
    a = (rings - rings.mean(axis=-2, keepdims=True)) @ np.array([1, 1j])
    b = (reference - reference.mean(axis=0)) @ np.array([1, 1j])
    match = np.fft.ifft(np.fft.fft(a, axis=-1) * np.conj(np.fft.fft(b)), axis=-1).real
    n = rings.shape[-2]
    index = (np.arange(n) + match.argmax(axis=-1)[..., None]) % n
    return np.take_along_axis(rings, index[..., None], axis=-2)


def close(ring: Array) -> Array:
    """The ring with its first vertex repeated at the end."""
    return np.concatenate([ring, ring[:1]])


def simplified(ring: Array, tolerance: float) -> Array:
    """A closed ring without the vertices that lie within ``tolerance`` (m) of the outline."""
    import shapely

    thin = shapely.simplify(shapely.polygons(close(ring)), tolerance)
    if thin.is_empty or thin.geom_type != "Polygon" or len(thin.exterior.coords) < 4:
        return close(ring)
    return np.asarray(thin.exterior.coords)


def overlap(a: object, b: object) -> float:
    """Intersection over union of two shapely polygons."""
    import shapely

    union = shapely.area(shapely.union(a, b))
    return float(shapely.area(shapely.intersection(a, b)) / union) if union > 0 else 0.0


def inside(a: object, b: object) -> float:
    """Share of the area of shapely polygon ``a`` that lies in ``b``."""
    import shapely

    area = shapely.area(a)
    return float(shapely.area(shapely.intersection(a, b)) / area) if area > 0 else 0.0


def polygon(ring: Array) -> object:
    """A valid shapely polygon of a ring, which may cross itself slightly."""
    import shapely

    out = shapely.polygons(ring[:, :2] if len(ring) > 3 else close(ring[:, :2]))
    return out if out.is_valid else shapely.buffer(out, 0)


def polygons(rings: Array) -> NDArray[np.object_]:
    """(n,) valid shapely polygons of rings (n, k, 2)."""
    import shapely

    out = np.atleast_1d(shapely.polygons(rings)) if len(rings) else np.zeros(0, object)
    bad = ~shapely.is_valid(out)
    out[bad] = shapely.buffer(out[bad], 0)
    return np.asarray(out, object)
