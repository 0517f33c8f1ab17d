"""The vector map of Argoverse 2: reading ``log_map_archive_*.json`` and making a map of it.

Sensor logs and motion-forecasting scenarios are read. Coordinates become UTM (city frame + origin
of the city), heights stay. What is odd in a file (references to lanes outside the clipped map,
unknown heights, lines of one point …) is counted in ``Av2Map.notes``, not refused.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.av2.elements import boundaries, crossings, dividers
from rtmap_cli.formats.av2.files import find_city
from rtmap_cli.formats.av2.ground import GroundHeight, read_ground
from rtmap_cli.maps.crs import city_code, city_crs
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LaneSegment:
    """A lane of the map: ``left`` and ``right`` (n, 3) boundaries in driving direction, UTM."""

    lane_id: int
    lane_type: str
    is_intersection: bool
    left: Array
    right: Array
    left_mark: str
    right_mark: str
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    left_neighbor: int | None
    right_neighbor: int | None


@dataclass
class Av2Map:
    """A vector map as AV2 models it, in UTM metres; heights NaN where unknown.

    ``crossings`` holds the two edges (n, 3) of each crossing, ``areas`` the ring (n, 3, not
    closed) of each drivable area. ``notes`` counts what was odd in the file.
    """

    path: Path
    city: str
    crs: str
    lanes: dict[int, LaneSegment]
    crossings: dict[int, tuple[Array, Array]]
    areas: dict[int, Array]
    ground: GroundHeight | None = None
    notes: Counter[str] = field(default_factory=Counter)


def read_av2_archive(folder: str | Path, city: str | None = None) -> Av2Map:
    """The vector map of a log or scenario folder; BadInput when there is none or it is broken.

    ``city`` is needed only where neither a file name nor a scenario file tells it.
    """
    folder = Path(folder)
    path = _archive_file(folder)
    city = city or find_city(folder) or _scenario_city(path.parent)
    if city is None:
        raise BadInput(path, "nothing names its city", "pass --city (ATX, DTW, MIA, PAO, PIT, WDC)")
    city = city_code(city, path)
    crs, origin = city_crs(city, path)
    content = read_json(path)
    reader = _Reader(path, origin)
    parts = {}
    for name in ("lane_segments", "pedestrian_crossings", "drivable_areas"):
        part = content.get(name) if isinstance(content, dict) else None
        if not isinstance(part, dict):
            raise BadInput(path, f"not an Argoverse 2 vector map ({name} is missing)")
        parts[name] = {int(k): v for k, v in part.items() if _is_id(k, path)}
    lanes = {k: reader.lane(k, v) for k, v in parts["lane_segments"].items()}
    edges = {k: reader.crossing(v) for k, v in parts["pedestrian_crossings"].items()}
    areas = {k: reader.line(v, "area_boundary") for k, v in parts["drivable_areas"].items()}
    reader.count_dangling(lanes)
    return Av2Map(
        path=path,
        city=city,
        crs=crs,
        lanes=lanes,
        crossings=edges,
        areas=areas,
        ground=read_ground(folder, origin),
        notes=reader.notes,
    )


def vector_map_of(av2_map: Av2Map) -> VectorMap:
    """The map's elements: ped_crossing, divider, boundary, in this order; counts go to ``notes``.

    Dividers are the painted lane boundaries (mark neither NONE nor UNKNOWN), shared ones once,
    joined end to end; boundaries the outline of the union of the drivable areas, closed rings with
    the drivable side on the left. Ids derive from those of AV2 and do not depend on its order.
    """
    lines = [
        (f"{lane.lane_id}-{side}", mark, points)
        for lane in sorted(av2_map.lanes.values(), key=lambda lane: lane.lane_id)
        for side, mark, points in (
            ("left", lane.left_mark, lane.left),
            ("right", lane.right_mark, lane.right),
        )
    ]
    elements = crossings(av2_map.crossings, av2_map.notes)
    elements += dividers(lines, av2_map.notes)
    elements += boundaries(av2_map.areas, av2_map.notes)
    return VectorMap([_with_heights(e, av2_map) for e in elements], av2_map.crs)


def read_av2_map(folder: str | Path, city: str | None = None) -> VectorMap:
    """The vector map of a log or scenario folder as a map in UTM."""
    return vector_map_of(read_av2_archive(folder, city))


def _with_heights(element: Element, av2_map: Av2Map) -> Element:
    """Heights that the vector map lacks, from the ground raster where it knows them."""
    points = element.points
    missing = np.isnan(points[:, 2])
    if not missing.any():
        return element
    if av2_map.ground is not None:
        points = points.copy()
        points[missing, 2] = av2_map.ground.at(points[missing, :2])
    still = int(np.isnan(points[:, 2]).sum())
    av2_map.notes["heights taken from the ground raster"] += int(missing.sum()) - still
    av2_map.notes["vertices of unknown height"] += still
    return element.with_points(points)


class _Reader:
    """Turns the JSON of one file into arrays and counts what is odd."""

    def __init__(self, path: Path, origin: Array) -> None:
        self.path, self.origin, self.notes = path, origin, Counter[str]()

    def line(self, item: Any, key: str) -> Array:
        """(n, 3) UTM points of one list of x, y, z; points without x or y are left out."""
        try:
            rows = [(p["x"], p["y"], p.get("z")) for p in item[key]]
            points = np.array(rows, dtype=np.float64).reshape(-1, 3)
        except (KeyError, TypeError, ValueError, AttributeError):
            name = item.get("id", "?") if isinstance(item, dict) else "?"
            raise BadInput(self.path, f"{key} of {name} is not a list of x, y, z") from None
        known = np.isfinite(points[:, :2]).all(axis=1)
        self.notes["points without x or y left out"] += int((~known).sum())
        points = points[known]
        points[:, :2] += self.origin
        points[~np.isfinite(points[:, 2]), 2] = np.nan
        return points

    def crossing(self, item: Any) -> tuple[Array, Array]:
        """Both edges of a crossing."""
        return self.line(item, "edge1"), self.line(item, "edge2")

    def lane(self, lane_id: int, item: Any) -> LaneSegment:
        """One lane segment."""
        left, right = self.line(item, "left_lane_boundary"), self.line(item, "right_lane_boundary")
        for neighbor in ("left_neighbor_id", "right_neighbor_id"):
            if not isinstance(item.get(neighbor), int | None):
                raise BadInput(self.path, f"{neighbor} of lane {lane_id} is not an id")
        return LaneSegment(
            lane_id=lane_id,
            lane_type=str(item.get("lane_type", "UNKNOWN")),
            is_intersection=bool(item.get("is_intersection", False)),
            left=left,
            right=right,
            left_mark=str(item.get("left_lane_mark_type") or "UNKNOWN"),
            right_mark=str(item.get("right_lane_mark_type") or "UNKNOWN"),
            successors=tuple(item.get("successors") or ()),
            predecessors=tuple(item.get("predecessors") or ()),
            left_neighbor=item.get("left_neighbor_id"),
            right_neighbor=item.get("right_neighbor_id"),
        )

    def count_dangling(self, lanes: dict[int, LaneSegment]) -> None:
        """Count references to lanes outside the clipped map: usual, not an error."""
        for lane in lanes.values():
            for other in (*lane.successors, *lane.predecessors):
                self.notes["references to lanes outside the map"] += other not in lanes


def _archive_file(folder: Path) -> Path:
    if not folder.is_dir():
        raise BadInput(folder, "no such folder", "give the folder of an Argoverse 2 log")
    for place in (folder / "map", folder):
        found = sorted(place.glob("log_map_archive_*.json")) if place.is_dir() else []
        if len(found) > 1:
            raise BadInput(place, f"holds {len(found)} vector maps", "keep one")
        if found:
            return found[0]
    raise BadInput(folder, "no log_map_archive_*.json in it or in its map folder")


def _scenario_city(folder: Path) -> str | None:
    """City of a motion-forecasting scenario beside its map."""
    for path in sorted(folder.glob("scenario_*.parquet")):
        try:
            column = pq.read_table(path, columns=["city"])["city"]
        except (pa.ArrowException, OSError, KeyError) as error:
            text = str(error).splitlines()[0]
            raise BadInput(path, f"its city cannot be read ({text})", "pass --city") from None
        if len(column):
            return str(column[0].as_py())
    return None


def _is_id(text: str, path: Path) -> bool:
    if not text.lstrip("-").isdigit():
        raise BadInput(path, f"{text!r} is not an id")
    return True
