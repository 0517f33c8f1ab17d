"""GeoJSON features (RFC 7946): WGS84 longitude, latitude, height; one feature a line."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.tables import read_json, whole_file

Array = NDArray[np.float64]

DEGREE_DIGITS = 9
"""Decimals of longitude and latitude: 0.1 mm."""

_LONLAT_NAMES = ("CRS84", "EPSG::4326", "EPSG:4326", "EPSG::4979")


@dataclass(frozen=True)
class Part:
    """One line or ring of a feature: ``lonlat`` (n, 3) degrees and metres, z NaN if unknown.

    ``hole`` marks an inner ring of a polygon; ``start`` is the index of the first vertex among all
    vertices of the feature.
    """

    lonlat: Array
    ring: bool
    hole: bool
    start: int


def read_features(path: str | Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The collection (without its features) and the features of a GeoJSON file (``-``: stdin).

    BadInput when it is not GeoJSON, or not in WGS84 as RFC 7946 demands.
    """
    value = _read_stdin() if str(path) == "-" else read_json(path)
    kind = value.get("type") if isinstance(value, dict) else None
    if kind == "Feature":
        value = {"type": "FeatureCollection", "features": [value]}
    elif kind != "FeatureCollection" or not isinstance(value.get("features"), list):
        raise BadInput(path, "not a GeoJSON FeatureCollection")
    named = value.get("crs")
    if named is not None and not any(n in json.dumps(named) for n in _LONLAT_NAMES):
        raise BadInput(
            path,
            f"its crs member is {json.dumps(named)}",
            "GeoJSON is WGS84 (RFC 7946): convert it",
        )
    for k, feature in enumerate(value["features"]):
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise BadInput(path, f"feature {k} is not a GeoJSON Feature")
        if not isinstance(feature.get("properties") or {}, dict):
            raise BadInput(path, f"feature {k}: its properties are not an object")
    return {k: v for k, v in value.items() if k != "features"}, value["features"]


def geometry_parts(geometry: Any, path: str | Path, name: str) -> list[Part]:
    """The lines and rings of a GeoJSON geometry; ``path`` and ``name`` are for errors.

    Polygons give their outer ring, then their holes.
    """
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    depth = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}.get(str(kind))
    if depth is None:
        raise BadInput(path, f"{name}: geometry {kind or 'null'} is neither a line nor a polygon")
    ring = "Polygon" in str(kind)
    lines = [(geometry.get("coordinates"), False)]
    for _ in range(depth):
        if not all(isinstance(level, list) for level, _ in lines):
            raise BadInput(path, f"{name}: its coordinates are not nested as in a {kind}")
        lines = [(line, ring and k > 0) for level, _ in lines for k, line in enumerate(level)]
    if not lines:
        raise BadInput(path, f"{name}: its geometry is empty")
    out: list[Part] = []
    start = 0
    for line, hole in lines:
        lonlat = _positions(line, path, name)
        if ring and (len(lonlat) < 4 or (lonlat[0, :2] != lonlat[-1, :2]).any()):
            raise BadInput(
                path, f"{name}: a ring is not closed (its last vertex repeats its first)"
            )
        out.append(Part(lonlat, ring, hole, start))
        start += len(lonlat)
    return out


def _positions(line: Any, path: str | Path, name: str) -> Array:
    """(n, 3) from a list of positions, checked."""
    if not isinstance(line, list) or len(line) < 2:
        raise BadInput(path, f"{name}: a line needs two vertices or more")
    if not all(isinstance(p, list) and len(p) > 1 and _numeric(p) for p in line):
        raise BadInput(path, f"{name}: a position is not [longitude, latitude]")
    rows = [(*p[:2], p[2] if len(p) > 2 else np.nan) for p in line]
    lonlat = np.array(rows, dtype=np.float64)
    if not np.isfinite(lonlat[:, :2]).all():
        raise BadInput(path, f"{name}: a longitude or latitude is not finite")
    beyond = (np.abs(lonlat[:, 0]) > 180) | (np.abs(lonlat[:, 1]) > 90)
    if beyond.any():
        lon, lat = lonlat[beyond][0, :2]
        raise BadInput(
            path,
            f"{name}: longitude {lon:.9g}, latitude {lat:.9g} lies outside ±180°, ±90°",
            "GeoJSON is WGS84 longitude, latitude: convert the file",
        )
    lonlat[~np.isfinite(lonlat[:, 2]), 2] = np.nan
    return lonlat


def _numeric(position: list[Any]) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in position[:3])


def _read_stdin() -> Any:
    try:
        return json.load(sys.stdin)
    except ValueError as error:
        raise BadInput("-", f"cannot be read as JSON ({error})") from None


def feature(points: Array, crs: str, polygon: bool, properties: dict[str, Any]) -> dict[str, Any]:
    """A GeoJSON feature from vertices (n, 2 or 3) in the projected ``crs``.

    A polygon's ring must be closed; it is written as it comes (see ``counter_clockwise``).
    """
    lonlat = np.round(to_lonlat(crs, points[:, :2]), DEGREE_DIGITS).tolist()
    if points.shape[1] > 2:
        lonlat = [
            [*p, round(float(z), 4)] if np.isfinite(z) else p
            for p, z in zip(lonlat, points[:, 2], strict=True)
        ]
    if polygon:
        lonlat[-1] = list(lonlat[0])
    geometry = (
        {"type": "Polygon", "coordinates": [lonlat]}
        if polygon
        else {"type": "LineString", "coordinates": lonlat}
    )
    out = {"type": "Feature", "properties": properties, "geometry": geometry}
    return {"id": properties["id"], **out} if "id" in properties else out


def counter_clockwise(points: Array) -> bool:
    """True when a ring turns to the left, as RFC 7946 wants the outer ring of a polygon."""
    x, y = points[:, 0] - points[0, 0], points[:, 1] - points[0, 1]
    return bool((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() >= 0)


def geojson_lines(
    features: Iterable[dict[str, Any]], members: dict[str, Any] | None = None
) -> Iterable[str]:
    """A FeatureCollection as text, one feature a line."""
    head = json.dumps({"type": "FeatureCollection"} | (members or {}), ensure_ascii=False)
    yield head[:-1] + ', "features": [\n'
    end = ""
    for item in features:
        yield end + json.dumps(item, ensure_ascii=False, allow_nan=False)
        end = ",\n"
    yield "\n]}\n"


def write_features(
    features: Iterable[dict[str, Any]], path: str | Path, members: dict[str, Any] | None = None
) -> None:
    """Write a FeatureCollection whole or not at all (``-``: stdout)."""
    lines = geojson_lines(features, members)
    if str(path) == "-":
        sys.stdout.writelines(lines)
        return
    with whole_file(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(lines)
