"""Where a cloud lies on another one, without a guess: standing things seen from above.

Walls, poles and trunks fill several height bins of a cell. For every yaw the two pictures of them
are correlated by FFT; the highest peaks are starts for a matcher.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import se3_from_xyyaw

Array = NDArray[np.float64]

CELL, SIDE = 0.5, 256
"""Size of a cell (m), cells along a side of a picture."""
BIN, MOST = 0.5, 5
"""Height of a bin (m); bins that count at most."""


def standing(xyz: Array) -> Array:
    """(SIDE, SIDE) how many height bins of a cell are filled, less one; the origin is at the
    middle."""
    ij = np.floor(xyz[:, :2] / CELL).astype(np.int64) + SIDE // 2
    inside = ((ij >= 0) & (ij < SIDE)).all(axis=1)
    ij = ij[inside]
    level = np.floor(xyz[inside, 2] / BIN).astype(np.int64) + 512
    cells = np.unique(((ij[:, 0] * SIDE + ij[:, 1]) << 11) | np.clip(level, 0, 1023)) >> 11
    count = np.bincount(cells, minlength=SIDE * SIDE).reshape(SIDE, SIDE)
    return np.asarray(np.clip(count - 1, 0, MOST), np.float64)


def _soft(picture: Array) -> Array:
    """Spread by a cell: a wall a little off still meets itself."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(picture, 1.0, mode="constant"))


def starts(
    target: Array, source: Array, reach: float, yaws: Array, most: int = 6
) -> list[tuple[float, Array]]:
    """Poses (4, 4) source → target in the plane, best first, with their correlation in [0, 1].

    ``target`` and ``source`` (n, 3) about the place where the source is looked for, up to ``reach``
    metres away and under each of ``yaws`` (rad).
    """
    from scipy.fft import irfft2, rfft2

    still = _soft(standing(target))
    wanted = rfft2(still)
    size = np.sqrt((still**2).sum())
    k = int(np.ceil(reach / CELL))
    found: list[tuple[float, Array]] = []
    for yaw in yaws.tolist():
        c, s = np.cos(yaw), np.sin(yaw)
        turned = np.column_stack([source[:, :2] @ np.array([[c, s], [-s, c]]), source[:, 2]])
        other = _soft(standing(turned))
        norm = max(size * float(np.sqrt((other**2).sum())), 1e-9)
        score = irfft2(wanted * np.conj(rfft2(other)), s=still.shape)
        near = np.roll(score, (k, k), (0, 1))[: 2 * k + 1, : 2 * k + 1]
        i, j = np.unravel_index(int(near.argmax()), near.shape)
        x, y = (float(i) - k) * CELL, (float(j) - k) * CELL
        pose = se3_from_xyyaw(np.array(x), np.array(y), np.array(yaw))
        found.append((float(near[i, j]) / norm, pose))
    found.sort(key=lambda f: -f[0])
    return found[:most]
