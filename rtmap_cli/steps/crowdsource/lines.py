"""Lines of the next map version: prior pieces and accepted new lines, moved by their evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring, tangents
from rtmap_cli.logs.offsets import fused_offsets
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.refit import (
    UNKNOWN_SIGMA,
    FusionModel,
    at_nodes,
    columns,
    planar,
    solve_vertices,
)
from rtmap_cli.maps.registration import registered
from rtmap_cli.maps.stations import Stations, stations_of

Array = NDArray[np.float64]

NEW_SIGMA = 1.0
"""Standard deviation (m) of a new line's vertices before its detections are fused."""
END_SIGMA = 0.8
"""Along-line standard deviation (m) of an open end: detections are cut short there."""
MET = 0.02
"""Ends so near to each other (m) are one vertex."""
OVERLAP = 0.3
"""A new line that is joined to an end starts so far (m) beyond it."""
BESIDE = 1.0
"""An end that lies farther (m) to the side of another one does not continue it."""
LONGEST_MOVE = 1.0
"""A vertex moves no farther (m) in one fusion: more is a wrong assignment."""


@dataclass(frozen=True)
class Fused:
    """New vertices ``points`` (n, 3) with ``covariance`` (n, 4), or nothing when untouched."""

    points: Array
    covariance: Array | None
    touched: bool


def fuse_lines(
    points: Sequence[Array],
    covariances: Sequence[Array | None],
    new: Sequence[bool],
    class_name: str,
    fresh: Sequence[Traversal],
    every: Sequence[Traversal],
    model: FusionModel,
    looked_at: Sequence[bool] | None = None,
    fused: Sequence[bool] | None = None,
) -> list[Fused]:
    """Eq. 5 for the lines of one class, all at once.

    Prior lines are moved by the ``fresh`` traversals (what the map was already fused from does not
    count again), ``new`` ones by ``every`` traversal. Vertices shared by two pieces of a chain
    get the same displacement, so that the pieces stay joined. What was not ``looked_at`` stays,
    and holds the vertices that it shares. Covariances of lines that were ``fused`` before have the
    floor of ``model`` in them.
    """
    if not points:
        return []
    stations = stations_of([p[:, :2] for p in points])
    is_new = np.asarray(new, bool)
    old = _offsets(stations, class_name, fresh, model)
    late = old
    if is_new.any() and (len(fresh) < len(every) or not is_new.all()):
        # New lines lie where they do relative to what the map knows around them.
        known = stations_of(
            [p[:, :2] for p, fresh_line in zip(points, new, strict=True) if not fresh_line]
        )
        late = _offsets(stations, class_name, every, model, known)
    pick = is_new[stations.line]
    offset, variance = np.where(pick, late, old)
    start = np.cumsum([0, *(len(p) for p in points)])
    vertices = np.concatenate([p[:, :2] for p in points])
    before = np.concatenate(
        [
            planar(c, len(p), NEW_SIGMA if fresh_line else UNKNOWN_SIGMA)
            for p, c, fresh_line in zip(points, covariances, new, strict=True)
        ]
    )
    if fused is not None:
        again = np.repeat(fused, np.diff(start))
        before[again] = _without_floor(before[again], model.floor)
    chain = np.concatenate(
        [np.full(len(p), stations.chain[stations.of_line(k)[0]]) for k, p in enumerate(points)]
    )
    move, after = solve_vertices(vertices, chain, before, stations, offset, variance, 1.5)
    size = np.hypot(move[:, 0], move[:, 1])
    move *= np.minimum(1.0, LONGEST_MOVE / np.maximum(size, 1e-9))[:, None]
    seen = [bool(np.isfinite(variance[stations.of_line(k)]).any()) for k in range(len(points))]
    if looked_at is not None:
        seen = [s and looked for s, looked in zip(seen, looked_at, strict=True)]
    move = at_nodes(vertices, move, np.repeat(seen, np.diff(start)))
    out = []
    for k, p in enumerate(points):
        part = slice(start[k], start[k + 1])
        if not seen[k]:
            out.append(Fused(p, covariances[k], False))
            continue
        xy = p[:, :2] + move[part]
        cov = after[part] + np.eye(2) * (model.floor**2 + model.common)
        if is_new[k]:
            cov = _known_along(cov, xy)
        if is_ring(p):
            xy[-1], cov[-1] = xy[0], cov[0]
        heights = covariances[k]
        out.append(Fused(np.column_stack([xy, p[:, 2]]), columns(cov, heights), True))
    return out


