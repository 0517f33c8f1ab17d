"""Loop closures: places that the drive came back to, verified by matching the clouds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import invert, transform
from rtmap_cli.steps.label.cloud.degenerate import spectrum
from rtmap_cli.steps.label.cloud.match import best_start, make_matcher
from rtmap_cli.steps.label.cloud.matcher import Match
from rtmap_cli.steps.label.cloud.place import starts

Array = NDArray[np.float64]

NEAR, AWAY = 12.0, 60.0
"""Keyframes of one place: so near each other (m), so far apart along the drive (m)."""
EVERY = 12.0
"""Metres of the drive between two loops."""
AROUND = 4
"""Keyframes on either side that make the cloud of a place."""
SHARE, WORSE = 0.55, 1.5
"""A loop is believed when so many points meet a partner and the cost is at most so many times the
usual one of the odometry."""
YAWS = np.radians(np.arange(-20.0, 20.1, 4.0))
DOUBT = 3.0


@dataclass(frozen=True)
class Loop:
    """Keyframes ``i`` < ``j`` of one place; ``measured`` (4, 4) takes j to i."""

    i: int
    j: int
    measured: Array
    information: Array
    match: Match


def candidates(pose: Array, sigma: Array) -> list[tuple[int, int]]:
    """Pairs i < j of keyframes (n, 4, 4) that may see one place, the nearest i for every `EVERY`
    metres of j. ``sigma`` (n,) how well places are known (m) widens the search."""
    from scipy.spatial import cKDTree

    xyz = pose[:, :3, 3]
    s = arc_length(xyz[:, :2])
    tree = cKDTree(xyz[:, :2])
    out: list[tuple[int, int]] = []
    last = -np.inf
    for j in range(len(pose)):
        if s[j] - last < EVERY:
            continue
        reach = NEAR + min(DOUBT * float(sigma[j]), 2 * NEAR)
        near = np.array(tree.query_ball_point(xyz[j, :2], reach), np.int64)
        near = near[s[near] < s[j] - AWAY]
        if len(near):
            i = int(near[np.linalg.norm(xyz[near] - xyz[j], axis=1).argmin()])
            out.append((i, j))
            last = s[j]
    return out


def verify(
    pair: tuple[int, int],
    pose: Array,
    cloud: Callable[[int], Array],
    method: str,
    leaf: float,
    usual: float,
) -> Loop | None:
    """The loop of a pair of keyframes, None when their clouds do not say so.

    ``cloud`` gives the points (n, 3) of a keyframe in its ego frame. Where the pose is too far off
    for the matcher, places that look alike from above are tried.
    """
    i, j = pair
    matcher = make_matcher(method, leaf)
    base = invert(pose[i])
    first, stop = max(i - AROUND, 0), min(i + AROUND + 1, len(pose), j)
    for k in range(first, stop):
        matcher.insert(matcher.prepare(cloud(k)), base @ pose[k])
    points = cloud(j)
    source = matcher.prepare(points)
    guess = base @ pose[j]
    match = matcher.match(source, guess)
    if not believed(match, usual):
        here = transform(invert(guess), matcher.local_points())
        found = [guess @ p for _, p in starts(here, points, 2 * NEAR, YAWS, 3)]
        match = best_start(matcher, source, found)
        if not believed(match, usual):
            return None
    if spectrum(match.information).weak.any():
        return None
    return Loop(i, j, match.pose, match.information, match)


def believed(match: Match, usual: float) -> bool:
    """True when a match is about as good as those of the odometry."""
    return match.share >= SHARE and match.cost <= WORSE * usual
