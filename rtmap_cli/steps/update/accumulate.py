"""Accumulation: what all drives predicted, in map coordinates, as one confidence grid per class.

Every detection is laid into a grid once: lines by the length that they have in each cell, outlines
by the cells that they cover. Of a drive this becomes Σ w · score · hit / Σ w over the frames that
had the place in view, w = 1 / (1 + (r / clear)²) of the frame's distance r: the share of its looks
that found a line there, weighted by their scores. The mean over the drives is the confidence: a
drive has one vote, however many frames it has. Nothing is done frame by frame or line by line.
With an old map the same is done again for what none of its lines claims.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.blocks import SIDE, Float, Layout, cells_inside, gaussian, points_along
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.element import RING_CLASSES, VectorMap
from rtmap_cli.maps.visibility import views
from rtmap_cli.steps.update.claims import Claims, Drive, loose_rings
from rtmap_cli.steps.update.settings import Settings

Array = NDArray[np.float64]
Int = NDArray[np.int64]

SQUARE = 4
"""Grid cells of a side of the squares in which looks are counted."""
MOST = 1.2
"""Larger shares come from places that hardly any frame looked at."""


@dataclass
class Heat:
    """The accumulation of all drives on one ``layout``.

    ``looked`` (blocks, SIDE, SIDE): drives that looked at a cell. By class: ``total`` the sum over
    drives of their blurred shares, ``squares`` of these squared: (Σ s)² / Σ s² is how many drives
    stand behind a place. ``axis`` of ring classes: the same sum weighted by cos 2θ and sin 2θ of
    the outlines' long axes, which tells crossings apart that share a corner.
    """

    layout: Layout
    looked: Float
    total: dict[str, Float]
    squares: dict[str, Float]
    axis: dict[str, tuple[Float, Float]]

    @staticmethod
    def empty(layout: Layout, classes: Sequence[str]) -> Heat:
        """Grids in which nothing lies yet."""
        return Heat(
            layout,
            layout.zeros(),
            {name: layout.zeros() for name in classes},
            {name: layout.zeros() for name in classes},
            {n: (layout.zeros(), layout.zeros()) for n in classes if n in RING_CLASSES},
        )

    def add(self, class_name: str, layout: Layout, share: Float, *axis: Float) -> None:
        """The shares of one drive, on a layout of its own; of ring classes with their axes."""
        self.layout.add(self.total[class_name], share, layout)
        self.layout.add(self.squares[class_name], share**2, layout)
        for total, part in zip(self.axis.get(class_name, ()), axis, strict=True):
            self.layout.add(total, part, layout)

    def confidence(self, class_name: str) -> Float:
        """(blocks, SIDE, SIDE) mean share of looks that found the class there, 0 where nobody
        looked."""
        return np.asarray(self.total[class_name] / np.maximum(self.looked, 1.0), np.float32)

    def drives(self, class_name: str) -> Float:
        """(blocks, SIDE, SIDE) how many drives stand behind the confidence: 1 where one has it
        all."""
        total, squares = self.total[class_name], self.squares[class_name]
        return np.asarray(total**2 / np.maximum(squares, 1e-12), np.float32)


@dataclass(frozen=True)
class Accumulated:
    """``heat`` of everything; of classes that an old map has the ``rest``: the grids of what its
    elements leave; what its lines claim (``claims``)."""

    heat: Heat
    rest: Heat
    claims: dict[str, Claims] = field(default_factory=dict)


def accumulate(
    traversals: Iterable[Traversal],
    classes: Sequence[str],
    layout: Layout,
    settings: Settings,
    old: VectorMap | None = None,
) -> Accumulated:
    """The grids of some drives; time and memory grow with what they saw, one drive at a time."""
    heat = Heat.empty(layout, classes)
    known = {name: old.of_class(name) for name in classes} if old else {}
    known = {name: elements for name, elements in known.items() if elements}
    claims = {n: Claims.empty(elements) for n, elements in known.items() if n not in RING_CLASSES}
    rest = Heat.empty(layout, list(known))
    for traversal in traversals:
        own = layout_of([traversal], settings)
        looks = looks_of(traversal, own, settings)
        seen = looks >= settings.least_looks
        for total in (heat.looked, rest.looked):
            layout.add(total, seen.astype(np.float32), own)
        looks[~seen] = np.inf
        for name in classes:
            if name in RING_CLASSES:
                heat.add(name, own, *_covered(traversal, name, own, looks, settings))
                if name in known:
                    loose = loose_rings(traversal, name, known[name])
                    rest.add(name, own, *_covered(traversal, name, own, looks, settings, loose))
                continue
            marks = _lines_of(traversal, name, settings)
            heat.add(name, own, _drawn(marks, own, looks, settings))
            if name in known:
                drive = Drive.of(traversal, name, claims[name].stations)
                marks = _claimed(drive, claims[name], own, looks, settings)
                rest.add(name, own, _drawn(marks, own, looks, settings))
    return Accumulated(heat, rest, claims)


def _claimed(
    drive: Drive, claims: Claims, layout: Layout, looks: Float, settings: Settings
) -> Marks:
    """Give old lines what they claim of a drive; the marks that are left."""
    s = drive.samples
    weight = _weights(drive.traversal, s.frame, s.score, s.xy, settings)
    place = layout.places(np.floor(claims.stations.xy / layout.cell).astype(np.int64))
    claims.add(drive, weight, np.append(looks.ravel(), np.float32(np.inf))[place])
    # Samples lie up to some metres apart: repeated along their detections.
    loose = drive.loose
    spacing = s.spacing[loose]
    repeat = np.maximum(np.ceil(spacing / layout.cell), 1).astype(np.int64)
    row = np.repeat(np.arange(len(loose)), repeat)
    k = np.arange(len(row)) - np.repeat(np.cumsum(repeat) - repeat, repeat)
    shift = ((k + 0.5) / repeat[row] - 0.5) * spacing[row]
    xy = s.xy[loose][row] + shift[:, None] * s.tangent[loose][row]
    return xy, weight[loose][row] * (spacing / repeat)[row]


def layout_of(traversals: Sequence[Traversal], settings: Settings) -> Layout:
    """The blocks that some drives could see."""
    parts = []
    for t in traversals:
        corners = np.array(t.range_m).reshape(2, 2)
        reach = float(np.hypot(*np.abs(corners).max(axis=0)))
        parts.append(Layout.around(t.pose[:, :2], reach, settings.grid_m))
    return Layout.union(parts, settings.grid_m)


def clarity(distance: Array, settings: Settings) -> Array:
    """(n,) what looks from so far (m) count."""
    return np.asarray(1.0 / (1.0 + (distance / settings.clear_m) ** 2), np.float64)


def looks_of(traversal: Traversal, layout: Layout, settings: Settings) -> Float:
    """(blocks, SIDE, SIDE) the weighted frames of a drive that had each cell in view, counted for
    squares of ``SQUARE`` cells."""
    n = SIDE // SQUARE
    size = SQUARE * settings.grid_m
    squares = Layout(layout.keys, settings.grid_m)
    corner = np.arange(len(layout) * n * n)
    block, rest = np.divmod(corner, n * n)
    flat = block * SIDE * SIDE + (rest // n) * SQUARE * SIDE + (rest % n) * SQUARE
    centres = np.asarray(squares.cells(flat) * settings.grid_m + size / 2, np.float64)
    found = views(
        centres, traversal.pose, traversal.range_m, traversal.occluders, settings.margin_m
    )
    weight = clarity(found.distance, settings)
    looks = np.bincount(found.point, weight, len(centres)).reshape(-1, n, n)
    return np.repeat(np.repeat(looks, SQUARE, axis=1), SQUARE, axis=2).astype(np.float32)


Marks = tuple[Array, Array]
"""Points (n, 2) along lines, and the weight of each times the metres that it stands for."""


def _lines_of(traversal: Traversal, class_name: str, settings: Settings) -> Marks:
    """All detections of a class."""
    mine = np.flatnonzero(traversal.class_name == class_name)
    which, xy, span = points_along(traversal.points[mine], settings.grid_m)
    row = mine[which]
    weight = _weights(traversal, traversal.frame[row], traversal.score[row], xy, settings)
    return xy, weight * span


def _drawn(marks: Marks, layout: Layout, looks: Float, settings: Settings) -> Float:
    """The blurred share of a drive's looks that found a line: 1 on one that every frame finds at
    the same place with a score of 1."""
    xy, weight = marks
    share = np.minimum(layout.deposit(xy, weight / layout.cell) / looks, MOST)
    peak = float(gaussian(settings.blur).max())
    return layout.blur(np.asarray(share, np.float32), settings.blur) / np.float32(peak)


def _covered(
    traversal: Traversal,
    class_name: str,
    layout: Layout,
    looks: Float,
    settings: Settings,
    chosen: Int | None = None,
) -> list[Float]:
    """The blurred share of a drive's looks that found an outline around a cell, and the same
    weighted by cos 2θ and sin 2θ of the outlines' long axes; of all or of the ``chosen`` ones."""
    mine = np.flatnonzero(traversal.class_name == class_name) if chosen is None else chosen
    rings = traversal.points[mine]
    which, cells = cells_inside(rings, settings.grid_m)
    xy = np.asarray((cells + 0.5) * settings.grid_m, np.float64)
    row = mine[which]
    weight = _weights(traversal, traversal.frame[row], traversal.score[row], xy, settings)
    off = rings - rings.mean(axis=1, keepdims=True)
    xx_yy = (off[..., 0] ** 2 - off[..., 1] ** 2).sum(axis=1)
    xy_xy = 2 * (off[..., 0] * off[..., 1]).sum(axis=1)
    size = np.maximum(np.hypot(xx_yy, xy_xy), 1e-9)
    out = []
    for turn in (np.ones(len(rings)), xx_yy / size, xy_xy / size):
        share = layout.count(cells, weight * turn[which]) / looks
        out.append(layout.blur(np.asarray(np.clip(share, -MOST, MOST), np.float32), settings.blur))
    return out


def _weights(
    traversal: Traversal, frame: Int, score: Array, xy: Array, settings: Settings
) -> Array:
    """(n,) clarity · score of points that frames have at ``xy``; 0 in the border of the range,
    which is not looked at."""
    x, y, yaw = traversal.pose[frame].T
    dx, dy = xy[:, 0] - x, xy[:, 1] - y
    c, s = np.cos(yaw), np.sin(yaw)
    ahead, left = c * dx + s * dy, c * dy - s * dx
    x0, y0, x1, y1 = traversal.range_m
    m = settings.margin_m
    inside = (ahead >= x0 + m) & (ahead <= x1 - m) & (left >= y0 + m) & (left <= y1 - m)
    return clarity(np.hypot(dx, dy), settings) * score * inside
