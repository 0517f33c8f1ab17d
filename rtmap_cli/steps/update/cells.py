"""The map split into cells: how well old and new agree in each, and what is flagged.

Agreement is average precision taken both ways (new against old, old against new): either way alone
is blind to what only the other side has. A cell whose agreement is low is a candidate; it is
flagged when something in it explains that: a stretch that is missing or moved. Where nobody looked,
that is the reason, and nothing else can be said.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import clip_to_box, length
from rtmap_cli.maps.element import RING_CLASSES, Element
from rtmap_cli.steps.update.accumulate import Heat
from rtmap_cli.steps.update.compare import MOVED, REASONS, Stretch
from rtmap_cli.steps.update.outlines import Line
from rtmap_cli.steps.update.settings import Settings

Array = NDArray[np.float64]
Int = NDArray[np.int64]

Detection = tuple[str, Array, float]
Judge = Callable[[Sequence[Detection], Sequence[Detection]], dict[str, float]]
"""(predicted, true) elements of a cell → average precision by class; the evaluation lends it."""

NEVER = "never observed"
UNCLEAR = "unclear"
OBSERVED = 0.25
"""Share of a cell that some drive must have looked at."""
LEAST = 1.0
"""Metres of a stretch in a cell that make it a reason."""
PLENTY = 2.0
"""Metres of a stretch that are a reason whatever the precision is."""
PIECE = 0.5
"""Shorter pieces (m) that a cell cuts off are none."""


@dataclass(frozen=True)
class Cell:
    """One cell, from ``low`` (2,) over ``size`` metres: ``ap`` how well old and new agree (NaN:
    there is nothing to compare), by class in ``classes``; ``reason`` of the flag (empty: none),
    metres of stretches by reason, and the share of it that was ``observed``."""

    low: tuple[float, float]
    size: float
    ap: float
    classes: dict[str, float]
    reason: str
    metres: dict[str, float]
    observed: float

    @property
    def flagged(self) -> bool:
        """Whether something in it is to be updated."""
        return self.reason in REASONS

    @property
    def ring(self) -> Array:
        """(5, 2) its border."""
        (x, y), s = self.low, self.size
        return np.array([[x, y], [x + s, y], [x + s, y + s], [x, y + s], [x, y]])


def judge_cells(
    old: Sequence[Element],
    new: Sequence[Line],
    stretches: Sequence[Stretch],
    heat: Heat,
    judge: Judge,
    settings: Settings,
) -> list[Cell]:
    """All cells that hold something of either side and lie in reach of the drives."""
    size = settings.cell_m
    olds = _by_cell([(e.class_name, e.points[:, :2], 1.0) for e in old], size)
    news = _by_cell([(n.class_name, n.points, n.confidence) for n in new], size)
    within = [(s.reason, s.class_name, p) for s in stretches for p in _places(s)]
    reasons = _by_cell(
        [(name, p, float(REASONS.index(r))) for r, name, p in within], size, whole=False
    )
    seen = _observed(heat, size)
    out = []
    for key in sorted((olds.keys() | news.keys()) & seen.keys()):
        a, b = olds.get(key, []), news.get(key, [])
        metres = dict.fromkeys(REASONS, 0.0)
        for _, part, code in reasons.get(key, []):
            metres[REASONS[int(code)]] += length(part)
        classes = _agreement(a, b, judge)
        ap = float(np.mean(list(classes.values()))) if classes else float("nan")
        lowest = min(classes.values(), default=1.0)
        reason = _reason(lowest, metres, seen[key], settings)
        low = (key[0] * size, key[1] * size)
        out.append(Cell(low, size, ap, classes, reason, metres, seen[key]))
    return out


def flagged_stretches(stretches: Sequence[Stretch], cells: Sequence[Cell]) -> list[Stretch]:
    """The stretches of which some part lies in a flagged cell."""
    size = cells[0].size if cells else 1.0
    flagged = {(round(c.low[0] / size), round(c.low[1] / size)) for c in cells if c.flagged}
    out = []
    for s in stretches:
        keys = np.floor(np.concatenate(_places(s)) / size).astype(np.int64)
        if flagged & {(int(x), int(y)) for x, y in keys}:
            out.append(s)
    return out


def _places(stretch: Stretch) -> list[Array]:
    """Where a stretch makes a difference: a moved one at both of its places."""
    return [stretch.points, stretch.before] if len(stretch.before) > 1 else [stretch.points]


def _reason(lowest: float, metres: dict[str, float], observed: float, settings: Settings) -> str:
    name = max(REASONS, key=lambda r: metres[r])
    # A few metres of a long line that goes on cost no precision; one that moved far does.
    if lowest >= settings.max_ap and (name == MOVED or metres[name] < PLENTY):
        return ""
    if metres[name] >= LEAST:
        return name
    return NEVER if observed < OBSERVED else UNCLEAR


def _agreement(a: list[Detection], b: list[Detection], judge: Judge) -> dict[str, float]:
    """By class of either side the lower one of the precisions both ways."""
    if not a or not b:
        return dict.fromkeys(sorted({e[0] for e in a + b}), 0.0)
    there, back = judge(b, a), judge(a, b)
    names = sorted({e[0] for e in a + b})
    return {n: min(there.get(n, 0.0), back.get(n, 0.0)) for n in names}


def _by_cell(
    items: Sequence[Detection], size: float, whole: bool = True
) -> dict[tuple[int, int], list[Detection]]:
    """The pieces of elements by the cell that they lie in; outlines stay closed if ``whole``."""
    out: dict[tuple[int, int], list[Detection]] = {}
    for name, points, value in items:
        low = np.floor(points.min(axis=0) / size).astype(int)
        high = np.floor(points.max(axis=0) / size).astype(int)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                box = (i * size, j * size, (i + 1) * size, (j + 1) * size)
                ring = whole and name in RING_CLASSES
                for piece in _clipped(points, box) if ring else clip_to_box(points, box):
                    if length(piece) >= PIECE:
                        out.setdefault((i, j), []).append((name, piece, value))
    return out


def _clipped(ring: Array, box: tuple[float, float, float, float]) -> list[Array]:
    """The part of an outline inside a box, closed."""
    import shapely

    shape = shapely.make_valid(shapely.Polygon(ring)) if len(ring) > 3 else shapely.Polygon()
    part = shapely.intersection(shape, shapely.box(*box))
    shapes = shapely.get_parts(part)
    return [
        shapely.get_coordinates(s.exterior)
        for s in shapes
        if s.geom_type == "Polygon" and s.area >= PIECE
    ]


def _observed(heat: Heat, size: float) -> dict[tuple[int, int], float]:
    """By cell the share of it that some drive looked at; cells in no block are not there."""
    n = heat.looked.size
    every = np.arange(0, n, 1)
    # One grid cell in sixteen is enough: looks are counted for squares of four by four.
    side = heat.looked.shape[-1] if len(heat.looked) else 1
    rows, columns = (every // side) % side, every % side
    every = every[(rows % 4 == 1) & (columns % 4 == 1)]
    xy = heat.layout.centres(every)
    key = np.floor(xy / size).astype(np.int64)
    cells, which = np.unique(key, axis=0, return_inverse=True)
    hit = np.bincount(which.ravel(), heat.looked.ravel()[every] > 0, len(cells))
    total = (size / (4 * heat.layout.cell)) ** 2
    return {
        (int(x), int(y)): float(min(h / total, 1.0)) for (x, y), h in zip(cells, hit, strict=True)
    }
