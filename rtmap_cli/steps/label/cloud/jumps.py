"""GNSS that jumps: fixes that disagree with the motion between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIGMAS = 5.0
DRIFT = 0.02
"""What the odometry may be off (m per m)."""
SLACK = 0.1


def consistent(local: Array, gnss: Array, sigma: Array) -> NDArray[np.bool_]:
    """(n,) fixes that agree with the odometry and with each other.

    ``local`` and ``gnss`` (n, 4, 4) poses, ``sigma`` (n, 3): x, y (m), yaw (rad). Where the step
    between two fixes is not the odometry's, a stretch ends. The longest stretch is believed, and
    then, going away from it, every stretch that follows from the last believed fix.
    """
    n = len(local)
    if n < 3:
        return np.ones(n, bool)
    step = np.arange(n - 1)
    ends = np.flatnonzero(~_agree(local, gnss, sigma, step, step + 1)) + 1
    first = np.concatenate([[0], ends])
    last = np.concatenate([ends, [n]]) - 1
    out = np.zeros(n, bool)
    seed = int((last - first).argmax())
    out[first[seed] : last[seed] + 1] = True
    for order, edge, mine in (
        (range(seed + 1, len(first)), int(last[seed]), first),
        (range(seed - 1, -1, -1), int(first[seed]), last),
    ):
        believed = edge
        for k in order:
            a, b = np.array([believed]), np.array([int(mine[k])])
            if _agree(local, gnss, sigma, a, b)[0]:
                out[first[k] : last[k] + 1] = True
                believed = int(last[k] if mine is first else first[k])
    return out


def _agree(
    local: Array, gnss: Array, sigma: Array, a: NDArray[np.int64], b: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """True where fixes ``b`` lie from fixes ``a`` as the odometry says, in the plane."""
    turn = gnss[a, :3, :3] @ np.swapaxes(local[a, :3, :3], 1, 2)
    moved = (turn @ (local[b, :3, 3] - local[a, :3, 3])[..., None])[..., 0]
    off = np.linalg.norm((gnss[b, :3, 3] - gnss[a, :3, 3] - moved)[:, :2], axis=1)
    way = np.linalg.norm(moved, axis=1)
    place = np.hypot(sigma[a, :2].max(axis=1), sigma[b, :2].max(axis=1))
    room = SIGMAS * place + (3 * sigma[a, 2] + DRIFT) * way + SLACK
    return np.asarray(off < room)
