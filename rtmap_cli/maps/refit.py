"""Eq. 5 of the paper made right for lines: where a line lies, from all drives and the prior.

Vertices slide along their line, so an observation constrains a line only across itself: each
detection gives signed offsets to the left of the stations of the line it was assigned to. Per
drive the offsets of all frames become one estimate per station (frames are correlated: one
vote); over the drives a robust weighted mean; then each vertex solves the 2×2 system

    (Σ_k g_k w_k n_k n_kᵀ + C⁻¹) δ = Σ_k g_k w_k n_k o_k

with the offsets o_k and information w_k of the stations around it, unit normals n_k, weights g_k
that sum to one, and the prior's covariance C. On a straight line δ is along the normal; at a
corner two directions meet and the vertex is fixed in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.stations import Stations

Array = NDArray[np.float64]

UNKNOWN_SIGMA = 0.25
"""Standard deviation (m, each axis) of a prior vertex that states none."""


@dataclass(frozen=True)
class FusionModel:
    """Parameters of the fusion; lengths in metres, shares of the predicted variance.

    ``width``: sigma of the smoothing along the line. Of what a detection is off ``place_share`` is
    common to all drives at a place, ``drive_share`` to the frames of a drive, ``memory_share``
    fades over ``memory_m`` of driving, ``own_share`` is its own (`consensus`); what is common
    changes over ``shared_m`` along a line. ``floor``: repeatability, of a drive and of the whole,
    no sigma is below it; ``huber``: offsets beyond that many sigmas
    lose weight; ``common``: variance (m²) per axis of the place that all drives share, where they
    were aligned to each other and to nothing else.
    """

    width: float = 2.0
    drive_share: float = 0.4
    place_share: float = 0.2
    memory_share: float = 0.3
    memory_m: float = 15.0
    shared_m: float = 8.0
    own_share: float = 0.1
    floor: float = 0.05
    huber: float = 1.5
    common: float = 0.0


def solve_vertices(
    vertices: Array,
    chain: NDArray[np.int64],
    prior: Array,
    stations: Stations,
    offset: Array,
    variance: Array,
    width: float,
) -> tuple[Array, Array]:
    """Displacements (n, 2) and posterior covariances (n, 2, 2) of vertices (n, 2).

    ``chain`` (n,) says whose stations move a vertex, ``prior`` (n, 2, 2) is its covariance before.
    The system of the module's docstring, one 2×2 per vertex, solved at once.
    """
    from scipy.spatial import cKDTree

    n = len(vertices)
    near = cKDTree(vertices).sparse_distance_matrix(
        cKDTree(stations.xy), 2.5 * width, output_type="ndarray"
    )
    i, j = near["i"].astype(np.int64), near["j"].astype(np.int64)
    same = chain[i] == stations.chain[j]
    i, j, d = i[same], j[same], near["v"][same]
    kernel = np.exp(-0.5 * (d / width) ** 2)
    total = np.bincount(i, kernel, n)
    kernel = kernel / np.maximum(total[i], 1e-12)
    normal = stations.normal[j]
    # Two directions share the weights at a corner; each is known as if it stood alone.
    known = np.isfinite(variance[j])
    weight = np.where(known, kernel / np.where(known, variance[j], 1.0), 0.0)
    o = np.where(known, np.nan_to_num(offset[j]), 0.0)
    matrix = np.zeros((n, 2, 2))
    for a in range(2):
        for b in range(2):
            matrix[:, a, b] = np.bincount(i, weight * normal[:, a] * normal[:, b], n)
    right = np.stack([np.bincount(i, weight * normal[:, a] * o, n) for a in range(2)], axis=-1)
    posterior = np.linalg.inv(matrix + np.linalg.inv(prior))
    return np.einsum("nij,nj->ni", posterior, right), posterior


def planar(covariance: Array | None, n: int, unknown: float = UNKNOWN_SIGMA) -> Array:
    """(n, 2, 2) of a covariance (n, 4: xx, xy, yy, zz); unknown ones become ``unknown``² · I."""
    out = np.tile(np.eye(2) * unknown**2, (n, 1, 1))
    if covariance is None:
        return out
    known = np.isfinite(covariance[:, :3]).all(axis=1)
    full = covariance[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    # A singular covariance would make its vertex immovable and its inverse infinite.
    out[known] = full[known] + np.eye(2) * 1e-6
    return out


def columns(planar_covariance: Array, heights: Array | None) -> Array:
    """(n, 4) xx, xy, yy, zz from (n, 2, 2) and the zz column of what was before."""
    zz = np.full(len(planar_covariance), np.nan) if heights is None else heights[:, 3]
    flat = planar_covariance.reshape(-1, 4)[:, [0, 1, 3]]
    return np.column_stack([flat, zz])


def at_nodes(vertices: Array, move: Array, seen: NDArray[np.bool_]) -> Array:
    """(n, 2) displacements, the same for all vertices at one place: lines that met in a vertex meet
    again. Where one of them is not ``seen`` (n,) and stays, they all do."""
    key = np.round(vertices * 1000).astype(np.int64)
    _, node, number = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    node = node.ravel()
    mean = np.stack([np.bincount(node, move[:, k]) / number for k in (0, 1)], axis=-1)
    mean[np.bincount(node, ~seen) > 0] = 0.0
    return np.where((number > 1)[node, None], mean[node], move)
