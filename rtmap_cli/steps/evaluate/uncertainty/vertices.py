"""Errors across the line of detected vertices, and which detections are real.

Detections meet true elements as in the AP protocol: frame by frame (a map: cell by cell), each
takes its nearest true element only. Vertices slide along lines, where their error means nothing:
what counts is how far a vertex lies from the true line, across it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.chamfer import bands, chamfer_pairs, sample_lines
from rtmap_cli.geometry.polylines import clip_to_box, is_ring, join_lines, length
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap
from rtmap_cli.steps.evaluate.maps.frames import MIN_AREA, MIN_LENGTH
from rtmap_cli.steps.evaluate.maps.precision import PROTOCOLS, Detection

Array = NDArray[np.float64]

THRESHOLD = 1.5
"""A detection is real when a free true element is within this Chamfer distance, metres."""
MAX_BEYOND = 1.0
"""Vertices farther than this beyond the open end of their true line (m) are not compared."""


@dataclass(frozen=True)
class Vertices:
    """Vertices of real detections: ``error`` across the true line and its stated ``sigma`` (n,) in
    metres, class and group (what errs together) of each. ``beyond`` counts those past the end of
    their line, ``silent`` those without a sigma."""

    error: Array
    sigma: Array
    class_name: NDArray[Any]
    group: NDArray[Any]
    beyond: int = 0
    silent: int = 0

    def __len__(self) -> int:
        return len(self.error)

    @staticmethod
    def together(parts: Sequence[Vertices]) -> Vertices:
        """All vertices of several parts."""
        if not parts:
            text = np.zeros(0, object)
            return Vertices(np.zeros(0), np.zeros(0), text, text)
        return Vertices(
            np.concatenate([p.error for p in parts]),
            np.concatenate([p.sigma for p in parts]),
            np.concatenate([p.class_name for p in parts]),
            np.concatenate([p.group for p in parts]),
            sum(p.beyond for p in parts),
            sum(p.silent for p in parts),
        )


def real_ones(
    predicted: Sequence[Detection], true: Sequence[Detection], threshold: float = THRESHOLD
) -> NDArray[np.int64]:
    """(n,) index of the true element that each prediction of a frame hits, -1 for none.

    The rule of ``rtmap evaluate map`` (protocols rtmap and maptr): class by class, by falling
    score, only the nearest true element, if it is free, within ``threshold`` (m) and their 2 m
    bands touch.
    """
    out = np.full(len(predicted), -1, np.int64)
    for name in dict.fromkeys(p[0] for p in predicted):
        rows = np.array([k for k, p in enumerate(predicted) if p[0] == name and len(p[1]) > 1], int)
        columns = np.array([k for k, t in enumerate(true) if t[0] == name], int)
        if not len(rows) or not len(columns):
            continue
        distance = _distances(
            [predicted[k][1] for k in rows], [true[k][1] for k in columns], threshold
        )
        free = np.ones(len(columns), dtype=bool)
        for k in np.argsort([-predicted[r][2] for r in rows], kind="stable"):
            nearest = int(distance[k].argmin())
            if distance[k, nearest] <= threshold and free[nearest]:
                out[rows[k]], free[nearest] = columns[nearest], False
    return out


def _distances(lines: list[Array], targets: list[Array], limit: float) -> Array:
    """(n, m) Chamfer distances; infinite beyond ``limit`` and where bands do not touch."""
    import shapely

    rule = PROTOCOLS["rtmap"]
    a, b = sample_lines(lines, rule.samples), sample_lines(targets, rule.samples)
    for k, line in enumerate(lines):
        if rule.keep_sampled and len(line) == rule.samples:
            a[k] = line[:, :2]
    i, j = (k.ravel() for k in np.indices((len(a), len(b))))
    found = chamfer_pairs(a, b, i, j, limit)
    near = np.flatnonzero(np.isfinite(found))
    if rule.band is not None and len(near):
        wide = bands(a, rule.band), bands(b, rule.band)
        near = near[shapely.intersects(wide[0][i[near]], wide[1][j[near]])]
    out = np.full((len(a), len(b)), np.inf)
    out[i[near], j[near]] = found[near]
    return out


def across(points: Array, line: Array) -> tuple[Array, Array, Array]:
    """How far points (n, 2) lie from a polyline, across it.

    Returns the signed distance (n,) to the straight line through the nearest segment (left is
    positive), the unit normal (n, 2) of that segment, and how far (n,) a point lies beyond an open
    end (0 beside the line and on rings).
    """
    p, q = np.asarray(points, np.float64)[:, :2], np.asarray(line, np.float64)[:, :2]
    step = np.hypot(*np.diff(q, axis=0).T)
    q = q[np.concatenate([[True], step > 0])]
    a, way = q[:-1], np.diff(q, axis=0)
    size = np.hypot(way[:, 0], way[:, 1])
    unit = way / size[:, None]
    offset = p[:, None] - a
    along = (offset * unit).sum(axis=-1)
    foot = a + np.clip(along, 0.0, size)[..., None] * unit
    best = ((p[:, None] - foot) ** 2).sum(axis=-1).argmin(axis=1)
    row = np.arange(len(p))
    normal = np.column_stack([-unit[best, 1], unit[best, 0]])
    error = (offset[row, best] * normal).sum(axis=1)
    before = np.where(best == 0, -along[row, best], 0.0)
    after = np.where(best == len(a) - 1, along[row, best] - size[best], 0.0)
    beyond = np.zeros(len(p)) if is_ring(line) else np.maximum(0.0, np.maximum(before, after))
    return error, normal, beyond


def compare_vertices(
    points: Array, covariance: Array, line: Array, class_name: str, group: Any
) -> Vertices:
    """Vertices (n, 2) with planar covariances (n, 3: xx, xy, yy in m²) against their true line.

    The sigma across is √(nᵀ C n) with the true line's normal n.
    """
    error, normal, beyond = across(points, line)
    xx, xy, yy = covariance.T
    x, y = normal.T
    variance = x * x * xx + 2 * x * y * xy + y * y * yy
    stated = variance > 0  # NaN: nothing is stated.
    kept = stated & (beyond <= MAX_BEYOND)
    n = int(kept.sum())
    groups = np.empty(n, object)
    groups[:] = [group] * n
    return Vertices(
        error[kept],
        np.sqrt(variance[kept]),
        np.full(n, class_name, object),
        groups,
        beyond=int((stated & ~kept).sum()),
        silent=int((~stated).sum()),
    )


@dataclass(frozen=True)
class _Piece:
    """What of a fused element lies in a cell: ``line`` (k, 2), its vertices with covariances."""

    class_name: str
    line: Array
    score: float
    points: Array
    covariance: Array


def map_vertices(
    fused: VectorMap, scores: dict[str, float], truth: VectorMap, cells: Array, size: float
) -> tuple[Vertices, int, int]:
    """Vertices of a map, each in the one cell in which it lies; real and all pieces of elements.

    ``cells`` (n, 2) centres of squares of edge ``size`` (m), edges at its multiples; ``scores``
    probabilities by element id; ``truth`` with its lines joined. In every cell the pieces of both
    maps meet as in a frame.
    """
    parts, real, count = [], 0, 0
    left, right = _Boxes([_columns(e, scores) for e in fused]), _Boxes([e.xy for e in truth])
    for centre in cells:
        box: Range = (*(centre - size / 2).tolist(), *(centre + size / 2).tolist())
        mine = list(_pieces(fused.elements, left, box))
        true = [p for k in right.near(box) for p in _true_pieces(truth.elements[k], box)]
        hits = real_ones(
            [(p.class_name, p.line, p.score) for p in mine], [(n, x, 1.0) for n, x, _ in true]
        )
        real, count = real + int((hits >= 0).sum()), count + len(mine)
        for piece, hit in zip(mine, hits.tolist(), strict=True):
            if hit >= 0 and len(piece.points):
                whole = true[hit][2]
                parts.append(
                    compare_vertices(
                        piece.points, piece.covariance, whole, piece.class_name, tuple(box)
                    )
                )
    return Vertices.together(parts), real, count


class _Boxes:
    """Lines with their bounding boxes."""

    def __init__(self, lines: list[Array]) -> None:
        self.lines = lines
        boxes = [(*x[:, :2].min(axis=0), *x[:, :2].max(axis=0)) for x in lines]
        self.boxes = np.array(boxes, np.float64).reshape(-1, 4)

    def near(self, box: Range) -> list[int]:
        """Rows of the lines whose bounding box touches ``box``."""
        b = self.boxes
        hit = (b[:, 0] <= box[2]) & (b[:, 2] >= box[0]) & (b[:, 1] <= box[3]) & (b[:, 3] >= box[1])
        return [int(k) for k in np.flatnonzero(hit)]


def _columns(element: Element, scores: dict[str, float]) -> Array:
    """(n, 7): x, y, a mark, covariance xx, xy, yy (NaN: not stated), score.

    The mark is 0 and 1 by turns: where a line is cut it lies between, so that vertices that only
    cutting made are told from the map's own.
    """
    n = len(element.points)
    covariance = np.full((n, 3), np.nan)
    if element.covariance is not None:
        covariance = element.covariance[:, :3]
    score = np.full(n, scores[element.element_id])
    return np.column_stack([element.xy, np.arange(n) % 2, covariance, score])


def _pieces(elements: Sequence[Element], lines: _Boxes, box: Range) -> Iterator[_Piece]:
    """The pieces of a fused map in a cell, lines that meet end to end as one."""
    cut: dict[str, list[Array]] = {}
    for k in lines.near(box):
        element, columns = elements[k], lines.lines[k]
        name = element.class_name
        if name in RING_CLASSES:
            inside = (columns[:-1, :2] >= box[:2]) & (columns[:-1, :2] < box[2:])
            own = columns[:-1][inside.all(axis=1)]
            for ring in _ring_pieces(columns[:, :2], box):
                yield _Piece(name, ring, float(columns[0, 6]), own[:, :2], own[:, 3:6])
        else:
            cut.setdefault(name, []).extend(clip_to_box(columns, box))
    for name, pieces in cut.items():
        for line in join_lines(pieces):
            if length(line) >= MIN_LENGTH:
                own = line[np.isin(line[:, 2], (0.0, 1.0))]
                score = float(line[:, 6].mean())
                yield _Piece(name, line[:, :2], score, own[:, :2], own[:, 3:6])


def _true_pieces(element: Element, box: Range) -> list[tuple[str, Array, Array]]:
    """Class, piece in the cell, and what vertices are compared with: the line itself, not cut."""
    name = element.class_name
    if name in RING_CLASSES:
        return [(name, ring, element.xy) for ring in _ring_pieces(element.xy, box)]
    pieces = [p for p in clip_to_box(element.xy, box) if length(p) >= MIN_LENGTH]
    return [(name, piece, piece) for piece in pieces]


def _ring_pieces(ring: Array, box: Range) -> list[Array]:
    """A ring cut to a box, closed along the cut."""
    import shapely

    polygon = shapely.polygons(ring)
    cut = shapely.clip_by_rect(polygon if polygon.is_valid else polygon.buffer(0), *box)
    parts = [p for p in shapely.get_parts(cut) if p.geom_type == "Polygon" and p.area >= MIN_AREA]
    return [np.asarray(p.exterior.coords) for p in parts]
