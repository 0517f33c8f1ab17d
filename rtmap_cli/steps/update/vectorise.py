"""Confidence grids become polylines and rings: threshold and filter, skeleton, graph, smoothing.

Lines: cells above a threshold that fall off to both sides (the field is concave across) are the
mask; its skeleton's graph gives the branches, whose points are then put onto the ridge between the
cells. Outlines are found by ``outlines``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.blocks import Bool, Float, Layout
from rtmap_cli.geometry.polylines import is_ring, length, normals, resample_step
from rtmap_cli.geometry.skeleton import thin, trace
from rtmap_cli.maps.element import RING_CLASSES
from rtmap_cli.steps.update.accumulate import Heat
from rtmap_cli.steps.update.outlines import Line, local_maximum, outlines
from rtmap_cli.steps.update.settings import Settings

Array = NDArray[np.float64]

STEP = 0.5
"""Metres between the points of a line before it is simplified."""
BASE = 0.01
"""No confidence below this is a line, however little a class is usually seen."""
USUAL = 0.75
"""The usual confidence of a class is this quantile over what may be its ridges."""


def vectorise(heat: Heat, class_name: str, usual: float, settings: Settings) -> list[Line]:
    """The lines or outlines of a class, whose ``usual`` confidence scales the thresholds."""
    low = max(settings.threshold * usual, BASE)
    if class_name in RING_CLASSES:
        return outlines(heat, class_name, low)
    return _polylines(heat, class_name, low, settings)


def usual_confidence(heat: Heat, class_name: str) -> float:
    """What a well seen element of a class has, from the grid alone: a high quantile over the cells
    that no neighbour exceeds by much; 0 where there is nothing."""
    field = heat.confidence(class_name)
    peak = local_maximum(heat.layout, field, 2)
    ridge = field[(field >= 0.9 * peak) & (field > 5 * BASE)]
    return float(np.quantile(ridge, USUAL)) if len(ridge) else 0.0


# ---- lines


def _polylines(heat: Heat, class_name: str, low: float, settings: Settings) -> list[Line]:
    field = heat.confidence(class_name)
    layout = heat.layout
    mask = _ridge_mask(layout, field, low, settings.ridge)
    cells = thin(layout.cells(np.flatnonzero(mask)))
    angle = float(np.radians(settings.angle_deg))
    raw = trace(cells, settings.grid_m, settings.spur_m, angle)
    lines = [_on_ridge(line, layout, field) for line in raw if length(line) >= STEP]
    lines = _over_gaps(lines, settings.gap_m, float(np.radians(25.0)))
    drives = heat.drives(class_name)
    out = []
    for line in lines:
        if length(line) < settings.shortest_m:
            continue
        points = resample_step(line, STEP)
        confidence = float(layout.value(field, points).mean())
        behind = float(np.median(layout.value(drives, points)))
        out.append(Line(class_name, _simplified(line, settings.simplify_m), confidence, behind))
    return out


def _ridge_mask(layout: Layout, field: Float, low: float, ridge: float) -> Bool:
    """Cells of at least ``low`` where the field bends down across by ``ridge`` of its value."""
    f = layout.halo(field, 1)
    middle = f[:, 1:-1, 1:-1]
    xx = f[:, 1:-1, 2:] + f[:, 1:-1, :-2] - 2 * middle
    yy = f[:, 2:, 1:-1] + f[:, :-2, 1:-1] - 2 * middle
    xy = (f[:, 2:, 2:] + f[:, :-2, :-2] - f[:, 2:, :-2] - f[:, :-2, 2:]) / 4
    bend = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return np.asarray((middle >= low) & (bend <= -ridge * middle), np.bool_)


def _on_ridge(line: Array, layout: Layout, field: Float) -> Array:
    """A line of cells put onto the ridge: smoothed, then moved across to the top of a parabola."""
    ring = is_ring(line)
    points = _smooth(resample_step(line, STEP), 2.0, ring)
    for _ in range(2):
        normal = normals(points)
        step = layout.cell
        left, here, right = (
            layout.value(field, points + k * step * normal) for k in (-1.0, 0.0, 1.0)
        )
        bend = left + right - 2 * here
        shift = np.where(bend < -1e-9, 0.5 * (left - right) / np.minimum(bend, -1e-9), 0.0)
        points = points + (np.clip(shift, -0.7, 0.7) * step)[:, None] * normal
        points = _smooth(points, 1.5, ring)
    return points


def _smooth(points: Array, sigma: float, ring: bool) -> Array:
    """Gaussian along the line (``sigma`` points); open ends stay."""
    from scipy.ndimage import gaussian_filter1d

    if len(points) < 5:
        return points
    if ring:
        out = gaussian_filter1d(points[:-1], sigma, axis=0, mode="wrap")
        return np.concatenate([out, out[:1]])
    # Mirrored through the ends, so that they neither shrink nor bend.
    out = np.asarray(points, np.float64).copy()
    k = min(len(points) - 1, 6)
    before = 2 * points[0] - points[k:0:-1]
    after = 2 * points[-1] - points[-2 : -k - 2 : -1]
    out = gaussian_filter1d(np.concatenate([before, points, after]), sigma, axis=0)
    return np.asarray(out[k : k + len(points)], np.float64)


def _simplified(line: Array, tolerance: float) -> Array:
    """Douglas and Peucker; rings stay closed."""
    import shapely

    found = shapely.simplify(shapely.LineString(line), tolerance)
    return np.asarray(shapely.get_coordinates(found), np.float64)


def _over_gaps(lines: list[Array], gap: float, angle: float) -> list[Array]:
    """Lines joined whose ends look at each other over at most ``gap`` metres."""
    from scipy.spatial import cKDTree

    while True:
        open_ = [k for k, line in enumerate(lines) if not is_ring(line) and len(line) > 1]
        ends = [(k, at) for k in open_ for at in (0, -1)]
        if len(ends) < 2:
            return lines
        place = np.array([lines[k][at] for k, at in ends])
        way = np.array([_end_direction(lines[k], at) for k, at in ends])
        pairs = cKDTree(place).query_pairs(gap, output_type="ndarray")
        step = place[pairs[:, 1]] - place[pairs[:, 0]]
        far = np.maximum(np.hypot(*step.T), 1e-9)
        a, b = way[pairs[:, 0]], way[pairs[:, 1]]
        facing = -(a * b).sum(axis=1)
        ahead = np.minimum((a * step).sum(axis=1), -(b * step).sum(axis=1)) / far
        # What overlaps a little looks back, not ahead.
        good = (facing >= np.cos(angle)) & ((ahead >= np.cos(angle)) | (far < 1.0))
        good &= np.array([ends[i][0] != ends[j][0] for i, j in pairs], bool)
        used: set[int] = set()
        merged: list[Array] = []
        for i, j in pairs[good][np.argsort(far[good], kind="stable")].tolist():
            (p, at_p), (q, at_q) = ends[i], ends[j]
            if p in used or q in used:
                continue
            used |= {p, q}
            first = lines[p] if at_p == -1 else lines[p][::-1]
            second = lines[q] if at_q == 0 else lines[q][::-1]
            merged.append(np.concatenate([first, second]))
        if not merged:
            return lines
        lines = [line for k, line in enumerate(lines) if k not in used] + merged


def _end_direction(line: Array, at: int) -> Array:
    """Unit vector out of an end, over its last four metres."""
    points = line[::-1] if at == 0 else line
    near = points[np.hypot(*(points - points[-1]).T) <= 4.0]
    d = points[-1] - (near[0] if len(near) > 1 else points[-2])
    return np.asarray(d / max(float(np.hypot(*d)), 1e-9), np.float64)
