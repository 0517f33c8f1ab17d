"""A coarse search for the place of a drive: its detections against class rasters of the map.

Where the start may be many metres or degrees off, no solver that follows gradients finds home.
Frames whose odometry is known are taken together, a stretch of road at a time, and moved as one
rigid piece over all shifts and turns in reach; a piece that lies on lines of its class and
direction is likely there. Several likely places are said to be several.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.drive.motion import Motion
from rtmap_cli.steps.localize.frame.single import Solution
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines

Array = NDArray[np.float64]
Index = NDArray[np.int64]

STRETCH_M = 80.0
"""Travel of the frames that are moved as one piece: odometry drifts by less than a cell."""

_CELL_M = 1.0
_TURN = np.radians(2.0)
_BLUR_M = 1.0
_DIRECTIONS = 8
_SOFT = 0.6
"""Likelihood of a line in the neighbouring bin of direction."""
_PIECE_M = 20.0
"""Detected line that counts as one observation, along the line and along the drive."""
_NATS = 4.0
"""What an observation that lies on a line says for a place, against one that does not."""
_HOME_M, _HOME_RAD = 2.5, np.radians(4.0)
"""Places nearer than this are one: the solver brings them together."""
_FOUND_SIGMA = np.array([1.0, 1.0, np.radians(1.5)])
"""How well a sure place is known: cells, turns, drift of odometry."""
_MOST_PLACES = 12
_NO_CHANCE = 0.01
_STEP_SIGMA = np.array([2.0, 2.0, np.radians(3.0)])
"""How far the places of neighbouring stretches may disagree with odometry: cells, turns, drift."""
_LOST = 1e-3
_SURE = 0.95
"""A place that has this much of the probability is the place."""


@dataclass(frozen=True)
class Reach:
    """How far the start may be off, metres to either side and radians; ``full`` turns at π."""

    metres: float
    radians: float


@dataclass(frozen=True)
class Found:
    """Starts for T frames: ``pose`` (T, 3) x, y, yaw relative to the lines' origin; ``spread``
    (T, 3, 3): the covariance that rival places leave, zero where one place is sure; ``sure``
    (T,)."""

    pose: Array
    spread: Array
    sure: NDArray[np.bool_]


def needs_search(sigma: Array) -> bool:
    """True when stated sigmas (T, 3) m, m, rad of the initial poses say that they may be further
    off than the lateral starts of the solver reach."""
    middle = np.median(sigma, axis=0)
    return bool(max(middle[0], middle[1]) > 2.0 or middle[2] > np.radians(5.0))


def reach_of(sigma: Array) -> Reach:
    """What covers 2.5 sigmas of (T, 3) stated ones; 40 m at most."""
    middle = 2.5 * np.median(sigma, axis=0)
    return Reach(float(np.clip(max(middle[:2]), 3.0, 40.0)), float(min(middle[2], np.pi)))


def relocate(lines: MapLines, seen: Detections, motion: Motion, reach: Reach) -> Found:
    """Search every stretch of the drive; a sure one gives its neighbours their place by odometry.

    Without odometry every frame is searched for alone.
    """
    t = len(seen)
    local, stretch = _dead_reckoning(motion)
    found = Found(np.empty((t, 3)), np.zeros((t, 3, 3)), np.zeros(t, bool))
    known = np.asarray(np.isfinite(motion.odometry).all(1))
    pieces = list(_stretches(stretch))
    places = [_places(lines, seen, rows, _seen_from_middle(local, rows), reach) for rows in pieces]
    chances = _agreed(places, [_from_last(local, known, *two) for two in pairwise(pieces)])
    for rows, (pose, _), chance in zip(pieces, places, chances, strict=True):
        _settle(found, rows, _seen_from_middle(local, rows), pose, chance)
    _lend(found, motion)
    return found


def moved(seen: Detections, found: Found) -> Detections:
    """The detections with what the search found in place of the initial poses where it is sure."""
    sigma = np.where(found.sure[:, None], np.minimum(seen.sigma, _FOUND_SIGMA), seen.sigma)
    return replace(seen, pose=np.where(found.sure[:, None], found.pose, seen.pose), sigma=sigma)


def widened(solution: Solution, found: Found) -> Solution:
    """A solution with what the rivals of its starts leave open: wider, and knowing less."""
    spread = found.spread
    open_ = np.eye(3) + solution.information @ spread
    less: Array = np.asarray(np.linalg.solve(open_, solution.information), np.float64)
    return replace(
        solution,
        covariance=solution.covariance + spread,
        information=0.5 * (less + np.swapaxes(less, -1, -2)),
        spread=solution.spread + spread,
    )


def _stretches(stretch: Index) -> Iterator[Index]:
    for first, last in zip(
        np.flatnonzero(np.diff(stretch, prepend=-1)),
        np.flatnonzero(np.diff(stretch, append=-1)),
        strict=True,
    ):
        yield np.arange(first, last + 1)


def _dead_reckoning(motion: Motion) -> tuple[Array, Index]:
    """(T, 3) poses by odometry alone, and the stretch (T,) of each frame; a new one begins where
    odometry is missing."""
    known = np.asarray(np.isfinite(motion.odometry).all(1))
    local, stretch = np.zeros((len(known), 3)), np.zeros(len(known), np.int64)
    travelled = 0.0
    for t in range(1, len(known)):
        travelled += motion.step[t]
        new = not known[t] or travelled > STRETCH_M
        stretch[t] = stretch[t - 1] + new
        travelled = 0.0 if new else travelled
        local[t] = _compose(local[t - 1], motion.odometry[t]) if known[t] else 0.0
    return local, stretch


def _compose(a: Array, b: Array) -> Array:
    """Planar poses (..., 3): a then b."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [
            a[..., 0] + c * b[..., 0] - s * b[..., 1],
            a[..., 1] + s * b[..., 0] + c * b[..., 1],
            a[..., 2] + b[..., 2],
        ],
        axis=-1,
    )


