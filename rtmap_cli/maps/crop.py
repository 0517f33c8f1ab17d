"""What of a map lies in the range of a frame: the local map in the ego frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import clip_to_box, join_lines, length
from rtmap_cli.geometry.poses import invert, transform
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap

Array = NDArray[np.float64]

Range = tuple[float, float, float, float]
DEFAULT_RANGE: Range = (-36.0, -18.0, 36.0, 18.0)
"""Ego-frame box x_min, y_min, x_max, y_max in metres: the range of the paper."""


@dataclass(frozen=True)
class LocalElement:
    """A piece of a map element inside the range: ``points`` (n, 3) in the ego frame, metres.

    A crossing cut by the range is closed along the cut. ``source`` is the element it comes from.
    """

    class_name: str
    points: Array
    source: Element


def joined(vector_map: VectorMap, tolerance: float = 0.01) -> VectorMap:
    """The map with the pieces of each class of line joined end to end (evaluation needs this).

    Lines cut for storage meet again; a joined line keeps the id of its first piece only.
    """
    out: list[Element] = []
    for name in dict.fromkeys(e.class_name for e in vector_map):
        elements = vector_map.of_class(name)
        if name in RING_CLASSES:
            out.extend(elements)
            continue
        for k, line in enumerate(join_lines([e.points for e in elements], tolerance)):
            out.append(Element(f"{name}-joined-{k}", name, line))
    return VectorMap(out, vector_map.crs, vector_map.version)


class MapIndex:
    """Crops of one map along a drive: bounding boxes first, exact clipping after."""

    def __init__(self, vector_map: VectorMap, join: bool = False) -> None:
        """``join`` joins pieces end to end first (ids are lost; meant for evaluation)."""
        self.map = joined(vector_map) if join else vector_map
        self.elements = list(self.map)
        boxes = [(*e.xy.min(axis=0), *e.xy.max(axis=0)) for e in self.elements]
        self.boxes = np.array(boxes, dtype=np.float64).reshape(-1, 4)

    def near(self, x: float, y: float, radius: float) -> list[Element]:
        """Elements whose bounding box touches the square of half width ``radius`` around x, y."""
        b = self.boxes
        hit = (b[:, 0] <= x + radius) & (b[:, 2] >= x - radius)
        hit &= (b[:, 1] <= y + radius) & (b[:, 3] >= y - radius)
        return [self.elements[i] for i in np.flatnonzero(hit)]

    def crop(
        self,
        map_SE3_ego: Array,
        range_m: Range = DEFAULT_RANGE,
        min_length: float = 0.5,
        margin: float = 0.0,
    ) -> list[LocalElement]:
        """Elements in range of a frame, in the ego frame.

        ``margin`` (m) widens the range on all sides; pieces of lines shorter than ``min_length``
        and slivers of crossings are dropped. Order follows the map.
        """
        x0, y0, x1, y1 = range_m
        box = (x0 - margin, y0 - margin, x1 + margin, y1 + margin)
        reach = float(np.hypot(max(abs(box[0]), abs(box[2])), max(abs(box[1]), abs(box[3]))))
        ego_SE3_map = invert(map_SE3_ego)
        out: list[LocalElement] = []
        for element in self.near(map_SE3_ego[0, 3], map_SE3_ego[1, 3], reach):
            points = transform(ego_SE3_map, element.points)
            if element.class_name in RING_CLASSES:
                pieces = _clip_ring(points, box)
            else:
                pieces = [p for p in clip_to_box(points, box) if length(p) >= min_length]
            out.extend(LocalElement(element.class_name, piece, element) for piece in pieces)
        return out


def _clip_ring(points: Array, box: Range, min_area: float = 0.1) -> list[Array]:
    """A closed ring cut to the box, closed again along the cut; heights kept where untouched."""
    xy = points[:, :2]
    inside = (xy >= box[:2]).all(axis=1) & (xy <= box[2:]).all(axis=1)
    if inside.all():
        return [points]
    if (xy.max(axis=0) < box[:2]).any() or (xy.min(axis=0) > box[2:]).any():
        return []
    import shapely

    polygon = shapely.polygons(xy)
    if not polygon.is_valid:
        polygon = polygon.buffer(0)
    cut = shapely.clip_by_rect(polygon, *box)
    known = np.nanmean(points[:, 2]) if np.isfinite(points[:, 2]).any() else np.nan
    out = []
    for part in shapely.get_parts(cut):
        if part.geom_type == "Polygon" and part.area >= min_area:
            ring = np.asarray(part.exterior.coords)
            out.append(np.column_stack([ring, np.full(len(ring), known)]))
    return out
