"""Paint and curbs of a point cloud: intensity over that of the asphalt, steps of the ground."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.logs.cloud import CloudFolder, Trajectory, Voxels

Array = NDArray[np.float64]

ASIDE = 12.0
"""Metres from the trajectory beyond which nothing is looked for."""
LOW = 0.6
"""Metres by which the ground may differ from that under the vehicle."""
CELL = 0.1
"""Metres of the cells between which the ground may step."""
STEPS = (0.05, 0.30)
"""Metres of a step that is a curb: less is slope and noise, more is a wall or a vehicle."""
ACROSS = (1, 2, 3)
"""Cells between the low and the high side of a step: where both were hit."""
UNDER = 2.0
"""Metres from the trajectory that are asphalt for certain."""


def paint_and_curbs(cloud: CloudFolder) -> tuple[Array, NDArray[np.int8], Array]:
    """Places (n, 2), codes (n,) 1 paint, 2 curb, weights (n,) of a cloud near its trajectory."""
    trajectory = cloud.trajectory()
    tree = cKDTree(trajectory.pose[:, :2, 3])
    level = _contrast(cloud, trajectory, tree)
    xy, kind = [np.zeros((0, 2))], [np.zeros(0, np.int8)]
    for i, j in cloud.tiles():
        voxels = cloud.read_tile(i, j)
        low = _ground(voxels, trajectory, tree)
        place, bright = voxels.xyz[low], voxels.intensity[low] > level
        for code, found in ((1, place[bright, :2]), (2, _steps(place))):
            xy.append(found)
            kind.append(np.full(len(found), code, np.int8))
    return np.concatenate(xy), np.concatenate(kind), np.ones(sum(len(p) for p in xy))


def _ground(voxels: Voxels, trajectory: Trajectory, tree: cKDTree) -> NDArray[np.int64]:
    """Indices of the voxels near the trajectory and about as high as the road there."""
    if not len(voxels):
        return np.zeros(0, np.int64)
    distance, at = tree.query(voxels.xyz[:, :2], distance_upper_bound=ASIDE)
    near = np.flatnonzero(np.isfinite(distance))
    road = trajectory.ground_z[at[near]]
    road = np.where(np.isfinite(road), road, trajectory.pose[at[near], 2, 3])
    out: NDArray[np.int64] = near[np.abs(voxels.xyz[near, 2] - road) < LOW]
    return out


def _contrast(cloud: CloudFolder, trajectory: Trajectory, tree: cKDTree) -> float:
    """The intensity above which the road is painted: half way from asphalt to the brightest
    hundredth of what lies beside it at its height."""
    asphalt, road = [np.zeros(0)], [np.zeros(0)]
    for i, j in cloud.tiles()[::3]:
        voxels = cloud.read_tile(i, j)
        low = _ground(voxels, trajectory, tree)
        distance = tree.query(voxels.xyz[low, :2])[0] if len(low) else np.zeros(0)
        asphalt.append(voxels.intensity[low][distance < UNDER])
        road.append(voxels.intensity[low][distance < 2 * UNDER])
    under, beside = np.concatenate(asphalt), np.concatenate(road)
    if not len(under):
        return np.inf
    middle = float(np.median(under))
    return (middle + float(np.quantile(beside, 0.99))) / 2


def _steps(xyz: Array) -> Array:
    """(n, 2) places where the ground steps: between the lowest points of cells near each other."""
    if len(xyz) < 2:
        return np.zeros((0, 2))
    cell = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / CELL).astype(np.int64)
    rows, columns = cell.max(axis=0) + 1 + max(ACROSS)
    flat = cell[:, 0] * columns + cell[:, 1]
    order = np.lexsort((xyz[:, 2], flat))
    first = order[np.concatenate([[True], np.diff(flat[order]) > 0])]
    place = np.full(rows * columns, -1, np.int64)
    place[flat[first]] = first
    found = [np.zeros((0, 2))]
    taken = np.zeros(len(xyz), bool)
    for n, (dx, dy) in product(ACROSS, ((1, 0), (0, 1), (-1, 0), (0, -1))):
        # From low to high; the nearest pair that steps is the curb.
        shift = n * (dx * columns + dy)
        to = flat[first] + shift
        inside = (to >= 0) & (to < len(place))
        a, b = first[inside], place[to[inside]]
        a, b = a[b >= 0], b[b >= 0]
        rise = xyz[b, 2] - xyz[a, 2]
        step = (rise > STEPS[0]) & (rise < STEPS[1]) & ~taken[a]
        found.append((xyz[a[step], :2] + xyz[b[step], :2]) / 2)
        taken[a[step]] = True
    return np.concatenate(found)
