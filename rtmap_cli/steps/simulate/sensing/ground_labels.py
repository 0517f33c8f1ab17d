"""What the ground of a world is, place by place: road, paint, kerbs, sidewalks, verge."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.steps.simulate.worlds.world import World
from rtmap_cli.steps.simulate.worlds.world_ground import layout_of, opencv

Array = NDArray[np.float64]
Labels = NDArray[np.uint8]

LABELS = (
    "void--unlabeled",
    "construction--flat--road",
    "construction--flat--crosswalk-plain",
    "marking--general",
    "construction--barrier--curb",
    "construction--flat--sidewalk",
    "nature--terrain",
    "nature--sky",
    "nature--vegetation",
    "construction--structure--building",
    "object--vehicle--car",
)
"""The label list of simulated masks, in Mapillary's names."""

VOID, ROAD, CROSSWALK, MARKING, CURB, SIDEWALK, TERRAIN, SKY, TREE, BUILDING, VEHICLE = range(11)
PAINTED, RAISED = 0x80, 0x40
"""Bits of a place that is covered with paint, or that lies behind the curb, whatever its label."""
LABEL = 0x3F
"""The label without them."""

CELL, TILE = 0.05, 512
"""Size of a cell (m), cells along a side of a tile."""
SUBPIXEL = 4


class GroundLabels:
    """Labels of the ground of a world, drawn in tiles where they are asked for."""

    def __init__(self, world: World) -> None:
        self.world, self.layout = world, layout_of(world)
        self.side = TILE * CELL
        rings = [e.xy for e in world.vector_map.of_class("ped_crossing")]
        self._crossings = [r for r in rings if len(r) > 3]
        self._boxes = [_boxes(s) for s in (world.curbs, self._paint(), self._crossings)]
        self._tiles: dict[tuple[int, int], Labels] = {}

    def _paint(self) -> list[Array]:
        return [p.polygon for p in self.world.paint]

    def at(self, xy: Array) -> Labels:
        """(n,) labels (with the bits `PAINTED` and `RAISED`) of places (n, 2) in the map frame."""
        ij = np.floor(xy / CELL).astype(np.int64)
        tiles = ij // TILE
        out = np.empty(len(xy), np.uint8)
        if not len(xy):
            return out
        low = tiles.min(axis=0)
        key = (tiles[:, 1] - low[1]) * (int(np.ptp(tiles[:, 0])) + 1) + tiles[:, 0] - low[0]
        order = np.argsort(key, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            ti, tj = tiles[rows[0]].tolist()
            tile = self._tile(ti, tj)
            out[rows] = tile[ij[rows, 1] - tj * TILE, ij[rows, 0] - ti * TILE]
        return out

    def _tile(self, ti: int, tj: int) -> Labels:
        if (ti, tj) not in self._tiles:
            self._tiles[ti, tj] = self._draw(ti * self.side, tj * self.side)
        return self._tiles[ti, tj]

    def _draw(self, x0: float, y0: float) -> Labels:
        """One tile with its lower left corner at (x0, y0)."""
        cv2, world = opencv(), self.world
        labels = np.full((TILE, TILE), TERRAIN, np.uint8)

        def fill(image: Labels, rings: list[Array], value: int) -> None:
            scaled = [((r - (x0, y0)) / CELL - 0.5) * (1 << SUBPIXEL) for r in rings]
            pixels = [np.round(s).astype(np.int32) for s in scaled]
            if pixels:
                cv2.fillPoly(image, pixels, value, cv2.LINE_8, SUBPIXEL)

        margin = 4.0 + self.layout["sidewalk_width"]
        far = (x0 - margin, y0 - margin, x0 + self.side + margin, y0 + self.side + margin)
        window = shapely.box(*far)
        area = shapely.intersection(world.surface, window)
        if self.layout["sidewalk_width"] and not area.is_empty:
            walk = shapely.buffer(area, self.layout["sidewalk_width"], quad_segs=2)
            fill(labels, _rings(walk), SIDEWALK)
        fill(labels, _rings(area), ROAD)
        curbs, paint, crossings = (np.flatnonzero(_near(b, far)).tolist() for b in self._boxes)
        for k in curbs:
            part = shapely.clip_by_rect(shapely.linestrings(world.curbs[k]), *far)
            if not part.is_empty:
                width = self.layout["curb_width"]
                strip = shapely.buffer(part, width / 2, cap_style="flat", join_style="mitre")
                fill(labels, _rings(strip), CURB)
        painted = np.zeros_like(labels)
        for k in paint:
            fill(labels, [world.paint[k].polygon], MARKING)
            fill(painted, [world.paint[k].polygon], PAINTED)
        for k in crossings:
            fill(labels, [self._crossings[k]], CROSSWALK)
        behind = np.full_like(labels, RAISED)
        fill(behind, _outer(area), 0)
        fill(behind, _holes(area), RAISED)
        out: Labels = labels | painted | behind
        return out


def _boxes(shapes: list[Array]) -> Array:
    """(n, 4) bounding boxes x0, y0, x1, y1."""
    return np.array([(*s.min(axis=0), *s.max(axis=0)) for s in shapes]).reshape(-1, 4)


def _near(boxes: Array, window: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    """(n,) which boxes touch a window."""
    x0, y0, x1, y1 = window
    return np.asarray(
        (boxes[:, 0] <= x1) & (boxes[:, 2] >= x0) & (boxes[:, 1] <= y1) & (boxes[:, 3] >= y0)
    )


def _outer(area: Any) -> list[Array]:
    """Outlines of all polygons of an area."""
    return [np.asarray(p.exterior.coords) for p in _polygons(area)]


def _holes(area: Any) -> list[Array]:
    """Holes of all polygons of an area."""
    return [np.asarray(r.coords) for p in _polygons(area) for r in p.interiors]


def _rings(area: Any) -> list[Array]:
    """Outlines and holes of all polygons of an area."""
    return [
        np.asarray(ring.coords)
        for part in _polygons(area)
        for ring in (part.exterior, *part.interiors)
    ]


def _polygons(area: Any) -> list[Any]:
    """The polygons of an area that hold something."""
    parts = shapely.get_parts(area)
    return [p for p in parts if p.geom_type == "Polygon" and not p.is_empty]
