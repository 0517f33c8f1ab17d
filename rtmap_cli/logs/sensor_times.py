"""Where the vehicle was at a sensor's own time: motion between the frames of a log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, xyyaw_of
from rtmap_cli.logs.log import Frame

Array = NDArray[np.float64]


def step_of(before: Frame, after: Frame) -> Array:
    """(3,) dx, dy, dyaw between neighbouring frames, in the ego frame of ``before``: the odometry
    where it is known, else what the initial poses say."""
    if after.odometry is not None:
        return np.asarray(after.odometry, np.float64)
    return xyyaw_of(invert(before.map_SE3_ego) @ after.map_SE3_ego)


def ego_at(frames: Sequence[Frame], k: int, time_ns: int) -> Array:
    """(4, 4) ego frame at ``time_ns`` → ego frame of ``frames[k]``.

    The vehicle moves on the circle that joins two neighbouring frames at constant speed: after the
    share s of a step (dx, dy, dψ) it has turned by s·dψ and moved along a chord of length
    |d|·sin(s·dψ/2) / sin(dψ/2) that lies (s − 1)·dψ/2 off the whole one. Times before the first and
    after the last frame continue the nearest step; a log of one frame stands still.
    """
    offset = time_ns - frames[k].timestamp_ns
    if offset == 0 or len(frames) < 2:
        return np.eye(4)
    forward = (offset > 0 and k + 1 < len(frames)) or k == 0
    a, b = (k, k + 1) if forward else (k - 1, k)
    dx, dy, dyaw = step_of(frames[a], frames[b])
    share = offset / (frames[b].timestamp_ns - frames[a].timestamp_ns)
    if forward:
        return part_of_step(dx, dy, dyaw, share)
    out: Array = invert(part_of_step(dx, dy, dyaw, 1.0)) @ part_of_step(dx, dy, dyaw, 1 + share)
    return out


def part_of_step(dx: float, dy: float, dyaw: float, share: float) -> Array:
    """(4, 4) the motion after a share of a step (see `ego_at`)."""
    turn = (share - 1) * dyaw / 2
    # The chord of a share of the arc: sin(s dψ / 2) / sin(dψ / 2) of the whole one.
    length = share * np.sinc(share * dyaw / (2 * np.pi)) / np.sinc(dyaw / (2 * np.pi))
    c, s = np.cos(turn), np.sin(turn)
    x, y = length * (c * dx - s * dy), length * (s * dx + c * dy)
    return se3_from_xyyaw(np.asarray(x), np.asarray(y), np.asarray(share * dyaw))