def _inverse(a: Array) -> Array:
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [-c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1], -a[..., 2]], axis=-1
    )


@dataclass(frozen=True)
class _Cloud:
    """Vertices of a stretch in the frame of its middle pose: ``xy`` (n, 2), ``angle`` (n,) of the
    line, ``code`` (n,), ``weight`` (n,) observations (`_PIECE_M`) that each stands for."""

    xy: Array
    angle: Array
    code: Index
    weight: Array


def _cloud(seen: Detections, rows: Index, relative: Array, spacing: float) -> _Cloud:
    mine = np.flatnonzero((seen.frame >= rows[0]) & (seen.frame <= rows[-1]))
    pose = relative[seen.frame[mine] - rows[0]]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    xy = seen.points[mine] @ turn + pose[:, None, :2]
    tangent = seen.tangent[mine] @ turn
    count = xy.shape[1]
    probability = 1.0 / (1.0 + np.exp(-seen.logit[mine]))
    pieces = np.maximum(seen.length[mine] / _PIECE_M, 0.25) * min(1.0, spacing / _PIECE_M)
    weight = np.repeat(probability * pieces / count, count)
    angle = np.arctan2(tangent[..., 1], tangent[..., 0]).ravel()
    return _Cloud(xy.reshape(-1, 2), angle, np.repeat(seen.code[mine], count), weight)


def _bin(angle: Array) -> Index:
    """Direction of a line (it has no sense of travel) in `_DIRECTIONS` bins."""
    return np.asarray(np.floor((angle % np.pi) * (_DIRECTIONS / np.pi)), np.int64) % _DIRECTIONS


