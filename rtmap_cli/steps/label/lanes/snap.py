"""Borders drawn to what was seen: paint and curbs of a cloud, dividers and boundaries of a run.

Beside every sample of a centre line what was seen makes a profile across; the border is the path of
least cost through the profiles of an edge (dynamic programming), which bridges the gaps of dashes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d, uniform_filter1d
from scipy.spatial import cKDTree

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.polylines import normals, resample_step
from rtmap_cli.geometry.poses import transform
from rtmap_cli.maps.crs import check_same_crs
from rtmap_cli.steps.label.lanes.borders import SAME, Sides
from rtmap_cli.steps.label.lanes.curbs import paint_and_curbs
from rtmap_cli.steps.label.lanes.graph import LaneGraph
from rtmap_cli.steps.label.lanes.traces import STEP

Array = NDArray[np.float64]

BIN = 0.05
"""Metres of a bin across."""
NEAREST = 1.2
"""Metres from the centre line within which no border is: there are the wheels."""
BLUR = (1.0, 0.06)
"""Metres along and across by which what was seen is blurred."""
TURNING = 8.0
"""Cost of a metre aside: as much as four metres of line that was clearly seen."""
JUMP = 4.0
"""Cost of going on along another line: as much as two metres that were clearly seen."""
EASED = 2.0
"""Metres on both sides of such a jump over which the border goes across."""
STEEPEST = 3
"""Bins by which a border may go aside from sample to sample."""
FARTHER = 0.2
"""Share of its weight that a line loses per metre where lines are chosen from: the nearest one is
the lane's own. Whether it was seen does not depend on it."""
SEEN = 0.4
"""Score from which a place was seen."""
BESIDE = 1.5
"""Metres across over which a line stands out."""
REACH = 3.0
"""Metres along by which what was seen holds on both sides: half a gap between dashes."""
DOUBLE = 8
"""Bins to each side of a line of paint in which its second stripe is looked for."""
OBSERVED = {"divider": 1, "boundary": 2}
"""KINDS code by class of an observation."""


@dataclass(frozen=True)
class Evidence:
    """Places (n, 2) of the map frame where something was seen, KINDS codes and weights (n,)."""

    xy: Array
    kind: NDArray[np.int8]
    weight: Array


def evidence_of(folder: Path, crs: str) -> Evidence:
    """Paint and curbs of a cloud folder, or dividers and boundaries of a run; BadInput else."""
    if (folder / "cloud.json").exists():
        from rtmap_cli.logs.cloud import CloudFolder

        cloud = CloudFolder(folder)
        check_same_crs(cloud.crs, crs, folder)
        return Evidence(*paint_and_curbs(cloud))
    if (folder / "run.json").exists():
        return _of_run(folder, crs)
    raise BadInput(folder, "is neither a cloud nor a run", "--snap takes a folder of one of them")


def _of_run(folder: Path, crs: str) -> Evidence:
    from rtmap_cli.logs.run_files import read_run

    run = read_run(folder)
    check_same_crs(run.crs, crs, folder)
    pose = dict(zip(run.frames.frame.tolist(), run.best_poses(), strict=True))
    seen = run.observations
    xy, kind, weight = [np.zeros((0, 2))], [np.zeros(0, np.int8)], [np.zeros(0)]
    for k in range(len(seen)):
        code = OBSERVED.get(str(seen.class_name[k]))
        if code is None or seen.score[k] < 0.3:
            continue
        line = resample_step(np.asarray(seen.points[k], np.float64), 0.25)
        sigma = max(float(np.median(seen.sigma[k])), 0.05)
        flat = np.column_stack([line, np.zeros(len(line))])
        xy.append(transform(pose[int(seen.frame[k])], flat)[:, :2])
        kind.append(np.full(len(line), code, np.int8))
        weight.append(np.full(len(line), float(seen.score[k]) * (0.05 / sigma) ** 2))
    return Evidence(np.concatenate(xy), np.concatenate(kind), np.concatenate(weight))


