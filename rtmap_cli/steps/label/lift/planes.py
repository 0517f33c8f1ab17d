"""The height of the ground at many places at once: a robust plane through the points around each.

RANSAC (Fischler and Bolles 1981): planes through three of the points are tried and the one that
most points agree with is fitted again, by weighted least squares, to those. Where a good share of
the points agrees with a lower plane (the road below a curb, or under a vehicle), that one counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TRIALS = 16
STEEPEST = 0.05
"""The ground is not steeper than the road driven nearest by more than this (m per m)."""
LOWER, LOWER_SHARE = 0.05, 0.2
"""A plane this much lower (m) is taken when so many of the points lie on it."""
FEWEST = 6
FIRST_GATE, GATE_SCATTERS, GATES = 0.045, 3.0, (0.02, 0.045)
"""Points within this of a plane lie on it (m): at first; then so many times their scatter, between
these, and less than half of a curb is high, so that no plane lies on both sides of one."""
TRUST = 0.01
"""Points of one sweep err together: a height is not known better (m)."""
WIDTH = 1.0
"""Points so far away (m) count about half."""
LEVELS = np.array([0.05, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8])
"""Shares of the points below level planes that are tried as well."""
ROWS = 4096
CACHED = 512


@dataclass
class Heights:
    """Heights ``z`` (n,) and standard deviations ``sigma`` (n,), NaN where nothing tells, and the
    number of points (n,) on the plane."""

    z: Array
    sigma: Array
    support: NDArray[np.int64]


def heights(near: Array, reference: Array, slope: Array, seed: int = 0) -> Heights:
    """The ground at n places from the points around them.

    ``near`` (n, k, 3): points about each place in x and y (m), heights in the map frame, NaN rows
    where there are fewer; ``reference`` (n,) a rough height and ``slope`` (n, 2) a rough
    slope, m per m.
    """
    rng = np.random.default_rng([seed, 17])
    n = len(near)
    out = Heights(np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, np.int64))
    gate = FIRST_GATE
    for first in range(0, n, ROWS):
        part = slice(first, first + ROWS)
        points = near[part].copy()
        points[..., 2] -= reference[part, None]
        points[..., 2] -= (slope[part, None] * points[..., :2]).sum(axis=-1)
        if first == 0:
            scatter = _scatter(points, _planes(points, gate, rng), gate)
            gate = float(np.clip(GATE_SCATTERS * scatter, *GATES))
        z, sigma, support = _fitted(points, _planes(points, gate, rng), gate)
        out.z[part], out.sigma[part], out.support[part] = z + reference[part], sigma, support
    return out


def _planes(points: Array, gate: float, rng: np.random.Generator) -> Array:
    """(m, 3) the plane z = a x + b y + c that counts at each place; NaN where there is none."""
    known = np.isfinite(points[..., 2])
    count = known.sum(axis=1)
    m = len(points)
    # Known points come first; some of them, anew for every place.
    pick = (rng.random((m, TRIALS, 3)) * np.maximum(count, 1)[:, None, None]).astype(np.int64)
    p = points[np.arange(m)[:, None, None], pick]
    u, v = p[:, :, 1] - p[:, :, 0], p[:, :, 2] - p[:, :, 0]
    det = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (u[..., 2] * v[..., 1] - v[..., 2] * u[..., 1]) / det
        b = (u[..., 0] * v[..., 2] - v[..., 0] * u[..., 2]) / det
        c = p[:, :, 0, 2] - a * p[:, :, 0, 0] - b * p[:, :, 0, 1]
    out = np.full((m, 3), np.nan)
    # Few places at a time: what they need stays in the processor's cache.
    for first in range(0, m, CACHED):
        rows = slice(first, first + CACHED)
        trial = np.stack([a[rows], b[rows], c[rows]])
        out[rows] = _voted(points[rows], known[rows], count[rows], trial, gate)
    return out


def _voted(
    points: Array, known: NDArray[np.bool_], count: NDArray[np.int64], trial: Array, gate: float
) -> Array:
    """(m, 3) of the ``trial`` planes (3, m, t) and of level ones the plane that counts."""
    x, y, z = (np.where(known, points[..., k], np.nan) for k in range(3))
    m = len(z)
    tilted = np.isfinite(trial).all(axis=0) & (np.hypot(trial[0], trial[1]) <= STEEPEST)
    votes = np.zeros((m, TRIALS + len(LEVELS)), np.int64)
    level = _quantiles(z, count, LEVELS)
    near = np.empty((len(LEVELS), *z.shape), bool)
    for k in range(len(LEVELS)):
        near[k] = np.abs(z - level[:, k, None]) < gate
        votes[:, TRIALS + k] = near[k].sum(axis=1)
    for k in range(TRIALS):
        plane = np.where(tilted[:, k], trial[:, :, k], np.nan)
        votes[:, k] = _on(x, y, z, plane, gate).sum(axis=1)
    best = votes.argmax(axis=1)
    rows = np.arange(m)
    zero = np.zeros_like(level)
    every = np.concatenate([trial, np.stack([zero, zero, level])], axis=2)
    winner = every[:, rows, best]
    taken = _on(x, y, z, winner, gate)
    # Level planes below it, by the points that it does not explain.
    own = np.stack([(n & ~taken).sum(axis=1) for n in near], axis=-1)
    under = level < winner[2][:, None] - LOWER
    own = np.where(under & (own >= np.maximum(LOWER_SHARE * count[:, None], FEWEST)), own, -1)
    chosen = np.where(own.max(axis=1) > 0, TRIALS + own.argmax(axis=1), best)
    out = every[:, rows, chosen]
    out[:, (votes[rows, chosen] < FEWEST) | (count < FEWEST)] = np.nan
    return np.asarray(out.T)


def _on(x: Array, y: Array, z: Array, plane: Array, gate: float) -> NDArray[np.bool_]:
    """(m, k) which points lie within ``gate`` of a plane (3, m) each."""
    r = plane[0][:, None] * x
    r += plane[1][:, None] * y
    np.subtract(z, r, out=r)
    r -= plane[2][:, None]
    np.abs(r, out=r)
    return np.asarray(r < gate)


def _quantiles(z: Array, count: NDArray[np.int64], shares: Array) -> Array:
    """(m, q) quantiles of the known values of each row (m, k), NaN where there are none: what
    np.nanquantile gives, whose loop over rows takes most of a lift's time."""
    ordered = np.sort(z, axis=1)
    at = shares * np.maximum(count - 1, 0)[:, None]
    low = np.floor(at).astype(np.int64)
    high = np.minimum(low + 1, np.maximum(count - 1, 0)[:, None])
    a = np.take_along_axis(ordered, low, axis=1)
    b = np.take_along_axis(ordered, high, axis=1)
    return np.asarray(a + (b - a) * (at - low))


