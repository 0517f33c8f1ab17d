"""Maps as GeoJSON (RFC 7946): WGS84 longitude, latitude, height; one feature a line.

Properties of a map element: ``id``, ``class``, ``sigma_m`` (one standard deviation per vertex, each
horizontal axis, metres), ``covariance_m2`` (xx, xy, yy, zz per vertex, axes of the map's CRS; where
sigma_m does not say it all), ``existence`` (log-odds), ``seen``, ``in_view``, ``traversals``,
``first_seen_ns``, ``last_seen_ns``, ``runs``, ``model_sha256``; every other property is an
attribute of the element. A vertex of unknown height has two coordinates.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.features import (
    Part,
    counter_clockwise,
    feature,
    geometry_parts,
    read_features,
    write_features,
)
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.maps.crs import check_map_crs, convert, lonlat_to, parse_crs, utm_crs
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap

Array = NDArray[np.float64]

GEOJSON_SCHEMA = "rtmap.map.geojson"
GEOJSON_VERSION = "1.0"

EVIDENCE = ("existence", "seen", "in_view", "traversals", "first_seen_ns", "last_seen_ns")
OTHER = ("id", "class", "sigma_m", "covariance_m2", "runs", "model_sha256", "attributes")
RESERVED = frozenset(EVIDENCE + OTHER)


def read_geojson(path: str | Path, crs: str | None = None) -> VectorMap:
    """A map from a GeoJSON file, in the projected metric ``crs``.

    Without ``crs``: the CRS that rtmap's own export names, else the UTM zone of the data's centre.
    Parts of MultiLineStrings and MultiPolygons become elements with ``-0``, ``-1`` … behind their
    id. Features without an id are called ``feature-<index>``. BadInput names the file, the feature
    and what is wrong with it.
    """
    collection, features = read_features(path)
    source = _source_crs(collection, path)
    names = [_feature_name(feature, k) for k, feature in enumerate(features)]
    parts = [
        geometry_parts(f.get("geometry"), path, name)
        for f, name in zip(features, names, strict=True)
    ]
    flat = [part for group in parts for part in group]
    lonlat = np.concatenate([p.lonlat for p in flat]) if flat else np.zeros((0, 3))
    crs = check_map_crs(crs or source or _zone_of(lonlat, path))
    check_area(crs, lonlat, path)
    xyz = np.column_stack([lonlat_to(crs, lonlat[:, :2]), lonlat[:, 2]])
    elements: list[Element] = []
    used = 0
    for item, name, group in zip(features, names, parts, strict=True):
        for k, part in enumerate(group):
            points = xyz[used : used + len(part.lonlat)]
            used += len(part.lonlat)
            suffix = f"-{k}" if len(group) > 1 else ""
            elements.append(_element(item, name, suffix, part, points, (source, crs), path))
    seen: set[str] = set()
    for element in elements:
        if element.element_id in seen:
            raise BadInput(path, f"two features are called {element.element_id}", "ids are unique")
        seen.add(element.element_id)
    return VectorMap(elements, crs)


def _feature_name(feature: dict[str, Any], index: int) -> str:
    found = (feature.get("properties") or {}).get("id", feature.get("id"))
    return f"feature-{index}" if found in (None, "") else str(found)


def _source_crs(collection: dict[str, Any], path: str | Path) -> str | None:
    """CRS of the map that rtmap exported the file from; None for other files."""
    own = collection.get("rtmap")
    if not isinstance(own, dict) or own.get("schema") != GEOJSON_SCHEMA:
        return None
    found = str(own.get("schema_version", "?"))
    if found.split(".")[0] != GEOJSON_VERSION.split(".")[0]:
        raise BadInput(path, f"{GEOJSON_SCHEMA} version {found} is unknown to this rtmap")
    named = own.get("crs_of_map")
    return named if isinstance(named, str) else None


def _zone_of(lonlat: Array, path: str | Path) -> str:
    if not len(lonlat):
        raise BadInput(path, "holds no features, so no CRS can be chosen", "pass --crs")
    middle = (lonlat[:, :2].min(axis=0) + lonlat[:, :2].max(axis=0)) / 2
    return utm_crs(float(middle[0]), float(middle[1]))


def check_area(crs: str, lonlat: Array, path: str | Path, margin: float = 6.0) -> None:
    """BadInput when data lie so far outside the CRS's area of use that metres are none."""
    area = parse_crs(crs).area_of_use
    if area is None or not len(lonlat) or area.west > area.east:
        return
    lon, lat = lonlat[:, 0], lonlat[:, 1]
    off = (lon < area.west - margin) | (lon > area.east + margin)
    off |= (lat < area.south - margin) | (lat > area.north + margin)
    if off.any():
        raise BadInput(
            path,
            f"longitude {lon[off][0]:.6g}, latitude {lat[off][0]:.6g} lies outside {crs}",
            f"that CRS is for {area.name}; leave --crs out to take the UTM zone of the data",
        )