def snapped(graph: LaneGraph, sides: list[Sides], seen: Evidence, bound: float) -> list[Sides]:
    """The sides, where something was seen within ``bound`` metres of them drawn to it."""
    if not len(seen.xy):
        return sides
    profiles = _profiles(graph, sides, seen, bound)
    out = []
    for s, both in zip(sides, profiles, strict=True):
        new = Sides(s.metres.copy(), s.kind.copy())
        for side in (0, 1):
            _draw(new, side, both[side], bound)
        out.append(new)
    return _carried(graph, out)


def _profiles(
    graph: LaneGraph, sides: list[Sides], seen: Evidence, bound: float
) -> list[list[Array]]:
    """By edge and side: scores (kinds, samples, bins) from 0 to 1 of metres to that side."""
    bins = int(np.ceil((max(s.metres.max() for s in sides) + bound) / BIN)) + 1
    tree = cKDTree(seen.xy)
    raw = []
    for e in graph.edges:
        reach = bins * BIN + 1.0
        near = np.unique(np.concatenate([*map(np.array, tree.query_ball_point(e.xy[::4], reach))]))
        normal = normals(e.xy)
        both = [np.zeros((2, len(e.xy), bins)) for _ in (0, 1)]
        if len(near):
            near = near.astype(np.int64)
            at = cKDTree(e.xy).query(seen.xy[near])[1]
            d = seen.xy[near] - e.xy[at]
            along = np.abs(d[:, 0] * normal[at, 1] - d[:, 1] * normal[at, 0])
            left = (d * normal[at]).sum(axis=1)
            for side, sign in enumerate((1.0, -1.0)):
                b = np.floor(sign * left / BIN).astype(np.int64)
                ok = (b >= 0) & (b < bins) & (along < 1.5 * STEP)
                place = (seen.kind[near[ok]] - 1, at[ok], b[ok])
                np.add.at(both[side], place, seen.weight[near[ok]])
        sigma = (0, BLUR[0] / STEP, BLUR[1] / BIN)
        raw.append([_lines_only(gaussian_filter(p, sigma, mode="nearest")) for p in both])
    for kind in (0, 1):
        tops = np.concatenate([p[kind].max(axis=1) for both in raw for p in both])
        tops = tops[tops > 1e-6]
        scale = 0.3 * float(np.quantile(tops, 0.9)) if len(tops) else 1.0
        for both in raw:
            for p in both:
                p[kind] = p[kind] / (p[kind] + scale)
    return raw


def _lines_only(profile: Array) -> Array:
    """Profiles without what is as dense beside: grass and noise are no lines."""
    background = uniform_filter1d(profile, int(BESIDE / BIN), axis=2, mode="constant")
    out: Array = np.maximum(profile - 2 * background, 0.0)
    return out


def _draw(sides: Sides, side: int, profile: Array, bound: float) -> None:
    """One side of one edge drawn to the best path through its profile."""
    metres: Array = (np.arange(profile.shape[2], dtype=np.float64) + 0.5) * BIN
    allowed = np.abs(metres - sides.metres[:, side, None]) <= bound
    allowed &= metres >= NEAREST
    score = np.where(allowed, profile.max(axis=0), 0.0)
    path = _best_path(score * np.clip(1 - FARTHER * (metres - NEAREST), 0, 1))
    rows = np.arange(len(path))
    fine = _peak(profile, path, metres)
    seen = _seen(score[rows, path], fine)
    jumps = np.concatenate([[False], np.abs(np.diff(path)) > STEEPEST])
    seen &= ~(uniform_filter1d(jumps.astype(float), int(2 * EASED / STEP)) > 1e-9)
    if not seen.any():
        return
    value = np.interp(rows, rows[seen], gaussian_filter1d(fine, 2.0, mode="nearest")[seen])
    free = sides.kind[:, side] == 0
    sides.metres[free, side] = value[free]
    best = profile[:, rows, path].argmax(axis=0) + 1
    sides.kind[free & seen, side] = best[free & seen]


