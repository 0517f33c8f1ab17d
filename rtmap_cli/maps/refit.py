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