def _without_floor(covariance: Array, floor: float) -> Array:
    """Covariances (n, 2, 2) without what was added to them so that no sigma is below ``floor``:
    versions would lose half of what they know with every fusion. At most half of a variance goes,
    so that a map of many versions can still learn."""
    size, axes = np.linalg.eigh(covariance)
    size = np.maximum(size - floor**2, size / 2)
    return np.asarray((axes * size[:, None, :]) @ np.swapaxes(axes, -1, -2))


def _known_along(covariance: Array, xy: Array) -> Array:
    """Along a line a vertex may lie anywhere; only the ends are uncertain there, by how
    detections are cut. Interior vertices slide freely and keep what the system gave them."""
    out = covariance.copy()
    t = tangents(xy)
    for k in (0, -1):
        out[k] += np.outer(t[k], t[k]) * END_SIGMA**2
    return out


def _offsets(
    stations: Stations,
    class_name: str,
    traversals: Sequence[Traversal],
    model: FusionModel,
    known: Stations | None = None,
) -> tuple[Array, Array]:
    """Offset and variance of every station over the traversals (NaN, inf where unseen); with
    ``known`` lines what these show as displaced is put back first."""
    samples = [t.samples(class_name) for t in traversals]
    if known is not None:
        samples = [registered(s, known) for s in samples]
    return fused_offsets(stations, traversals, samples, model)


def snap_ends(points: list[Array], new: Sequence[bool], reach: float, angle: float) -> None:
    """Put the open ends of new lines onto ends that they look at, in place.

    A stretch that was missing in the prior closes the gap exactly: the new end becomes the old
    vertex. Ends at most ``reach`` m apart whose directions differ by less than ``angle`` (rad).
    """
    from scipy.spatial import cKDTree

    owner: list[tuple[int, int]] = []
    place, outward = [], []
    for k, p in enumerate(points):
        if is_ring(p) or len(p) < 2:
            continue
        t = tangents(p)
        owner += [(k, 0), (k, -1)]
        place += [p[0, :2].copy(), p[-1, :2].copy()]
        outward += [-t[0], t[-1]]
    if len(owner) < 2:
        return
    tree = cKDTree(np.array(place))
    met = np.array([len(k) > 1 for k in tree.query_ball_point(place, MET)])
    options = []
    for i, j in tree.query_pairs(reach):
        # An old end keeps its place; of two new ends the first one moves.
        a, b = (i, j) if new[owner[i][0]] else (j, i)
        # Where two lines have met already there is no gap to close.
        if owner[a][0] == owner[b][0] or not new[owner[a][0]] or met[b]:
            continue
        step = place[a] - place[b]
        beside = abs(float(outward[b][0] * step[1] - outward[b][1] * step[0]))
        if -(outward[a] @ outward[b]) >= np.cos(angle) and beside <= BESIDE:
            options.append((float(np.hypot(*step)), a, b))
    used: set[int] = set()
    for _, a, b in sorted(options):
        if a in used or b in used:
            continue
        used |= {a, b}
        (k, end), target = owner[a], points[owner[b][0]][owner[b][1], :2]
        line = points[k] if end else points[k][::-1]
        # What reaches beyond the end that it is put onto would run back and forth.
        over = (line[:, :2] - target) @ outward[b] < OVERLAP
        count = 1 if over.all() else max(int(np.argmin(over[::-1])), 1)
        line[-count:, :2] = target
