"""Make a map less exact than the world: a smooth error with a known sigma."""

from __future__ import annotations

import itertools
import zlib

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.maps.element import VectorMap

Array = NDArray[np.float64]

WAVES = 128


def smooth_error(xy: Array, sigma: float, correlation: float, rng: np.random.Generator) -> Array:
    """(n, 2) Gaussian displacement at (n, 2) places: standard deviation ``sigma`` per axis and
    correlation exp(-d² / 2 correlation²), by random Fourier features (Rahimi & Recht 2007)."""
    frequency = rng.normal(0.0, 1.0 / correlation, (WAVES, 2))
    phase = rng.uniform(0.0, 2 * np.pi, (WAVES, 2))
    wave = np.cos((xy @ frequency.T)[..., None] + phase)
    return sigma * np.sqrt(2.0 / WAVES) * wave.sum(axis=1)


def degrade_map(
    vector_map: VectorMap,
    sigma: float,
    seed: int,
    correlation: float = 12.0,
    max_step: float = 5.0,
) -> VectorMap:
    """The map with a smooth error of ``sigma`` metres per axis, stated as its covariance.

    One error field per class, so pieces that share an end still do. Vertices are added so that
    they are at most ``max_step`` metres apart; ids, attributes and heights stay.
    """
    out = []
    # Large coordinates would cost the waves their precision.
    origin = np.floor(vector_map.bounds()[:2])
    for element in vector_map:
        # zlib.crc32 is stable between runs, hash() is not.
        rng = np.random.default_rng([seed, zlib.crc32(element.class_name.encode())])
        points = _densify(element.points, max_step)
        points[:, :2] += smooth_error(points[:, :2] - origin, sigma, correlation, rng)
        covariance = np.full((len(points), 4), np.nan)
        covariance[:, [0, 2]] = sigma**2
        covariance[:, 1] = 0.0
        out.append(element.with_points(points, covariance))
    return VectorMap(out, vector_map.crs)


def _densify(points: Array, max_step: float) -> Array:
    """All vertices kept, more added between those farther apart than ``max_step``."""
    s = arc_length(points)
    extra = [
        np.linspace(a, b, int(np.ceil((b - a) / max_step)) + 1)[1:-1]
        for a, b in itertools.pairwise(s)
        if b - a > max_step
    ]
    at = np.sort(np.concatenate([s, *extra]))
    return np.stack([np.interp(at, s, points[:, k]) for k in range(points.shape[1])], axis=-1)
