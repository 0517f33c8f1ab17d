"""Where a line lies, from the correlated frames of many drives: generalised least squares.

A network errs alike as long as it sees the same place: all frames of a drive, and in part all
drives, are off to one side, and by how much goes with the sigma that the network states. Averages
do not take such an error away, but frames of different sigma tell it from the line itself. The
offset (m, to the left of a station) that frame f of drive d sees with standard deviation σ_f is

    o_f = x + p_d + σ_f (b + b_d + u_f + v_f)

with x where the line is, p_d the error of the pose, b (``place_share`` of the variance) common to
all drives at the place, b_d (``drive_share``) to one drive, u_f (``memory_share``) a first-order
process along the way that is driven, and v_f its own. Divided by σ_f it is a regression on 1/σ_f
(the line) and on 1 (the error that is shared). Per drive and station a Kalman filter whitens
u_f + v_f and leaves a 2×2 information matrix of (x, b); the drives' matrices add up, after p_d and
b_d have been integrated out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.refit import FusionModel
from rtmap_cli.maps.stations import Feet, Samples, Stations

Array = NDArray[np.float64]
Int = NDArray[np.int64]

COVERED = 0.05
"""What covers less than this share of the surroundings of a station says nothing about it."""
LEFT = 0.8
"""Of the spread around a line that much is left around the fitted one, within the gate."""
FAR = 20.0
"""Added to logarithms so that none is zero."""
ROUNDS = 2
"""Times that the weights of outliers are found anew."""


@dataclass(frozen=True)
class Sightings:
    """What frames saw of stations, sorted by drive, station and frame (n rows).

    ``sequence`` (n,) the station; ``way`` (n,) metres driven so far; ``offset`` (n, m), metres, of
    one or more coordinates that share their ``sigma`` (n,), m; ``cover`` (n,) in (0, 1], how much
    of the station's surroundings was seen; ``score`` (n,); ``pose`` (n,) variance of the pose's
    part, m².
    """

    sequence: Int
    way: Array
    offset: Array
    sigma: Array
    cover: Array
    score: Array
    pose: Array

    def __len__(self) -> int:
        return len(self.sequence)


def sightings(
    stations: Stations,
    smooth: Any,
    samples: Samples,
    feet: Feet,
    pose_variance: Array,
    way: Array,
) -> Sightings:
    """The sightings of one drive; ``smooth`` from ``stations.smoother``, ``pose_variance`` (k,)
    of the feet, ``way`` (frames,) metres driven until each frame."""
    from scipy.sparse import coo_matrix

    n = len(stations)
    if not len(feet):
        nothing = np.zeros(0)
        return Sightings(np.zeros(0, np.int64), nothing, nothing[:, None], *(nothing,) * 4)
    sample = feet.sample
    normal = stations.normal[feet.station]
    variance = np.einsum("ni,nij,nj->n", normal, samples.covariance[sample], normal)
    log_sigma = 0.5 * np.log(np.maximum(variance, 1e-4))
    weight = np.maximum(samples.spacing[sample], 1e-3)
    frames, column = np.unique(samples.frame[sample], return_inverse=True)
    shape = n, len(frames)

    def around(real: Array, imaginary: Array) -> Any:
        # Two sums in one product; the real part is never zero, else it would be dropped.
        matrix = coo_matrix((weight * (real + 1j * imaginary), (feet.station, column)), shape)
        out = (smooth @ matrix.tocsr()).tocsr()
        out.sort_indices()
        return out

    offsets = around(np.ones(len(feet)), feet.offset)
    others = around(log_sigma + FAR, samples.score[sample])
    row = np.repeat(np.arange(n), np.diff(offsets.indptr))
    cover = offsets.data.real / (smooth @ stations.spacing)[row]
    ok = np.flatnonzero(cover > COVERED)
    row, total = row[ok], offsets.data.real[ok]
    pose = smooth @ np.bincount(feet.station, weight * pose_variance, n)
    pose /= np.maximum(smooth @ np.bincount(feet.station, weight, n), 1e-9)
    return Sightings(
        row,
        way[frames[offsets.indices[ok]]],
        (offsets.data.imag[ok] / total)[:, None],
        np.exp(others.data.real[ok] / total - FAR),
        np.minimum(cover[ok], 1.0),
        others.data.imag[ok] / total,
        pose[row],
    )


def along(stations: Stations, width: float) -> Any:
    """Sparse (n, n) Gaussian weights between stations of a line by the way along it, ``width`` (m)
    one sigma; those where the line has turned by more than 60° do not count."""
    from scipy.sparse import coo_matrix

    n = len(stations)
    index = np.arange(n)
    pairs = [(index, index, np.ones(n))]
    for step in range(1, n):
        i, j = index[:-step], index[step:]
        far = np.where(stations.line[i] == stations.line[j], stations.s[j] - stations.s[i], np.inf)
        near = far <= 3 * width
        if not near.any():
            break
        near &= (stations.tangent[i] * stations.tangent[j]).sum(axis=1) > 0.5
        weight = np.exp(-0.5 * (far[near] / width) ** 2)
        pairs += [(i[near], j[near], weight), (j[near], i[near], weight)]
    row, column, weight = (np.concatenate(p) for p in zip(*pairs, strict=True))
    return coo_matrix((weight, (row, column)), shape=(n, n)).tocsr()


def consensus(
    drives: Sequence[Sightings], n: int, model: FusionModel, smooth: Any = None
) -> tuple[Array, Array]:
    """Offsets (n, m) and their variance (n,) at the stations over the drives; NaN and inf where
    unseen. ``smooth`` over ``model.shared_m``: the shared error hardly changes over such a way, so
    that neighbouring stations tell of it, too."""
    if not sum(len(d) for d in drives):
        return np.full((n, 1), np.nan), np.full(n, np.inf)
    every, number = _together(drives, n)
    station, sequence = number % n, every.sequence
    at = station[sequence]
    pose = np.bincount(sequence, every.pose) / np.bincount(sequence) + model.floor**2
    own = model.own_share / (every.cover * np.clip(every.score, 0.05, 1.0))
    scale, robust, doubt = 1.0, np.ones(len(every)), np.ones(len(number))
    for _ in range(ROUNDS):
        noise = own + 1.0 / robust**2 - 1.0
        matrix, right = _drive_information(every, scale, noise, len(number), model)
        if smooth is not None:
            matrix, right = _pooled(matrix, right, number, smooth, model)
        spread = np.zeros((len(number), 2, 2))
        spread[:, 0, 0], spread[:, 1, 1] = pose / doubt, model.drive_share / doubt
        matrix, right = _integrated(matrix, right, spread)
        place, covariance = _combined(matrix, right, station, n, model)
        left = right[:, 0] - np.einsum("ki,kim->km", matrix[:, 0], place[station])
        z = _size(left) / np.sqrt(np.maximum(matrix[:, 0, 0], 1e-12))
        doubt = np.minimum(1.0, model.huber / np.maximum(z, 1e-9))
        ratio = _size(every.offset - place[at, 0]) / every.sigma
        measured = float(np.clip(np.median(ratio) / (0.674 * LEFT), 0.5, 2.0))
        scale = measured ** (len(number) / (len(number) + 100.0))
        robust = np.minimum(1.0, 1.5 * model.huber / np.maximum(ratio / scale, 1e-9))
    count = np.bincount(station, minlength=n)
    seen = count > 0
    # Drives that disagree by more than they should know less than they say (Birge's ratio).
    birge = np.maximum(np.bincount(station, z**2, n) / np.maximum(count - 1, 1), 1.0)
    birge[count < 2] = 1.0
    variance = np.where(seen, covariance[:, 0, 0] * birge + model.floor**2, np.inf)
    return np.where(seen[:, None], place[:, 0], np.nan), variance


def _together(drives: Sequence[Sightings], n: int) -> tuple[Sightings, Int]:
    """The sightings of all drives with ``sequence`` an index into what is returned beside them:
    drive · n + station of each sequence."""
    names = ("way", "offset", "sigma", "cover", "score", "pose")
    number, sequence = np.unique(
        np.concatenate([d.sequence + k * n for k, d in enumerate(drives)]), return_inverse=True
    )
    rows = [np.concatenate([getattr(d, name) for d in drives]) for name in names]
    return Sightings(sequence, *rows), number


def _size(values: Array) -> Array:
    """(n,) root mean square of the rows (n, m)."""
    return np.asarray(np.sqrt((values**2).mean(axis=1)))


def _drive_information(
    every: Sightings, scale: float, noise: Array, count: int, model: FusionModel
) -> tuple[Array, Array]:
    """Information matrices (count, 2, 2) of line and shared error, and right sides (count, 2, m),
    of every drive at every station: innovations of a Kalman filter over its frames, weighted."""
    start = np.searchsorted(every.sequence, np.arange(count))
    length = np.diff(np.append(start, len(every)))
    # Sequences by length: those that go on are always the first ones.
    order = np.argsort(-length, kind="stable")
    first, length = start[order], length[order]
    sigma = every.sigma * scale
    rows = np.concatenate([[1.0 / sigma, np.ones(len(sigma))], every.offset.T / sigma])
    state, spread = np.zeros((len(rows), count)), np.full(count, model.memory_share)
    matrix, right = np.zeros((3, count)), np.zeros((2, len(rows) - 2, count))
    for k in range(int(length[0])):
        m = int(np.searchsorted(-length, -k))
        row = first[:m] + k
        if k:
            kept = np.exp(-np.abs(every.way[row] - every.way[row - 1]) / model.memory_m)
            state[:, :m] *= kept
            spread[:m] = kept**2 * spread[:m] + (1 - kept**2) * model.memory_share
        variance = spread[:m] + noise[row]
        innovation = rows[:, row] - state[:, :m]
        (h, one), z = innovation[:2] / variance, innovation[2:]
        matrix[:, :m] += np.stack([h * innovation[0], h * innovation[1], one * innovation[1]])
        right[0, :, :m] += h * z
        right[1, :, :m] += one * z
        gain = spread[:m] / variance
        state[:, :m] += gain * innovation
        spread[:m] *= 1 - gain
    back = np.empty(count, np.int64)
    back[order] = np.arange(count)
    hh, h1, oo = matrix[:, back]
    full = np.stack([np.stack([hh, h1], -1), np.stack([h1, oo], -1)], -2)
    return full, np.moveaxis(right[..., back], -1, 0)


def _pooled(
    matrix: Array, right: Array, number: Int, smooth: Any, model: FusionModel
) -> tuple[Array, Array]:
    """The same with what neighbouring stations tell of a drive's shared error, whatever line they
    are on: a Schur complement each. Their sightings overlap by ``model.width``."""
    n = smooth.shape[0]
    line = np.maximum(matrix[:, 0, 0], 1e-12)
    mixed = matrix[:, 0, 1]
    shared = matrix[:, 1, 1] - mixed**2 / line
    left = right[:, 1] - (mixed / line)[:, None] * right[:, 0]
    values = np.column_stack([np.ones(len(number)), shared, left])
    drive, station = np.divmod(number, n)
    for k in np.unique(drive):
        mine = drive == k
        full = np.zeros((n, values.shape[1]))
        full[station[mine]] = values[mine]
        values[mine] = (smooth @ full)[station[mine]]
    gain = max(model.shared_m / (np.sqrt(2) * model.width), 1.0) / values[:, :1]
    values = values[:, 1:] * gain
    matrix, right = matrix.copy(), right.copy()
    matrix[:, 1, 1] = mixed**2 / line + values[:, 0]
    right[:, 1] = (mixed / line)[:, None] * right[:, 0] + values[:, 1:]
    return matrix, right


def _integrated(matrix: Array, right: Array, spread: Array) -> tuple[Array, Array]:
    """What remains of (k, 2, 2) and (k, 2, m) when a drive's own errors are integrated out:
    (A⁻¹ + D)⁻¹ = A (1 + D A)⁻¹, which holds where one frame leaves A singular, too."""
    inverse = np.linalg.inv(np.eye(2) + spread @ matrix)
    return matrix @ inverse, np.einsum("kji,kjm->kim", inverse, right)


def _combined(
    matrix: Array, right: Array, station: Int, n: int, model: FusionModel
) -> tuple[Array, Array]:
    """Line and shared error (n, 2, m) of the stations with their covariance (n, 2, 2)."""
    total = np.zeros((n, 2, 2))
    np.add.at(total, station, matrix)
    total += np.diag([1e-4, 1.0 / max(model.place_share, 1e-9)])
    sums = np.zeros((n, *right.shape[1:]))
    np.add.at(sums, station, right)
    covariance: Any = np.linalg.inv(total)
    return np.asarray(covariance @ sums), np.asarray(covariance)