def _seen(score: Array, metres: Array) -> NDArray[np.bool_]:
    """(n,) where a path of ``score`` and ``metres`` aside (n,) was seen, gaps bridged."""
    # A line is long: what is short is a stripe, a vehicle, noise.
    long = uniform_filter1d(score, int(2 * REACH / STEP)) > SEEN / 2
    seen = long & (score > SEEN)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    for a, b in zip(ends[1:-1:2], ends[2:-1:2], strict=True):
        near = min(a, len(score) - b, 4)
        aside = np.median(metres[a - near : a]) - np.median(metres[b : b + near])
        if b - a <= 2 * REACH / STEP and abs(aside) < SAME:
            seen[a:b] = True
    return seen


def _peak(profile: Array, path: NDArray[np.int64], metres: Array) -> Array:
    """Metres of the path, between bins where the score (kinds, n, bins) says so: the middle of a
    curb, and of both stripes where paint is a double line."""
    rows, last = np.arange(len(path)), profile.shape[2] - 1
    kind = profile[:, rows, path].argmax(axis=0)
    reach = np.where(kind == 0, DOUBLE, 2)[:, None]
    around = path[:, None] + np.arange(-DOUBLE, DOUBLE + 1)
    weight = profile[kind[:, None], rows[:, None], np.clip(around, 0, last)]
    ours = (np.abs(around - path[:, None]) <= reach) & (around >= 0) & (around <= last)
    weight = np.where(ours, weight, 0.0)
    faint = (np.abs(around - path[:, None]) > 2) & (weight < 0.5 * weight.max(axis=1)[:, None])
    weight = np.where(faint, 0.0, weight) + 1e-6 * (around == path[:, None])
    out: Array = (weight * metres[np.clip(around, 0, last)]).sum(axis=1) / weight.sum(axis=1)
    return out


def _best_path(score: Array) -> NDArray[np.int64]:
    """(n,) bins of the path that collects most; going aside costs TURNING per metre, another line
    JUMP."""
    n, bins = score.shape
    total, back = score[0].copy(), np.zeros((n, bins), np.int64)
    steps = np.arange(-STEEPEST, STEEPEST + 1)
    from_bin = np.arange(bins)[:, None] + steps
    cost = TURNING * BIN * np.abs(steps)
    outside = (from_bin < 0) | (from_bin >= bins)
    index = np.clip(from_bin, 0, bins - 1)
    rows = np.arange(bins)
    for k in range(1, n):
        options = np.where(outside, -np.inf, total[index] - cost)
        best = options.argmax(axis=1)
        back[k], near = index[rows, best], options[rows, best]
        far = int(total.argmax())
        jumps = near < total[far] - JUMP
        back[k, jumps] = far
        total = np.where(jumps, total[far] - JUMP, near) + score[k]
    path = np.zeros(n, np.int64)
    path[-1] = int(total.argmax())
    for k in range(n - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return path


def _carried(graph: LaneGraph, sides: list[Sides]) -> list[Sides]:
    """Edges beside which nothing was seen take the widths of those that they join."""
    at: dict[tuple[int, int], list[float]] = {}
    for e, s in zip(graph.edges, sides, strict=True):
        for side in (0, 1):
            if s.kind[:, side].any():
                at.setdefault((e.start, side), []).append(float(s.metres[0, side]))
                at.setdefault((e.end, side), []).append(float(s.metres[-1, side]))
    for e, s in zip(graph.edges, sides, strict=True):
        for side in (0, 1):
            first, last = at.get((e.start, side)), at.get((e.end, side))
            if s.kind[:, side].any() or not (first or last):
                continue
            s.metres[:, side] = np.linspace(
                float(np.mean(first or last or 0.0)),
                float(np.mean(last or first or 0.0)),
                len(e.xy),
            )
    return sides
