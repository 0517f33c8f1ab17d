"""The map expansion of nuScenes (``maps/expansion/<location>.json``) as a map.

Classes as MapTR and its successors take them from the same layers: crossings merged where they
touch, dividers = lane_divider and road_divider, boundary = the outline of the union of road_segment
and lane. The whole map is taken, not a patch around a frame, so that nothing is cut.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.nuscenes.tables import location_crs
from rtmap_cli.formats.records import need
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]

LAYERS = ("road_segment", "lane", "ped_crossing", "lane_divider", "road_divider")
GEOMETRY = ("node", "line", "polygon")
MIN_AREA = 0.1
"""m² below which a crossing or a piece of road is none."""


@dataclass
class NuscenesMap:
    """One map expansion: records by layer, geometry by token; ``notes`` counts what was odd."""

    path: Path
    location: str
    layers: dict[str, list[dict[str, Any]]]
    nodes: dict[str, tuple[float, float]]
    lines: dict[str, Any]
    polygons: dict[str, Any]
    notes: Counter[str] = field(default_factory=Counter)

    @property
    def crs(self) -> str:
        """The CRS of its coordinates."""
        return location_crs(self.location)


def find_expansion(folder: Path, location: str | None) -> Path:
    """The file of a location (the only one without a name) under a nuScenes folder."""
    if not folder.is_dir():
        raise BadInput(folder, "no such folder", "give the folder that holds maps/expansion")
    # Also where the folder of the tables was given, and where the maps lie alone.
    inside = ("maps/expansion", "../maps/expansion", "expansion", ".")
    places = [folder / name for name in inside if (folder / name).is_dir()]
    found = {p.stem: p for place in reversed(places) for p in sorted(place.glob("*-*.json"))}
    known = ", ".join(sorted(found)) or "none"
    if location is None and len(found) == 1:
        return next(iter(found.values()))
    if location is None:
        raise BadInput(folder, f"holds {len(found)} vector maps ({known})", "pass --location")
    if location not in found:
        raise BadInput(folder, f"has no vector map of {location} (it has {known})")
    return found[location]


def read_expansion(folder: str | Path, location: str | None = None) -> NuscenesMap:
    """The map expansion of a nuScenes folder; BadInput when it is missing or broken."""
    path = find_expansion(Path(folder), location)
    content = read_json(path)
    layers = {}
    for name in (*LAYERS, *GEOMETRY):
        records = content.get(name) if isinstance(content, dict) else None
        if not isinstance(records, list) or not all(isinstance(r, dict) for r in records):
            raise BadInput(path, f"not a nuScenes map expansion (the layer {name} is missing)")
        layers[name] = records
    nodes = {}
    for record in layers["node"]:
        token = need(record, "token", path, "a node")
        try:
            x, y = float(record["x"]), float(record["y"])
        except (KeyError, TypeError, ValueError):
            raise BadInput(path, f"node {token} has no x and y") from None
        if not np.isfinite([x, y]).all():
            raise BadInput(path, f"node {token} is not finite")
        nodes[str(token)] = (x, y)
    by_token = {
        name: {str(need(r, "token", path, f"a {name}")): r for r in layers[name]}
        for name in ("line", "polygon")
    }
    return NuscenesMap(
        path,
        path.stem,
        {n: layers[n] for n in LAYERS},
        nodes,
        by_token["line"],
        by_token["polygon"],
    )


def vector_map_of(source: NuscenesMap) -> VectorMap:
    """The elements of an expansion: ped_crossing, divider, boundary, in this order.

    Heights are unknown (the expansion is flat). Ids derive from nuScenes' tokens and do not depend
    on their order; counts of what was odd go to ``notes``.
    """
    elements = [*_crossings(source), *_dividers(source), *_boundaries(source)]
    return VectorMap(elements, source.crs)


def read_nuscenes_map(folder: str | Path, location: str | None = None) -> VectorMap:
    """The map expansion of a nuScenes folder as a map."""
    return vector_map_of(read_expansion(folder, location))


def _crossings(source: NuscenesMap) -> Iterator[Element]:
    polygons = _polygons(source, ["ped_crossing"])
    merged = shapely.get_parts(shapely.unary_union(list(polygons.values())))
    merged = [p for p in merged if p.geom_type == "Polygon" and p.area >= MIN_AREA]
    source.notes["crossings merged with others"] += len(polygons) - len(merged)
    for name, ring in _named([p.exterior for p in merged], polygons):
        yield Element(f"crossing-{name}", "ped_crossing", ring)


def _dividers(source: NuscenesMap) -> Iterator[Element]:
    """Every painted line once; two layers may hold the same one."""
    seen: set[tuple[tuple[float, float], ...]] = set()
    for layer in ("lane_divider", "road_divider"):
        for record in sorted(source.layers[layer], key=lambda r: str(r.get("token"))):
            token = str(need(record, "token", source.path, f"a {layer}"))
            line = _of(source.lines, record, "line_token", source.path, f"{layer} {token}")
            points = _points(source, line, "node_tokens")
            if len(points) < 2:
                source.notes["lines of one point left out"] += 1
                continue
            rows = [(round(x, 3), round(y, 3)) for x, y in points.tolist()]
            key = min(tuple(rows), tuple(rows[::-1]))
            if key in seen:
                source.notes["lines that come twice taken once"] += 1
                continue
            seen.add(key)
            segments = record.get("lane_divider_segments") or ()
            marks = sorted({str(s.get("segment_type")) for s in segments if isinstance(s, dict)})
            attributes = {"layer": layer} | ({"mark": ",".join(marks)} if marks else {})
            yield Element(f"divider-{token}", "divider", points, attributes=attributes)


def _boundaries(source: NuscenesMap) -> Iterator[Element]:
    """Closed outlines, the road on the left."""
    polygons = _polygons(source, ["road_segment", "lane"])
    union = shapely.orient_polygons(shapely.unary_union(list(polygons.values())))
    rings = [
        ring
        for part in shapely.get_parts(union)
        if part.geom_type == "Polygon" and part.area >= MIN_AREA
        for ring in (part.exterior, *part.interiors)
    ]
    for name, points in _named(rings, polygons):
        yield Element(f"boundary-{name}", "boundary", points)


def _polygons(source: NuscenesMap, layers: Iterable[str]) -> dict[str, shapely.Polygon]:
    """The polygons of some layers by the tokens of their records, made valid."""
    out = {}
    for layer in layers:
        for record in source.layers[layer]:
            token = str(need(record, "token", source.path, f"a {layer}"))
            what = f"{layer} {token}"
            shape = _of(source.polygons, record, "polygon_token", source.path, what)
            outside = _points(source, shape, "exterior_node_tokens")
            holes = [_points(source, h, "node_tokens") for h in shape.get("holes") or ()]
            if len(outside) < 3:
                source.notes["polygons of fewer than three points left out"] += 1
                continue
            polygon = shapely.Polygon(outside, [h for h in holes if len(h) >= 3])
            if not polygon.is_valid:
                source.notes["polygons that cross themselves set right"] += 1
                polygon = polygon.buffer(0)
            if polygon.area >= MIN_AREA:
                out[token] = polygon
    return dict(sorted(out.items()))


def _of(table: dict[str, Any], record: Any, key: str, path: Path, what: str) -> Any:
    token = str(need(record, key, path, what))
    if token not in table:
        raise BadInput(path, f"{what} names {key} {token}, which is not there")
    return table[token]


def _points(source: NuscenesMap, record: Any, key: str) -> Array:
    """(n, 2) nodes of a line or ring, repeated ones once."""
    tokens = need(record, key, source.path, "a line or ring")
    try:
        rows = [source.nodes[str(t)] for t in tokens]
    except (KeyError, TypeError) as error:
        raise BadInput(source.path, f"a line or ring names the node {error}, not there") from None
    points = np.array(rows, np.float64).reshape(-1, 2)
    step = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
    return points[np.concatenate([[True], step > 1e-6])] if len(points) else points


def _named(rings: list[Any], polygons: dict[str, shapely.Polygon]) -> Iterator[tuple[str, Array]]:
    """Each ring's points with a stable name: the first (by token) of the polygons that it touches,
    numbered where several rings touch it."""
    names = list(polygons)
    tree = shapely.STRtree(list(polygons.values()))
    seen: Counter[str] = Counter()
    for ring in sorted(rings, key=lambda ring: tuple(_ring(ring)[0])):
        name = min(names[i] for i in tree.query(ring, predicate="intersects"))
        seen[name] += 1
        yield name + (f"-{seen[name]}" if seen[name] > 1 else ""), _ring(ring)


def _ring(ring: Any) -> Array:
    """(n, 2) closed vertices from the lowest one (x, then y) on, direction kept."""
    points = np.asarray(ring.coords)[:-1, :2]
    start = int(np.lexsort((points[:, 1], points[:, 0]))[0])
    points = np.roll(points, -start, axis=0)
    return np.concatenate([points, points[:1]])
