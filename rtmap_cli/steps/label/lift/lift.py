"""Every vertex of a map gets the height of the ground under it, with a standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.cloud import CloudFolder, Trajectory
from rtmap_cli.maps.element import Element
from rtmap_cli.steps.label.lift.levels import chosen, offers, samples
from rtmap_cli.steps.label.lift.planes import heights

Array = NDArray[np.float64]

NEIGHBOURS, RADIUS = 48, 2.5
"""Points that make a patch, and how far they may be (m)."""
CELL = np.array([0.25, 0.25, 0.08])
"""One point is taken of each such cell (m): a patch of neighbours then is wider than curbs are
high, and places seen often do not outvote the others."""
FLATTENED = 0.3
"""Heights count so much in the distance of neighbours: a road is flat, a bridge is not near."""
BAND, BAND_SHARE, BAND_MOST = 0.6, 0.12, 2.0
"""Ground lies so close to the height of the nearest driven road (m): at it, per metre beside it,
and at most, which is half of the room under a bridge."""


FADE = 10.0
"""The slope under the vehicle is continued so far beside it (m)."""
GRID = 1 << 24
"""Cells of a tile that fit a table."""
KEPT = 6_000_000
"""Points of tiles that stay in memory."""


@dataclass
class Lifted:
    """Heights ``z`` (n,) and ``sigma`` (n,) of all vertices, NaN where unknown."""

    z: Array
    sigma: Array


def lift(elements: Sequence[Element], cloud: CloudFolder) -> tuple[list[Element], Lifted]:
    """The elements with heights from the cloud; what is not known stays NaN.

    The height's variance holds the scatter of the plane and the trajectory's own variance, in
    height and, with the distance, in attitude.
    """
    reference, slope, beside, variance = _references(elements, cloud)
    xy = np.concatenate([e.xy for e in elements])
    z, sigma = np.full(len(xy), np.nan), np.full(len(xy), np.nan)
    known = np.isfinite(reference)
    tile = np.floor(xy / cloud.tile).astype(np.int64)
    rows = np.flatnonzero(known)
    order = rows[np.lexsort((tile[rows, 1], tile[rows, 0]))]
    split = np.flatnonzero((np.diff(tile[order], axis=0) != 0).any(axis=1)) + 1
    near = np.full((len(rows), NEIGHBOURS, 3), np.nan, np.float32)
    done = 0
    groups = np.split(order, split) if len(order) else []
    source = Near(cloud, xy[rows]) if len(rows) else None
    for group in groups:
        assert source is not None
        i, j = tile[group[0]].tolist()
        points = source.about((i, j), xy[group])
        near[done : done + len(group)] = _patches(
            points, xy[group], reference[group], beside[group]
        )
        done += len(group)
    if done:
        found = heights(near.astype(np.float64), reference[order], slope[order])
        z[order] = found.z
        sigma[order] = np.sqrt(found.sigma**2 + variance[order])
    out, first = [], 0
    for element in elements:
        rows_of = slice(first, first + len(element.points))
        first = rows_of.stop
        out.append(_with_heights(element, z[rows_of], sigma[rows_of]))
    return out, Lifted(z, sigma)


def _with_heights(element: Element, z: Array, sigma: Array) -> Element:
    """The element at these heights; what it said of x and y stays."""
    points = np.column_stack([element.xy, z])
    covariance = np.full((len(points), 4), np.nan)
    if element.covariance is not None:
        covariance[:, :3] = element.covariance[:, :3]
    covariance[:, 3] = sigma**2
    return element.with_points(points, covariance)


def _references(
    elements: Sequence[Element], cloud: CloudFolder
) -> tuple[Array, Array, Array, Array]:
    """For every vertex a rough height by the road driven nearest (NaN: none) and its slope (n, 2),
    metres beside it, and the variance of that height."""
    from scipy.spatial import cKDTree

    path = cloud.trajectory()
    places, headings = samples(path.pose[:, :3, 3], path.ground_z)
    xy = np.concatenate([e.xy for e in elements])
    heading = np.concatenate([_headings(e.xy) for e in elements])
    offered, cost, from_ = offers(xy, heading, places, headings)
    pick = np.empty(len(xy), np.int64)
    first = 0
    for element in elements:
        rows = slice(first, first + len(element.points))
        first = rows.stop
        pick[rows] = chosen(xy[rows], offered[rows], cost[rows])
    every = np.arange(len(xy))
    reference, source = offered[every, pick], from_[every, pick]
    if not len(places):
        return reference, np.zeros((len(xy), 2)), np.full(len(xy), np.inf), np.zeros(len(xy))
    offset = xy - places[source, :2]
    slope = _slopes(path)[cKDTree(path.pose[:, :3, 3]).query(places[source])[1]]
    # A slope is not continued for ever: streets beside a hill's are flatter.
    away = np.hypot(*offset.T)
    reference = reference + (slope * offset).sum(axis=1) * np.minimum(1.0, FADE / (away + 1e-9))
    nearest = cKDTree(path.pose[:, :2, 3]).query(xy)[1]
    spread = path.covariance[nearest]
    lean = np.maximum(spread[:, 3, 3], spread[:, 4, 4]) * away**2
    return reference, slope, away, np.maximum(spread[:, 2, 2] + lean, 0.0)


def _slopes(path: Trajectory) -> Array:
    """(n, 2) slope of the ground under the vehicle as its body leans, m per m east and north: the
    mean of the sweeps around, since a body pitches on its springs."""
    from scipy.ndimage import uniform_filter1d

    up = path.pose[:, :3, 2]
    slope = -up[:, :2] / np.maximum(up[:, 2:], 0.5)
    return np.asarray(uniform_filter1d(slope, min(7, len(slope)), axis=0, mode="nearest"))


def _headings(xy: Array) -> Array:
    """(n,) headings of a line's vertices."""
    return np.asarray(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))


