"""From the local frame of a drive to the map: graph of odometry, loops and GNSS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, wrap_angle, yaw_of
from rtmap_cli.steps.label.cloud.graph import FIXED, REJECTED, Edges, Fixes, Solved, solve
from rtmap_cli.steps.label.cloud.jumps import consistent
from rtmap_cli.steps.label.cloud.loops import Loop, candidates, verify

if TYPE_CHECKING:
    from rtmap_cli.steps.label.cloud.track import Settings, Track

Array = NDArray[np.float64]

OPTIMISM = 10.0
"""Errors of a match are so many times (variance) those that its residuals alone would leave:
points of one surface err together."""
FLOOR = np.array([1e-4, 1e-4, 1e-4, 0.004, 0.004, 0.004])
"""Smallest standard deviations of a match (rad, m)."""
EXPECTED = np.array([0.02, 0.02, 0.02, 0.05, 0.05, 0.05])
EXPECTED_SHARE = 0.05
"""Where no match tells: what the expected motion is off (rad, m), and more per metre of it."""
ATTITUDE = np.radians(0.5)
"""GNSS attitudes are not better than this: roll and pitch have no stated sigma."""
GNSS_LENGTH = 50.0
"""Metres over which errors of GNSS are alike, before the drive shows it."""


@dataclass
class Reference:
    """Keyframes in the map frame: ``pose`` (k, 4, 4), ``covariance`` (k, 6, 6; translation, then
    rotation, map axes); how many loops were found and not believed, fixes rejected."""

    pose: Array
    covariance: Array
    loops: int
    loops_rejected: int
    rejected: int
    georeferenced: bool


def place_in_map(
    track: Track,
    rows: NDArray[np.int64],
    cloud: Callable[[int], Array],
    settings: Settings,
    leaf: float,
    known: bool,
) -> Reference:
    """Solve the graph of the keyframes ``rows`` of a track: without loops, then with them.

    ``cloud`` gives the points of a keyframe by its place in ``rows``; ``known``: GNSS is used.
    """
    local = track.local[rows]
    gnss = np.stack([track.frames[k].map_SE3_ego for k in rows])
    sigma = np.stack([track.frames[k].sigma for k in rows])
    chain = _chain(track, rows)
    steady = np.flatnonzero(consistent(local, gnss, sigma)) if known else np.zeros(0, np.int64)
    start = _anchored(local, gnss, steady)
    fixes = _fixes(start, gnss, sigma, steady, GNSS_LENGTH) if known else None
    if len(rows) == 1:
        return Reference(start, np.zeros((1, 6, 6)), 0, 0, 0, known)
    anchor = FIXED
    if np.isfinite(sigma[0]).all():
        anchor = (float(sigma[0, :2].max()), max(float(sigma[0, 2]), ATTITUDE))
    solved = solve(start, Edges.of(chain), fixes, anchor)
    loops: list[Loop] = []
    if settings.loops:
        usual = float(np.median(track.cost[track.cost > 0])) if (track.cost > 0).any() else 1.0
        spread = np.sqrt(np.trace(solved.covariance[:, 3:, 3:], axis1=1, axis2=2))
        for pair in candidates(solved.pose, spread):
            found = verify(pair, solved.pose, cloud, settings.method, leaf, usual)
            loops += [found] if found else []
    rejected_loops = 0
    rows_of = chain + [(p.i, p.j, p.measured, _believable(p.information), True) for p in loops]
    edges = Edges.of(rows_of)
    if known and fixes is not None:
        length = _alike(solved, start)
        fixes = _fixes(start, gnss, sigma, steady, length)
    if loops or known:
        solved = solve(solved.pose, edges, fixes, anchor)
        rejected_loops = int((solved.edge_weight[edges.doubted] < REJECTED).sum())
    rejected = 0
    if known:
        rejected = len(rows) - len(steady) + int((solved.fix_weight < REJECTED).sum())
    covariance = _in_map(solved)
    if known:
        covariance[:, :3, :3] += np.eye(3) * _hidden_bias(solved, sigma[steady]) ** 2
    kept = len(loops) - rejected_loops
    return Reference(solved.pose, covariance, kept, rejected_loops, rejected, known)


def _believable(information: Array) -> Array:
    """The information of a match as a graph may use it: errors that points share, a floor."""
    covariance = np.linalg.pinv(information / OPTIMISM, hermitian=True) + np.diag(FLOOR**2)
    return np.asarray(np.linalg.inv(covariance))


def _chain(track: Track, rows: NDArray[np.int64]) -> list[tuple[int, int, Array, Array, bool]]:
    """Edges from keyframe to keyframe; along what a match does not know the expected motion
    counts, as far as it can be trusted."""
    out = []
    for k in range(1, len(rows)):
        measured = invert(track.local[rows[k - 1]]) @ track.local[rows[k]]
        step = float(np.linalg.norm(measured[:3, 3]))
        spread = EXPECTED + EXPECTED_SHARE * step * np.array([0.1, 0.1, 0.1, 1, 1, 1])
        both = track.information[rows[k]] / OPTIMISM + np.diag(spread**-2)
        covariance = np.linalg.inv(both) + np.diag(FLOOR**2)
        out.append((k - 1, k, measured, np.linalg.inv(covariance), False))
    return out


def _anchored(local: Array, gnss: Array, steady: NDArray[np.int64]) -> Array:
    """The local poses laid over the map: on the first pose of the log, or by the medians of yaw
    and place over the ``steady`` fixes."""
    if not len(steady):
        return np.asarray(gnss[0] @ invert(local[0]) @ local)
    upright = gnss[steady[0]] @ invert(local[steady[0]])
    turn = wrap_angle(yaw_of(gnss[steady]) - yaw_of(upright @ local[steady]))
    middle = np.arctan2(np.median(np.sin(turn)), np.median(np.cos(turn)))
    zero = np.array(0.0)
    start = se3_from_xyyaw(zero, zero, np.asarray(middle)) @ upright @ local
    start[:, :3, 3] += np.median(gnss[steady, :3, 3] - start[steady, :3, 3], axis=0)
    return np.asarray(start)


def _fixes(
    start: Array, gnss: Array, sigma: Array, steady: NDArray[np.int64], length: float
) -> Fixes:
    """Fixes that count once per ``length`` metres: between, their errors are alike."""
    spacing = np.gradient(arc_length(start[:, :2, 3])) if len(start) > 1 else np.ones(1)
    repeats = np.clip(length / np.maximum(spacing, 0.1), 1.0, None)
    place = np.hypot(sigma[:, 0], sigma[:, 1]) / np.sqrt(2)
    turn = np.maximum(sigma[:, 2], ATTITUDE)
    both = np.stack([place, turn], axis=-1)
    return Fixes(steady, gnss[steady], both[steady], repeats[steady])


def _alike(solved: Solved, start: Array) -> float:
    """Metres over which the errors of GNSS in the plane are alike: the integral of their
    autocorrelation to its first zero, as two-sided."""
    good = solved.fix_weight > REJECTED
    e = solved.fix_residual[good, :2]
    if len(e) < 20:
        return GNSS_LENGTH
    e = e - e.mean(axis=0)
    power = float((e**2).sum())
    spacing = float(arc_length(start[:, :2, 3])[-1]) / max(len(start) - 1, 1)
    total = 1.0
    for lag in range(1, len(e) // 3):
        share = float((e[lag:] * e[:-lag]).sum()) / max(power, 1e-12)
        if share <= 0.05:
            break
        total += 2 * share
    return max(total * spacing, spacing)


def _hidden_bias(solved: Solved, sigma: Array) -> float:
    """Standard deviation (m) of a bias that all fixes of the drive share: what the stated sigma
    says and their scatter about the drive does not show."""
    good = solved.fix_weight > REJECTED
    e = solved.fix_residual[good, :2]
    if not len(e):
        return float(sigma[:, :2].max())
    shown = float(((e - e.mean(axis=0)) ** 2).mean())
    stated = float((sigma[good, :2] ** 2).mean())
    return float(np.sqrt(max(stated - shown, 0.0)))


def _in_map(solved: Solved) -> Array:
    """Covariances (rotation, translation; ego frame) as (translation, rotation; map axes)."""
    r = np.zeros((len(solved.pose), 6, 6))
    turn = solved.pose[:, :3, :3]
    r[:, :3, 3:], r[:, 3:, :3] = turn, turn
    out = r @ solved.covariance @ np.swapaxes(r, 1, 2)
    return np.asarray(out)
