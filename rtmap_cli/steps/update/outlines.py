"""Outlines of ring classes (crossings) from their confidence grid.

A region is what has at least half of the highest confidence around it. Crossings that share a
corner differ in direction: the long axes of the detected outlines tell them apart, and each is
drawn from the part of the confidence that has its direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.blocks import SIDE, Float, Layout, find, pack, unpack
from rtmap_cli.geometry.skeleton import neighbours
from rtmap_cli.steps.update.accumulate import Heat

Array = NDArray[np.float64]
Int = NDArray[np.int64]

SMALLEST = 4.0
"""Outlines of less area (m²) are none."""
SHARE = 0.5
"""Of the highest confidence: where an outline is. Symmetric errors leave the border there."""
AROUND = 4
"""Grid cells around one within which the highest confidence is looked for."""
COHERENT = 0.6
"""Where so much of the confidence has one direction, it is one crossing's."""
WINDOW = 4.0
"""Metres around the core of an outline in which it may lie."""
SAME = 0.3
"""Outlines that share so much (intersection over union) are one."""
BOX = 0.72
"""A region that fills as much of its smallest rectangle is that rectangle."""


@dataclass(frozen=True)
class Line:
    """One extracted element: ``points`` (n, 2) in the map frame (a ring closed), its mean
    ``confidence`` and the number of ``drives`` behind it."""

    class_name: str
    points: Array
    confidence: float
    drives: float


def outlines(heat: Heat, class_name: str, low: float) -> list[Line]:
    """Outlines of a ring class of at least ``low`` confidence; the surest of those that overlap."""
    field = heat.confidence(class_name)
    layout = heat.layout
    drives = heat.drives(class_name).ravel()
    mask = (field >= low) & (field >= SHARE * local_maximum(layout, field, AROUND))
    looked = np.maximum(heat.looked, 1.0)
    cosine, sine = (part / looked for part in heat.axis[class_name])
    coherent = np.hypot(cosine, sine) >= COHERENT * field
    found = []
    for core in regions(layout.cells(np.flatnonzero(mask & coherent))):
        place = layout.places(core)
        turn = float(np.arctan2(sine.ravel()[place].sum(), cosine.ravel()[place].sum()))
        aligned = (field + cosine * np.cos(turn) + sine * np.sin(turn)) / 2
        found.append(_grown(layout, np.asarray(aligned, np.float32), core, low))
    # Square ones have no direction: regions where none was found, as they are.
    rest = regions(layout.cells(np.flatnonzero(mask)))
    out: list[Line] = []
    shapes: list[object] = []
    for group in (found, rest):
        for part in sorted(group, key=lambda p: -float(field.ravel()[layout.places(p)].sum())):
            _add(part, layout, class_name, field.ravel(), drives, out, shapes)
    return out


def _add(
    part: Int,
    layout: Layout,
    class_name: str,
    field: Float,
    drives: Float,
    out: list[Line],
    shapes: list[object],
) -> None:
    """The outline of a region, unless it is too small or lies on one that is there."""
    import shapely

    outline = _outline(part, layout.cell)
    if outline is None:
        return
    shape = shapely.Polygon(outline)
    for other in shapes:
        common = shapely.intersection(shape, other).area
        if common > SAME * min(shape.area, shapely.area(other)):
            return
    place = layout.places(part)
    shapes.append(shape)
    confidence, behind = float(field[place].mean()), float(np.median(drives[place]))
    out.append(Line(class_name, outline, confidence, behind))


def local_maximum(layout: Layout, field: Float, width: int) -> Float:
    """(blocks, SIDE, SIDE) the largest value within ``width`` cells."""
    from scipy.ndimage import maximum_filter

    wide = layout.halo(field, width)
    found = maximum_filter(wide, size=(1, 2 * width + 1, 2 * width + 1))
    return np.asarray(found[:, width : width + SIDE, width : width + SIDE], np.float32)


def regions(cells: Int) -> list[Int]:
    """Cells (n, 2) by connected region (four neighbours), in a fixed order."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    keys = np.unique(pack(cells))
    if not len(keys):
        return []
    around = neighbours(keys)[:, 1::2]
    row = np.repeat(np.arange(len(keys)), 4)
    column = around.ravel()
    there = column < len(keys)
    graph = coo_matrix(
        (np.ones(int(there.sum())), (row[there], column[there])), shape=(len(keys), len(keys))
    )
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(label, kind="stable")
    return np.split(unpack(keys[order]), np.cumsum(np.bincount(label))[:-1])


def _grown(layout: Layout, aligned: Float, core: Int, low: float) -> Int:
    """The region around a core where its part of the confidence is above half of its highest."""
    width = int(np.ceil(WINDOW / layout.cell))
    start, stop = core.min(axis=0) - width, core.max(axis=0) + width + 1
    grid = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(start, stop, strict=True))), -1)
    cells = grid.reshape(-1, 2)
    place = layout.places(cells)
    value = np.where(place >= 0, aligned.ravel()[place], 0.0)
    inside = aligned.ravel()[layout.places(core)]
    high = float(np.quantile(inside, 0.9))
    parts = regions(cells[value >= max(SHARE * high, low)])
    keys = pack(core)
    shared = [int((find(np.sort(pack(part)), keys) >= 0).sum()) for part in parts]
    return parts[int(np.argmax(shared))] if any(shared) else core


def _outline(cells: Int, cell: float) -> Array | None:
    """The closed outline (n, 2) of a region: its smallest rectangle where it fills that, else its
    smoothed border; None when it is too small."""
    import shapely

    if len(cells) * cell**2 < SMALLEST:
        return None
    low = cells * cell
    squares = shapely.box(low[:, 0], low[:, 1], low[:, 0] + cell, low[:, 1] + cell)
    shape = shapely.union_all(squares)
    if shape.geom_type != "Polygon":
        shape = max(shape.geoms, key=lambda part: part.area)
    box = shapely.minimum_rotated_rectangle(shapely.MultiPoint((cells + 0.5) * cell))
    if box.geom_type == "Polygon":
        box = shapely.buffer(box, cell / 2, join_style="mitre")
        if shape.area >= BOX * box.area:
            # A staircase's rectangle is larger than what it stands for.
            scale = float(np.sqrt(len(cells) * cell**2 / box.area))
            return _scaled(shapely.get_coordinates(box.exterior), max(scale, 0.9))
    border = shapely.get_coordinates(shapely.simplify(shape.exterior, 0.75 * cell))
    return np.asarray(border, np.float64) if len(border) > 3 else None


def _scaled(ring: Array, scale: float) -> Array:
    middle = ring[:-1].mean(axis=0)
    return np.asarray(middle + scale * (ring - middle), np.float64)