class Near:
    """The points of a cloud that lie near vertices, tile by tile; the last tiles are kept."""

    def __init__(self, cloud: CloudFolder, xy: Array) -> None:
        self.cloud, self._there = cloud, set(cloud.tiles())
        cells = np.unique(np.floor(xy / RADIUS).astype(np.int64), axis=0)
        around = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)])
        self._cells = np.unique((cells[:, None] + around).reshape(-1, 2), axis=0)
        self._kept: dict[tuple[int, int], Array] = {}

    def about(self, tile: tuple[int, int], xy: Array) -> Array:
        """(m, 3) points within reach of vertices (n, 2) of one tile."""
        low, high = xy.min(axis=0) - RADIUS, xy.max(axis=0) + RADIUS
        first = np.floor(low / self.cloud.tile).astype(int)
        last = np.floor(high / self.cloud.tile).astype(int)
        parts = [np.zeros((0, 3))]
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                points = self._tile((i, j))
                if (i, j) != tile:
                    flat = points[:, :2]
                    points = points[((flat >= low) & (flat <= high)).all(axis=1)]
                parts.append(points)
        return np.concatenate(parts)

    def _tile(self, tile: tuple[int, int]) -> Array:
        if tile not in self._there:
            return np.zeros((0, 3))
        if tile not in self._kept:
            while sum(len(p) for p in self._kept.values()) > KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[tile] = self._read(tile)
        return self._kept[tile]

    def _read(self, tile: tuple[int, int]) -> Array:
        xyz = self.cloud.read_xyz(*tile)
        zero = np.floor(np.array(tile) * self.cloud.tile / RADIUS).astype(np.int64)
        side = int(np.ceil(self.cloud.tile / RADIUS)) + 2
        wanted = np.zeros((side, side), bool)
        inner = self._cells - zero
        inner = inner[((inner >= 0) & (inner < side)).all(axis=1)]
        wanted[inner[:, 0], inner[:, 1]] = True
        # Voxels hold the mean of their points: none lies outside its tile.
        i = (xyz[:, 0] / RADIUS).astype(np.int64) - zero[0]
        j = (xyz[:, 1] / RADIUS).astype(np.int64) - zero[1]
        inside = (i >= 0) & (i < side) & (j >= 0) & (j < side)
        if not inside.all():
            xyz, i, j = xyz[inside], i[inside], j[inside]
        return _one_each(xyz[wanted[i, j]])


def _one_each(xyz: Array) -> Array:
    """(m, 3) one point of every `CELL`: a voxel's mean is known well enough."""
    if not len(xyz):
        return xyz
    k = ((xyz - xyz.min(axis=0)) / CELL).astype(np.int64)
    size = k.max(axis=0) + 1
    key = (k[:, 2] * size[0] + k[:, 0]) * size[1] + k[:, 1]
    if int(size.prod()) > GRID:
        return np.asarray(xyz[np.unique(key, return_index=True)[1]])
    slot = np.full(int(size.prod()), -1, np.int32)
    slot[key] = np.arange(len(xyz), dtype=np.int32)
    return np.asarray(xyz[slot[slot >= 0]])


def _patches(points: Array, xy: Array, reference: Array, beside: Array) -> NDArray[np.float32]:
    """(n, NEIGHBOURS, 3) points about each vertex, known ones first, NaN after them."""
    from scipy.spatial import cKDTree

    out = np.full((len(xy), NEIGHBOURS, 3), np.nan, np.float32)
    if len(points) < 3:
        return out
    flat = points * (1.0, 1.0, FLATTENED)
    tree = cKDTree(flat, leafsize=32, balanced_tree=False, compact_nodes=False)
    centre = np.column_stack([xy, FLATTENED * reference])
    count = min(NEIGHBOURS, len(points))
    away, at = tree.query(centre, count, distance_upper_bound=RADIUS)
    found: NDArray[np.bool_] = np.asarray(np.isfinite(away), bool)
    at = np.where(found, at, 0)
    near = points[at] - np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)[:, None]
    band = np.minimum(BAND + BAND_SHARE * beside, BAND_MOST)
    found &= np.asarray(np.abs(near[..., 2] - reference[:, None]) < band[:, None])
    near[~found] = np.nan
    order = np.argsort(~found, axis=1, kind="stable")
    out[:, :count] = np.take_along_axis(near, order[..., None], axis=1)
    return out