def _seen_from_middle(local: Array, rows: Index) -> Array:
    """(n, 3) poses of the frames of a stretch in that of its middle one."""
    return _compose(_inverse(local[rows[len(rows) // 2]]), local[rows])


def _from_last(local: Array, known: NDArray[np.bool_], before: Index, after: Index) -> Array | None:
    """(3,) the middle of a stretch seen from the middle of the last one; None without odometry."""
    if not known[after[0]]:
        return None
    middles = local[[before[len(before) // 2], after[len(after) // 2]]]
    return _compose(_inverse(middles[0]), middles[1])


def _places(
    lines: MapLines, seen: Detections, rows: Index, relative: Array, reach: Reach
) -> tuple[Array, Array]:
    """(K, 3) the likeliest poses of the middle frame of a stretch and their chances (K,)."""
    guess = _guess(seen, rows, relative)
    step = np.hypot(*np.diff(relative[:, :2], axis=0).T)
    cloud = _cloud(seen, rows, relative, float(step.mean()) if len(step) else _PIECE_M)
    if not len(cloud.xy):
        return guess[None], np.ones(1)
    turns = _turns(reach.radians)
    cells = int(np.ceil(reach.metres / _CELL_M))
    score = _scores(lines, cloud, guess, turns, cells)  # (turns, y, x) nats
    shift = np.arange(-cells, cells + 1) * _CELL_M
    prior = seen.sigma[rows].mean(axis=0)
    score -= 0.5 * (shift[:, None] / prior[1]) ** 2 + 0.5 * (shift / prior[0]) ** 2
    score -= 0.5 * (turns / prior[2])[:, None, None] ** 2
    chance = np.exp(score - score.max())
    chance /= chance.sum()
    poses: list[Array] = []
    chances: list[float] = []
    while len(poses) < _MOST_PLACES:
        k, i, j = np.unravel_index(chance.argmax(), chance.shape)
        near = (np.abs(wrap_angle(turns - turns[k])) <= _HOME_RAD)[:, None, None] & (
            np.hypot((shift - shift[i])[:, None], shift - shift[j]) <= _HOME_M
        )
        poses.append(guess + np.array([shift[j], shift[i], turns[k]]))
        chances.append(float(chance[near].sum()))
        chance[near] = 0.0
        if chance.sum() < _NO_CHANCE:
            break
    return np.stack(poses), np.array(chances)


def _agreed(places: list[tuple[Array, Array]], steps: list[Array | None]) -> list[Array]:
    """Chances (K,) of every stretch's places, given those of all stretches that odometry joins.

    Sums over all paths, forward and backward; a place that none of the kept ones explains keeps
    `_LOST` of its chance.
    """
    ahead = [c / c.sum() for _, c in places]
    back = [np.ones(len(c)) for _, c in places]
    links = [
        None if step is None else _agreement(a[0], b[0], step)
        for (a, b), step in zip(pairwise(places), steps, strict=True)
    ]
    for n, link in enumerate(links):
        if link is not None:
            ahead[n + 1] = ahead[n + 1] * (ahead[n] @ link)
            ahead[n + 1] /= ahead[n + 1].sum()
    for n, link in reversed(list(enumerate(links))):
        if link is not None:
            own = places[n + 1][1] * back[n + 1]
            back[n] = link @ (own / own.sum())
    both = [a * b for a, b in zip(ahead, back, strict=True)]
    return [x / x.sum() for x in both]


def _agreement(before: Array, after: Array, step: Array) -> Array:
    """(K, L) how well places (K, 3) and (L, 3) of neighbouring stretches fit odometry (3,)."""
    d = _compose(_inverse(_compose(before, step))[:, None], after[None])
    d[..., 2] = wrap_angle(d[..., 2])
    return np.exp(-0.5 * ((d / _STEP_SIGMA) ** 2).sum(-1)) + _LOST


def _settle(found: Found, rows: Index, relative: Array, places: Array, chance: Array) -> None:
    """Fill ``found`` for the frames of a stretch."""
    best = places[chance.argmax()]
    away = places - best
    away[:, 2] = wrap_angle(away[:, 2])
    home = (np.hypot(away[:, 0], away[:, 1]) <= _HOME_M) & (np.abs(away[:, 2]) <= _HOME_RAD)
    found.pose[rows] = _compose(best, relative)
    found.sure[rows] = chance[home].sum() >= _SURE
    if not found.sure[rows[0]]:
        cov = np.einsum("k,ka,kb->ab", chance, away, away)
        found.spread[rows] = _at_frames(cov, found.pose[rows] - best)


def _at_frames(cov: Array, away: Array) -> Array:
    """A piece's covariance (3, 3) as that of poses (T, 3) which lie ``away`` from its middle."""
    jacobian = np.tile(np.eye(3), (len(away), 1, 1))
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -away[:, 1], away[:, 0]
    return jacobian @ cov @ np.swapaxes(jacobian, -1, -2)


def _guess(seen: Detections, rows: Index, relative: Array) -> Array:
    """(3,) where the initial poses of all frames put the middle one."""
    said = _compose(seen.pose[rows], _inverse(relative))
    yaw = np.arctan2(np.sin(said[:, 2]).mean(), np.cos(said[:, 2]).mean())
    # Positions said by the yaws in common: the yaw of one frame must not swing the others' levers.
    turned = _compose(
        np.column_stack([seen.pose[rows][:, :2], yaw + relative[:, 2]]), _inverse(relative)
    )
    return np.append(np.median(turned[:, :2], axis=0), yaw)


def _turns(radians: float) -> Array:
    if radians >= np.pi - _TURN:
        return np.arange(-np.pi, np.pi - 1e-9, _TURN)
    count = int(np.ceil(radians / _TURN))
    return np.arange(-count, count + 1) * _TURN


def _scores(lines: MapLines, cloud: _Cloud, guess: Array, turns: Array, cells: int) -> Array:
    """(turns, 2 cells + 1, 2 cells + 1) nats by turn, shift along y, shift along x."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    radius = float(np.hypot(*cloud.xy.T).max())
    half = int(np.ceil(radius / _CELL_M)) + cells + 2
    size = next_fast_len(2 * half + 1, real=True)
    shape = (size, size)
    used = np.unique(cloud.code)
    maps = {c: rfft2(_likelihood(lines, c, guess, half, size), axes=(1, 2)) for c in used}
    out = np.empty((len(turns), 2 * cells + 1, 2 * cells + 1))
    window = np.arange(-cells, cells + 1) % size
    for n, turn in enumerate(turns):
        c, s = np.cos(guess[2] + turn), np.sin(guess[2] + turn)
        xy = cloud.xy @ np.array([[c, s], [-s, c]])
        column, row = (np.rint(xy / _CELL_M).astype(np.int64) + half).T
        bins = _bin(cloud.angle + guess[2] + turn)
        total = np.zeros((size, size // 2 + 1), np.complex64)
        for code in used:
            mine = cloud.code == code
            flat = (bins[mine] * size + row[mine]) * size + column[mine]
            raster = np.bincount(flat, cloud.weight[mine], _DIRECTIONS * size * size)
            raster = raster.reshape(_DIRECTIONS, size, size).astype(np.float32)
            total += (maps[code] * np.conj(rfft2(raster, axes=(1, 2)))).sum(0)
        out[n] = irfft2(total, shape)[np.ix_(window, window)]
    return _NATS * out


def _likelihood(lines: MapLines, code: int, guess: Array, half: int, size: int) -> Array:
    """(directions, size, size) 0 … 1: how likely a vertex of a class in a direction lies at a
    cell (row y, column x; the guess is in the cell ``half``, ``half``)."""
    from scipy.ndimage import distance_transform_edt

    mine = lines.class_code == code
    at = np.rint((lines.xy[mine] - guess[:2]) / _CELL_M).astype(np.int64) + half
    inside = ((at >= 0) & (at < size)).all(1)
    angle = np.arctan2(lines.tangent[mine][inside, 1], lines.tangent[mine][inside, 0])
    bins, at = _bin(angle), at[inside]
    near = np.zeros((_DIRECTIONS, size, size), np.float32)
    for b in np.unique(bins):
        empty = np.ones((size, size), bool)
        here = at[bins == b]
        empty[here[:, 1], here[:, 0]] = False
        distance = distance_transform_edt(empty) * _CELL_M
        near[b] = np.exp(-0.5 * (distance / _BLUR_M) ** 2)
    beside = np.maximum(np.roll(near, 1, 0), np.roll(near, -1, 0)) * _SOFT
    return np.maximum(near, beside)


def _lend(found: Found, motion: Motion) -> None:
    """Give stretches whose place is not sure that which odometry says from a sure neighbour."""
    known = np.asarray(np.isfinite(motion.odometry).all(1))
    t = len(known)
    for forward in (True, False):
        for k in range(1, t) if forward else range(t - 1, 0, -1):
            here, there = (k, k - 1) if forward else (k - 1, k)
            if known[k] and found.sure[there] and not found.sure[here]:
                step = motion.odometry[k]
                found.pose[here] = _compose(found.pose[there], step if forward else _inverse(step))
                found.spread[here], found.sure[here] = 0.0, True
