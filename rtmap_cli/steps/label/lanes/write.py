"""A graph of lanes with borders as a Lanelet2 map, and its centre lines as GeoJSON."""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.formats.lanelet2.frame import Frame, placed_nodes
from rtmap_cli.formats.lanelet2.numbers import Numbers
from rtmap_cli.formats.lanelet2.osm import Member, OsmFile, Relation, Tags, Way, write_osm
from rtmap_cli.formats.lanelet2.read import Lanelet2Map, read_lanelet2
from rtmap_cli.formats.lanelet2.tags import ID_TAG
from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.label.lanes.borders import KINDS, Borders
from rtmap_cli.steps.label.lanes.graph import Edge, LaneGraph

Array = NDArray[np.float64]

SOURCE_TAG = "rtmap:border"
"""Tag of a way: what its place was taken from, one of KINDS."""
TURN = 60.0
"""Metres up to which an edge from a fork or to a merge is a way through a junction."""
STEP_KMH = 10.0
SHARE = 0.5
"""Share of the vertices that must have been seen as paint or curb for the way to be one."""
SIGMA = (1.5, 0.06, 0.06)
"""Metres across by KINDS: what benchmarks/label/lanes.py finds of what was assumed, and of what was
seen (90 % lie within 0.1 m)."""


def names_of(graph: LaneGraph) -> list[str]:
    """Names of edges from where their middles lie: the same drive gives the same names."""
    counts: Counter[str] = Counter()
    out = []
    for e in graph.edges:
        x, y = e.xy[len(e.xy) // 2]
        d = e.xy[-1] - e.xy[0]
        name = f"lane-{x:.0f}-{y:.0f}-{np.degrees(np.arctan2(d[1], d[0])) % 360:03.0f}"
        counts[name] += 1
        out.append(name if counts[name] == 1 else f"{name}-{counts[name]}")
    return out


def speed_of(edge: Edge, limit: float | None) -> float:
    """km/h: the limit that was given, else what was driven, rounded up to tens."""
    driven = float(np.ceil(max(edge.speed, 0.1) * 3.6 / STEP_KMH) * STEP_KMH)
    return limit or driven


def to_lanelet2(
    graph: LaneGraph, borders: list[Borders], crs: str, limit: float | None, looked: bool = False
) -> Lanelet2Map:
    """The lanelets, as ``rtmap import lanelet2`` would read them; borders have the covariance of
    what their places were taken from. Where lines were ``looked`` for, a border that was not seen
    is virtual."""
    out, points = _osm(graph, borders, limit, looked)
    out.nodes = placed_nodes(points, {}, Frame(crs), local=False)
    out.attributes = {"version": "0.6", "generator": "rtmap"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lanes.osm"
        write_osm(out, path)
        made = read_lanelet2(path, crs=crs, join=False)
    return replace(made, vector_map=_with_sigmas(made.vector_map, graph, borders))


def _with_sigmas(vector_map: VectorMap, graph: LaneGraph, borders: list[Borders]) -> VectorMap:
    """The map with SIGMA of every vertex of a border, along lines too: it slides."""
    numbers, kinds = Numbers(set()), {}
    for b, name in zip(borders, names_of(graph), strict=True):
        for side, k in zip(("left", "right"), b.kinds, strict=True):
            kinds[f"way-{numbers.of(f'{name}/{side}')}"] = k
    out = []
    for element in vector_map:
        kind = kinds.get(element.element_id)
        if kind is not None and len(kind) == len(element.points):
            variance = np.take(SIGMA, kind) ** 2
            nothing = np.full(len(kind), np.nan)
            covariance = np.stack([variance, 0 * variance, variance, nothing], axis=-1)
            element = element.with_points(element.points, covariance)
        out.append(element)
    return VectorMap(out, vector_map.crs, vector_map.version)


def _osm(
    graph: LaneGraph, borders: list[Borders], limit: float | None, looked: bool
) -> tuple[OsmFile, dict[int, Array]]:
    out, points = OsmFile(), {}
    numbers = Numbers(set())
    leaves, enters = graph.ends()
    ends: dict[tuple[float, float], int] = {}

    def node(p: Array, name: str, shared: bool) -> int:
        key = (round(float(p[0]), 4), round(float(p[1]), 4))
        if shared and key in ends:
            return ends[key]
        number = numbers.of(name)
        points[number] = np.array([*p, np.nan])
        if shared:
            ends[key] = number
        return number

    for e, b, name in zip(graph.edges, borders, names_of(graph), strict=True):
        turn = length(e.xy) < TURN and (len(leaves[e.start]) > 1 or len(enters[e.end]) > 1)
        members = []
        for side, line, kinds in zip(("left", "right"), b.lines, b.kinds, strict=True):
            last = len(line) - 1
            nodes = [
                node(p, f"{name}/{side}/{k}", k in (0, last)) for k, p in enumerate(line)
            ]  # fmt: skip
            way = numbers.of(f"{name}/{side}")
            out.ways[way] = Way(nodes, _way_tags(kinds, looked or turn))
            members.append(Member("way", way, side))
        tags = {
            "type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes",
            "participant:vehicle": "yes", "speed_limit": f"{speed_of(e, limit):g} km/h",
            ID_TAG: name,
        }  # fmt: skip
        out.relations[numbers.of(f"{name}/lanelet")] = Relation(members, tags)
    return out, points


def _way_tags(kinds: NDArray[np.int8], open_: bool) -> Tags:
    """Tags of a border; one that was mostly not seen is virtual where that is ``open_``."""
    share = np.bincount(kinds, minlength=len(KINDS)) / len(kinds)
    if share[1:].sum() < SHARE:
        return {"type": "virtual" if open_ else "road_border", SOURCE_TAG: KINDS[0]}
    best = int(share[1:].argmax()) + 1
    tags = {"type": "line_thin"} if KINDS[best] == "paint" else {"type": "road_border"}
    return tags | {SOURCE_TAG: KINDS[best]}


def centrelines(graph: LaneGraph, crs: str, limit: float | None) -> dict[str, Any]:
    """The centre lines as GeoJSON: ids, successors, passes, m/s driven, km/h, metres."""
    names = names_of(graph)
    features = []
    for k, (e, name) in enumerate(zip(graph.edges, names, strict=True)):
        features.append(
            {
                "type": "Feature",
                "id": name,
                "geometry": {
                    "type": "LineString",
                    "coordinates": np.round(to_lonlat(crs, e.xy), 9).tolist(),
                },
                "properties": {
                    "id": name,
                    "successors": [names[j] for j in graph.successors(k)],
                    "passes": e.passes,
                    "driven_m_s": round(e.speed, 2),
                    "speed_limit_km_h": speed_of(e, limit),
                    "length_m": round(length(e.xy), 2),
                },
            }
        )
    return {"type": "FeatureCollection", "rtmap": {"crs": crs}, "features": features}
