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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.stations import Feet, Samples, Stations

Array = NDArray[np.float64]


SHARPNESS = 1.5
"""Within a drive a detection weighs score / variance ** SHARPNESS. Its error is mostly what all
frames share, in proportion to its sigma: averages do not take that away, sharper detections do."""


@dataclass(frozen=True)
class FusionModel:
    """Parameters of the fusion; lengths in metres, shares of the predicted variance.

    ``width``: sigma of the smoothing along the line; ``drive_share``: part of a detection's
    variance that all frames of a drive share (measured where two drives or more overlap);
    ``place_share``: part that every drive shares at a place and that never averages out;
    ``floor``: repeatability, no sigma is below it; ``huber``: offsets beyond that many sigmas
    lose weight; ``common``: variance (m²) per axis of the place that all drives share, where they
    were aligned to each other and to nothing else.
    """

    width: float = 2.0
    drive_share: float = 0.55
    place_share: float = 0.16
    floor: float = 0.04
    huber: float = 1.5
    common: float = 0.0


@dataclass(frozen=True)
class DriveOffsets:
    """One drive at n stations: ``offset`` (m, NaN where unseen), mean ``variance`` of a single
    detection, ``frames`` an effective number of them, ``pose`` variance from the poses (m²)."""

    offset: Array
    variance: Array
    frames: Array
    pose: Array


def drive_offsets(
    stations: Stations,
    smooth: Any,
    samples: Samples,
    feet: Feet,
    pose_variance: Array,
    model: FusionModel,
) -> DriveOffsets:
    """Mean offset of one drive at every station; ``smooth`` from ``stations.smoother``.

    ``pose_variance`` (k,) belongs to the feet. Detections weigh score / σ³ (``SHARPNESS``).
    """
    n = len(stations)
    nothing = np.full(n, np.nan)
    if not len(feet):
        return DriveOffsets(nothing, nothing, np.zeros(n), nothing)
    normal = stations.normal[feet.station]
    variance = np.einsum("ni,nij,nj->n", normal, samples.covariance[feet.sample], normal)
    variance = np.maximum(variance, 1e-4)
    score = np.maximum(samples.score[feet.sample], 0.02)
    weight = samples.spacing[feet.sample] * score / variance**SHARPNESS

    def total(values: Array) -> Array:
        out: Array = smooth @ np.bincount(feet.station, values, n)
        return out

    w = total(weight)
    ok = w > 0.02 * (np.median(w[w > 0]) if (w > 0).any() else 1.0)
    safe = np.where(ok, w, 1.0)
    frames = _distinct_frames(samples.frame[feet.sample], feet.station, weight, smooth, n)
    return DriveOffsets(
        np.where(ok, total(weight * feet.offset) / safe, np.nan),
        np.where(ok, total(weight * variance) / safe, np.nan),
        np.where(ok, frames, 0.0),
        np.where(ok, total(weight * pose_variance) / safe, np.nan),
    )


def _distinct_frames(frame: Any, station: Any, weight: Array, smooth: Any, n: int) -> Array:
    """Effective number of frames behind each station: (Σ w)² / Σ w² over frames nearby."""
    count = int(frame.max()) + 1
    key, inverse = np.unique(station * count + frame, return_inverse=True)
    per = np.bincount(inverse, weight)
    first = smooth @ np.bincount(key // count, per, n)
    second = smooth @ np.bincount(key // count, per**2, n)
    # Stations side by side see the same frames: their number is the mean over them, not the sum.
    around = smooth @ np.bincount(np.unique(key // count), minlength=n).astype(np.float64)
    out: Array = first**2 / np.maximum(second, 1e-30) / np.maximum(around, 1.0)
    return np.maximum(out, 1.0)


def _drive_variance(drives: Sequence[DriveOffsets], share: float, model: FusionModel) -> Array:
    rows = []
    for d in drives:
        single = d.variance * (share + (1 - share) / np.maximum(d.frames, 1.0))
        rows.append(single + d.pose + model.floor**2)
    return np.stack(rows)


def measured_share(drives: Sequence[DriveOffsets], model: FusionModel) -> float:
    """Part of the predicted variance that a whole drive shares, from how drives disagree.

    Robust (median) ratio of the squared differences of drives from their mean to the predicted
    single-detection variance, less what the poses explain; shrunk to ``model.drive_share`` while
    little was measured.
    """
    if len(drives) < 2:
        return model.drive_share
    offset = np.stack([d.offset for d in drives])
    count = np.isfinite(offset).sum(axis=0)
    ok = count >= 2
    if ok.sum() < 20:
        return model.drive_share
    with np.errstate(invalid="ignore"):
        mean = np.nanmean(offset[:, ok], axis=0)
        squared = (offset[:, ok] - mean) ** 2 * (count[ok] / (count[ok] - 1))
        variance = np.stack([d.variance for d in drives])[:, ok]
        pose = np.stack([d.pose for d in drives])[:, ok]
        ratio = (squared / 0.455 - pose - model.floor**2) / variance
    seen = np.isfinite(ratio)
    # The median of a squared unit Gaussian is 0.455; stations are correlated over some 20 m.
    measured = float(np.clip(np.median(ratio[seen]), 0.1, 1.5))
    trust = seen.sum() / (seen.sum() + 400.0)
    return trust * measured + (1 - trust) * model.drive_share


def combine(
    drives: Sequence[DriveOffsets], share: float, model: FusionModel
) -> tuple[Array, Array]:
    """Offset and variance (n,) over the drives: weighted mean with Huber weights, no prior.

    NaN offset and infinite variance where no drive saw anything.
    """
    offset = np.stack([d.offset for d in drives])
    seen = np.isfinite(offset)
    variance = np.where(seen, _drive_variance(drives, share, model), np.inf)
    value = np.where(seen, offset, 0.0)
    weight = 1.0 / variance
    robust = np.ones_like(weight)
    for _ in range(4):
        total = (weight * robust).sum(axis=0)
        mean = (weight * robust * value).sum(axis=0) / np.where(total > 0, total, 1.0)
        z = np.abs(value - mean) / np.sqrt(np.where(seen, variance, 1.0))
        robust = np.minimum(1.0, model.huber / np.maximum(z, 1e-9))
    information = (robust / variance).sum(axis=0)
    some = information > 0
    single = np.where(seen, np.stack([d.variance for d in drives]), 0.0)
    total = np.where(some, (weight * robust).sum(axis=0), 1.0)
    common = model.place_share * (weight * robust * single).sum(axis=0) / total + model.floor**2
    out = np.where(some, 1.0 / np.where(some, information, 1.0) + common, np.inf)
    return np.where(some, mean, np.nan), out


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
