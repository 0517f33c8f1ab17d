"""Detections of a drive put onto the map that is known around them.

Much of what a detection is off is the same for all that a drive sees around a place: the pose, the
light, the network there. Where lines of the map are seen beside each other a little to one side,
so is what is new between them. The displacement is a smooth field over the map (metres, two
components), measured across the known lines and taken out of all detections of a class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.assignment import assign_once, sigma_scale
from rtmap_cli.maps.stations import Samples, Stations

Array = NDArray[np.float64]
Int = NDArray[np.int64]

WIDTH = 12.0
"""Sigma (m) of the kernel around a place."""
NODE = 8.0
"""Distance (m) of the places where the field is solved; between them it is interpolated."""
CELL = 5.0
"""What a drive saw of a line within such a stretch (m) of it is one vote."""
OWN = 0.4
"""Share of a detection's variance that is its own: no other line near it has that offset."""
MAP_SIGMA = 0.1
"""Standard deviation (m) of the map."""
SMALLEST = 0.1
"""Standard deviation (m) of a detection at least."""
HUBER = 1.5


@dataclass(frozen=True)
class Votes:
    """Mean ``offset`` (n,) to the left of a line at ``xy`` (n, 2) with unit ``normal`` (n, 2), and
    its ``variance`` (n,), m²; ``shared`` (n,) variance of the field itself there."""

    xy: Array
    normal: Array
    offset: Array
    variance: Array
    shared: Array


def registered(samples: Samples, known: Stations) -> Samples:
    """The samples with the displacement that known lines around them show taken out."""
    if not len(known) or not len(samples):
        return samples
    votes = _votes(samples, known)
    if not len(votes.offset):
        return samples
    size = np.maximum(sigma_scale(known, samples) * samples.across_sigma, SMALLEST)
    moved = samples.xy - field_at(votes, samples.xy) * size[:, None]
    return replace(samples, xy=moved, last=[])


def _votes(samples: Samples, known: Stations) -> Votes:
    """One vote per stretch of a line."""
    feet, _ = assign_once(known, samples)
    sigma = np.maximum(sigma_scale(known, samples) * samples.across_sigma, SMALLEST)[feet.sample]
    along = np.floor(known.s[feet.station] / CELL).astype(np.int64)
    line = known.line[feet.station]
    _, key = np.unique(line * (int(along.max(initial=0)) + 1) + along, return_inverse=True)
    number = np.bincount(key)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(key, values) / number)

    normal = np.stack([mean(known.normal[feet.station, k]) for k in (0, 1)], axis=-1)
    normal /= np.maximum(np.hypot(*normal.T), 1e-9)[:, None]
    return Votes(
        np.stack([mean(samples.xy[feet.sample, k]) for k in (0, 1)], axis=-1),
        normal,
        mean(feet.offset / sigma),
        OWN + MAP_SIGMA**2 * mean(sigma**-2),
        np.full(len(number), 1 - OWN),
    )


def field_at(votes: Votes, xy: Array, width: float = WIDTH) -> Array:
    """(n, 2) displacement at ``xy``: local least squares at nodes with a zero-mean prior, bilinear
    between them; ``width``: sigma (m) of the kernel around a node."""
    from scipy.spatial import cKDTree

    side = width * NODE / WIDTH
    corner = np.floor(xy / side).astype(np.int64)
    share = xy / side - corner
    low = corner.min(axis=0)
    rows = int(np.ptp(corner[:, 1])) + 2
    keys = [(corner[:, 0] - low[0] + i) * rows + corner[:, 1] - low[1] + j
            for i in (0, 1) for j in (0, 1)]  # fmt: skip
    nodes, at = np.unique(np.concatenate(keys), return_inverse=True)
    places = (np.stack(np.divmod(nodes, rows), axis=-1) + low) * side
    near = cKDTree(places).sparse_distance_matrix(
        cKDTree(votes.xy), 2.5 * width, output_type="coo_matrix"
    )
    value = _solved(votes, near.row, near.col, np.exp(-0.5 * (near.data / width) ** 2), len(nodes))
    x, y = share.T
    weight = np.concatenate([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y])
    parts = (weight[:, None] * value[at]).reshape(4, len(xy), 2)
    return np.asarray(parts.sum(axis=0))


def _solved(votes: Votes, node: Int, vote: Int, kernel: Array, count: int) -> Array:
    """(count, 2) field at nodes from pairs of a node and a vote, twice with Huber weights."""
    normal, offset = votes.normal[vote], votes.offset[vote]
    total = np.maximum(np.bincount(node, kernel, count), 1e-9)
    shared = np.bincount(node, kernel * votes.shared[vote], count) / total
    weight = kernel / votes.variance[vote]
    scale = np.sqrt(votes.variance + votes.shared)[vote]
    out = np.zeros((count, 2))
    for _ in range(3):
        left = np.abs(offset - (normal * out[node]).sum(axis=1)) / scale
        w = weight * np.minimum(1.0, HUBER / np.maximum(left, 1e-9))
        xx, xy, yy, bx, by = (
            np.bincount(node, w * v, count)
            for v in (
                normal[:, 0] ** 2,
                normal[:, 0] * normal[:, 1],
                normal[:, 1] ** 2,
                normal[:, 0] * offset,
                normal[:, 1] * offset,
            )
        )
        ridge = 1.0 / np.maximum(shared, 1e-6)
        a, b = xx + ridge, yy + ridge
        det = a * b - xy**2
        out = np.stack([(b * bx - xy * by) / det, (a * by - xy * bx) / det], axis=-1)
    return out
