"""Lines: what the drives say about prior ones, and new ones that the prior does not explain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.assignment import assign_once
from rtmap_cli.maps.refit import FusionModel, solve_vertices
from rtmap_cli.maps.sight import SightModel
from rtmap_cli.maps.stations import (
    Samples,
    Stations,
    assign,
    loose_stretches,
    smoother,
    stations_of,
)
from rtmap_cli.steps.detect_changes.field import BLOCK, CELL, Marks, blocks
from rtmap_cli.steps.detect_changes.ridges import (
    RidgePoints,
    join_collinear,
    ridge_points,
    trace,
)
from rtmap_cli.steps.detect_changes.rivals import Play
from rtmap_cli.steps.detect_changes.votes import line_counts, only_at_the_border

Array = NDArray[np.float64]
Int = NDArray[np.int64]

SHORTEST = 3.0
"""Shorter pieces of detections (m) are not candidates for new lines."""
BLUR = {"boundary": 1.0}
"""Blur of the field in median sigmas; classes without close parallels bear more."""
USUAL_BLUR = 0.45
HIGH, LOW = 0.20, 0.06
"""Ridges start and end at these shares of the height that a steady line would have."""
FINEST = 0.05
"""No detection is sharper (m)."""
THIN = 0.02
"""Where so little of the usual weight is, nothing was seen."""
JOIN_GAP = {"boundary": 12.0}
USUAL_GAP, JOIN_ANGLE = 7.0, float(np.radians(25))
"""Ends of new lines that look at each other are joined over such a gap (m): boundaries go on."""
CORNER = {"boundary": 5.0}
"""Longest extension (m) of two ends to a common corner."""
FIRM = 6.0
"""Where nothing is known shorter lines (m) are not extended to one: specks at the border of the
range would close side streets. Beside a map what is made of specks is refuted as a whole."""


def new_lines(
    class_name: str,
    prior: Stations,
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    owns: Sequence[Int],
) -> list[Array]:
    """Polylines (n, 2) where detections that no prior line explains agree; not yet judged. ``owns``
    as for ``all_line_counts``."""
    drives = []
    for s, own in zip(samples, owns, strict=True):
        _, taken = assign_once(prior, s, own=own)
        k = loose_stretches(s, taken, SHORTEST)
        drives.append(Marks(s.xy[k], s.tangent[k], s.spacing[k], s.across_sigma[k], s.score[k]))
    widths = np.concatenate([d.sigma for d in drives])
    if not len(widths):
        return []
    median = float(np.median(widths))
    blur = float(np.clip(BLUR.get(class_name, USUAL_BLUR) * median, CELL, 0.9))
    spread = np.sqrt(2 * median**2 + blur**2)
    score = float(np.mean(np.concatenate([d.score for d in drives])))
    steady = 0.5 * score / (np.sqrt(2 * np.pi) * spread)
    points = _all_ridge_points(drives, traversals, blur, LOW * steady)
    if points is None:
        return []
    return joined_lines(trace(points, HIGH * steady, SHORTEST), class_name, len(prior) > 0)


def joined_lines(lines: list[Array], class_name: str, charted: bool = False) -> list[Array]:
    """Lines whose ends look at each other, or meet at a corner, made one; ``charted``: a map knows
    others of their class."""
    gap, corner = JOIN_GAP.get(class_name, USUAL_GAP), CORNER.get(class_name, 0.0)
    return join_collinear(lines, gap, JOIN_ANGLE, corner, 0.0 if charted else FIRM)


def _all_ridge_points(
    drives: Sequence[Marks], traversals: Sequence[Traversal], blur: float, low: float
) -> RidgePoints | None:
    parts = []
    for block, first, field in blocks(drives, traversals):
        points = ridge_points(field, first, CELL, blur, low)
        # A block keeps the points of its own square; the margin belongs to its neighbours.
        parts.append(points.select((points.cell // BLOCK == block).all(axis=1)))
    return RidgePoints.concatenate(parts) if parts else None


def refit_lines(
    lines: list[Array],
    others: list[Array],
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    model: FusionModel,
) -> list[Array]:
    """New lines moved to where their detections put them, ``others`` competing for detections.

    Before anything is judged the plain mean will do: fusion puts what remains to where it lies.
    """
    if not lines:
        return []
    stations = stations_of([*others, *lines])
    offset, variance = _mean_offsets(stations, traversals, samples, model)
    mine = stations.line >= len(others)
    start = np.tile(np.eye(2) * 1.0, (int(mine.sum()), 1, 1))
    moved, _ = solve_vertices(
        stations.xy[mine], stations.chain[mine], start, stations, offset, variance, 1.2
    )
    # A jump is a wrong assignment, not a correction.
    size = np.hypot(*moved.T)
    moved *= np.minimum(1.0, 1.0 / np.maximum(size, 1e-9))[:, None]
    xy = stations.xy[mine] + moved
    return [xy[stations.line[mine] == k + len(others)] for k in range(len(lines))]


def _mean_offsets(
    stations: Stations,
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    model: FusionModel,
) -> tuple[Array, Array]:
    """Offset (m, to the left) of the detections around every station and its variance (m²; NaN, inf
    where there are none): a robust mean over the drives of each one's weighted mean."""
    n, smooth = len(stations), smoother(stations, model.width)
    offset, variance = np.full((2, len(samples), n), np.nan)
    for k, (traversal, s) in enumerate(zip(traversals, samples, strict=True)):
        feet, _ = assign(stations, s)
        if not len(feet):
            continue
        sigma = np.maximum(s.across_sigma[feet.sample], FINEST)
        weight = s.spacing[feet.sample] * np.maximum(s.score[feet.sample], 0.02) / sigma**3
        sums = [
            np.bincount(feet.station, v, n)
            for v in (weight, weight * feet.offset, weight * sigma**2)
        ]
        total, moment, square = (smooth @ v for v in sums)
        ok = total > THIN * np.median(total[total > 0])
        pose = traversal.pose_covariance[:, [0, 1], [0, 1]].mean()
        offset[k, ok] = moment[ok] / total[ok]
        variance[k, ok] = square[ok] / total[ok] + pose
    seen = np.isfinite(offset)
    value, information = np.where(seen, offset, 0.0), np.where(seen, 1 / variance, 0.0)
    weight = information
    for _ in range(4):
        mean = (weight * value).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
        z = np.abs(value - mean) * np.sqrt(information)
        weight = information * np.minimum(1.0, model.huber / np.maximum(z, 1e-9))
    some = seen.any(axis=0)
    total = np.where(some, weight.sum(axis=0), 1.0)
    return np.where(some, mean, np.nan), np.where(some, 1 / total, np.inf)


def all_line_counts(
    stations: Stations,
    ids: Sequence[str],
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    owns: Sequence[Int],
    margin: float,
    sight: SightModel,
    first: NDArray[np.bool_] | None = None,
    wide: bool = True,
) -> Play:
    """Counts of every drive at all stations; every detection goes to one line only.

    ``owns``: of every drive the line that the network says each sample is, -1: none. With ``first``
    (stations,) these choose their detections before the others. ``wide`` as in ``assign_once``.
    """
    counts, feet = [], []
    edge = only_at_the_border(stations, ids, traversals, margin)
    for traversal, s, own in zip(traversals, samples, owns, strict=True):
        feet.append(assign_once(stations, s, first, wide=wide, own=own)[0])
        counts.append(line_counts(stations, ids, traversal, s, feet[-1], margin, sight, edge))
    return Play(counts, feet)