def _element(
    feature: dict[str, Any],
    name: str,
    suffix: str,
    part: Part,
    points: Array,
    crs: tuple[str | None, str],
    path: str | Path,
) -> Element:
    """One element; ``crs`` is the one of the file's covariances and the one of ``points``."""
    properties = feature.get("properties") or {}
    class_name = properties.get("class")
    if not isinstance(class_name, str) or not class_name:
        raise BadInput(path, f"{name}: it has no class", "give every feature a property `class`")
    if class_name in RING_CLASSES and not (part.ring or is_ring(points)):
        raise BadInput(path, f"{name}: a {class_name} is a closed ring: use a Polygon")
    if class_name in RING_CLASSES and part.hole:
        raise BadInput(path, f"{name}: a {class_name} has no holes")
    try:
        return Element(
            element_id=name + suffix,
            class_name=class_name,
            points=points,
            covariance=_covariance(properties, part, points, crs, path, name),
            attributes=_attributes(properties),
            runs=tuple(str(r) for r in properties.get("runs") or ()),
            model_sha256=properties.get("model_sha256"),
            **{key: _number(properties, key, path, name) for key in EVIDENCE if key in properties},
        )
    except ValueError as error:
        raise BadInput(path, str(error)) from None


def _number(properties: dict[str, Any], key: str, path: str | Path, name: str) -> Any:
    value = properties[key]
    if value is None and key.endswith("_ns"):
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise BadInput(path, f"{name}: {key} is {value!r}, expected a number")
    return float(value) if key == "existence" else int(value)


def _attributes(properties: dict[str, Any]) -> dict[str, str]:
    own = {k: v for k, v in properties.items() if k not in RESERVED}
    nested = properties.get("attributes")
    own |= nested if isinstance(nested, dict) else {}
    return {
        str(k): v if isinstance(v, str) else json.dumps(v, ensure_ascii=False)
        for k, v in own.items()
        if v is not None
    }


def _per_vertex(value: Any, width: int, part: Part, path: str | Path, what: str) -> Array:
    """(n, width) of a property that holds one entry per vertex of the whole feature."""
    try:
        rows = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInput(path, f"{what} is not a list of numbers") from None
    if rows.ndim == 0:
        rows = np.full((part.start + len(part.lonlat), 1), float(rows))
    rows = rows.reshape(len(rows), -1)
    stop = part.start + len(part.lonlat)
    if len(rows) < stop or rows.shape[1] != width:
        raise BadInput(
            path,
            f"{what} holds {rows.shape[0]} × {rows.shape[1]} values, one per vertex"
            f" ({stop} × {width}) expected",
        )
    return rows[part.start : stop]