def _residual(points: Array, plane: Array) -> Array:
    """(m, k) heights of points over a plane each."""
    on = plane[:, None, 0] * points[..., 0] + plane[:, None, 1] * points[..., 1]
    return np.asarray(points[..., 2] - on - plane[:, None, 2])


def _scatter(points: Array, plane: Array, gate: float) -> float:
    """Standard deviation of points about their planes: the lower quartile over the patches, since
    curbs and bushes scatter too."""
    r = np.abs(_residual(points, plane))
    r = np.where(r < 2 * gate, r, np.nan)
    enough = np.isfinite(r).sum(axis=1) >= FEWEST
    if not enough.any():
        return gate / 3
    return float(1.4826 * np.percentile(np.nanmedian(r[enough], axis=1), 25))


def _fitted(points: Array, plane: Array, gate: float) -> tuple[Array, Array, NDArray[np.int64]]:
    """Least squares over the points on each plane: height, its standard deviation, points."""
    with np.errstate(invalid="ignore"):
        on = np.abs(_residual(points, plane)) < gate
    filled = np.where(on[..., None], points, 0.0)
    far = (filled[..., 0] ** 2 + filled[..., 1] ** 2) / WIDTH**2
    w = np.where(on, np.exp(-0.5 * far), 0.0)
    design = np.concatenate([filled[..., :2], np.ones((*w.shape, 1))], axis=-1)
    normal = np.einsum("mk,mki,mkj->mij", w, design, design)
    # A slope of about STEEPEST / 2 is likely: where points lie in a row it is not free.
    normal[:, range(2), range(2)] += (gate / STEEPEST) ** 2
    right = np.einsum("mk,mki,mk->mi", w, design, filled[..., 2])
    support = on.sum(axis=1)
    good = np.isfinite(plane).all(axis=1) & (support >= FEWEST)
    z, sigma = np.full(len(points), np.nan), np.full(len(points), np.nan)
    if good.any():
        solution = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
        r = _residual(filled[good], solution)
        spread = (w[good] * r**2).sum(axis=1) / np.maximum(w[good].sum(axis=1), 1e-9)
        inverse = np.linalg.inv(normal[good])[:, 2, 2]
        z[good] = solution[:, 2]
        # What the gate cut off: for a normal distribution, to a few per cent.
        whole = spread / (1.0 - 1.1 * spread / gate**2) ** 2
        sigma[good] = np.sqrt(whole * inverse + TRUST**2)
    return z, sigma, support