def _covariance(
    properties: dict[str, Any],
    part: Part,
    points: Array,
    crs: tuple[str | None, str],
    path: str | Path,
    name: str,
) -> Array | None:
    """(n, 4) covariance of the vertices in the axes of the new map frame, or None."""
    full, sigma = properties.get("covariance_m2"), properties.get("sigma_m")
    if full is not None:
        rows = _per_vertex(full, 4, part, path, f"{name}: covariance_m2")
        return _turn(rows, points, crs) if crs[0] not in (None, crs[1]) else rows
    if sigma is None:
        return None
    values = _per_vertex(sigma, 1, part, path, f"{name}: sigma_m")[:, 0]
    if (values <= 0).any() or np.isinf(values).any():
        raise BadInput(path, f"{name}: sigma_m must be positive, in metres")
    unknown = np.full(len(values), np.nan)
    zero = np.where(np.isnan(values), np.nan, 0.0)
    return np.column_stack([values**2, zero, values**2, unknown])


def _turn(rows: Array, points: Array, crs: tuple[str | None, str]) -> Array:
    """J Σ Jᵀ with the Jacobian of the change of CRS: grid north differs between zones."""
    source, target = str(crs[0]), crs[1]
    at = convert(target, source, points[:, :2])
    columns = [
        convert(source, target, at + step) - convert(source, target, at - step)
        for step in (np.array([0.5, 0.0]), np.array([0.0, 0.5]))
    ]
    jacobian = np.stack(columns, axis=-1)
    sigma = rows[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    turned = jacobian @ sigma @ jacobian.transpose(0, 2, 1)
    return np.column_stack([turned[:, 0, 0], turned[:, 0, 1], turned[:, 1, 1], rows[:, 3]])


def element_feature(element: Element, crs: str) -> dict[str, Any]:
    """One map element as a feature. Clockwise polygons are written the other way round."""
    polygon = element.class_name in RING_CLASSES and element.ring
    points, covariance = element.points, element.covariance
    if polygon and not counter_clockwise(points):
        points = points[::-1]
        covariance = None if covariance is None else covariance[::-1]
    properties: dict[str, Any] = {"id": element.element_id, "class": element.class_name}
    clash = {k: v for k, v in element.attributes.items() if k in RESERVED}
    properties |= {k: v for k, v in sorted(element.attributes.items()) if k not in RESERVED}
    if clash:
        properties["attributes"] = clash
    if covariance is not None:
        properties |= _covariance_properties(np.asarray(covariance, np.float64))
    blank = Element("", "", np.zeros((2, 3)))
    for key in EVIDENCE:
        value = getattr(element, key)
        if value != getattr(blank, key) and np.isfinite(value):
            properties[key] = value
    if element.runs:
        properties["runs"] = list(element.runs)
    if element.model_sha256:
        properties["model_sha256"] = element.model_sha256
    return feature(points, crs, polygon, properties)


def _covariance_properties(rows: Array) -> dict[str, Any]:
    """sigma_m, and covariance_m2 where vertices are not round or know their height."""

    def short(v: float) -> float | None:
        return float(f"{v:.9g}") if np.isfinite(v) else None

    xx, xy, yy, zz = rows.T
    out: dict[str, Any] = {"sigma_m": [short(v) for v in np.sqrt((xx + yy) / 2)]}
    with np.errstate(invalid="ignore"):
        skew = np.maximum(np.abs(xy), np.abs(xx - yy)) > 1e-9 * (xx + yy)
    if skew.any() or np.isfinite(zz).any():
        out["covariance_m2"] = [[short(v) for v in row] for row in rows]
    return out


def map_collection(vector_map: VectorMap) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The members and the features of a map's GeoJSON."""
    own = {
        "schema": GEOJSON_SCHEMA,
        "schema_version": GEOJSON_VERSION,
        "crs_of_map": vector_map.crs,
        "map_version": vector_map.version,
        "frame": "WGS84 longitude, latitude (degrees), height (m, as in the map)",
        "units": "sigma_m: m; covariance_m2: m², axes of crs_of_map",
    }
    return {"rtmap": own}, [element_feature(e, vector_map.crs) for e in vector_map]


def write_geojson(vector_map: VectorMap, path: str | Path) -> None:
    """Write a map as GeoJSON in WGS84 (``-``: stdout)."""
    members, features = map_collection(vector_map)
    write_features(features, path, members)
