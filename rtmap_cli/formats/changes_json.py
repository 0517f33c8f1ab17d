"""Changes of a map: GeoJSON as ``rtmap detect-changes`` writes it, and the fleet's truth JSON.

Both hold WGS84 longitude and latitude. GeoJSON: features with the properties ``kind``, ``class``
and, for detected changes, ``probability``. Truth: ``{"changes": [{"kind", "class", "geometry",
"element_id"}], "area"?}``; ``area`` is where the truth is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.crs import to_lonlat
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ChangeRecord:
    """One change; ``lonlat`` (n, 2) degrees, a ring repeats its first vertex."""

    kind: str
    class_name: str
    lonlat: Array
    probability: float
    change_id: str
    element_id: str


@dataclass(frozen=True)
class ChangeFile:
    """Changes of a file; ``area`` is a list of rings (n, 2) lon/lat, None: everywhere; ``runs``
    the ids of the runs that they were told from, None where the file does not say."""

    changes: list[ChangeRecord]
    area: list[Array] | None = None
    runs: tuple[str, ...] | None = None


def read_changes(path: str | Path) -> ChangeFile:
    """Read either form, or a changes.parquet; BadInput names the change that is wrong.

    A folder stands for its changes.geojson, a run without one for its changes.parquet.
    """
    path = Path(path)
    if path.is_dir():
        names = ("changes.geojson", "changes.parquet")
        path = path / next((n for n in names if (path / n).exists()), names[0])
    if path.suffix == ".parquet":
        return _table(path)
    data = read_json(path)
    if isinstance(data, dict) and isinstance(data.get("features"), list):
        changes = [_feature(path, k, f) for k, f in enumerate(data["features"])]
    elif isinstance(data, dict) and isinstance(data.get("changes"), list):
        changes = [_record(path, k, c, c) for k, c in enumerate(data["changes"])]
    else:
        raise BadInput(path, "holds neither features nor changes", "see docs/evaluate.md")
    area = data.get("area")
    return ChangeFile(changes, None if area is None else _area(path, area), _runs(data))


def _runs(data: dict[str, Any]) -> tuple[str, ...] | None:
    told = data.get("rtmap")
    runs = told.get("runs") if isinstance(told, dict) else None
    if not isinstance(runs, list) or not all(isinstance(r, str) for r in runs):
        return None
    return tuple(runs)


def _table(path: Path) -> ChangeFile:
    from rtmap_cli.formats.changes import read_change_table

    events, crs = read_change_table(path)
    return ChangeFile(
        [
            ChangeRecord(
                kind=e.kind,
                class_name=e.class_name,
                lonlat=to_lonlat(crs, e.points[:, :2]),
                probability=e.probability,
                change_id=e.change_id,
                element_id=e.element_id or "",
            )
            for e in events
        ]
    )


def _feature(path: Path, number: int, feature: Any) -> ChangeRecord:
    properties = feature.get("properties") if isinstance(feature, dict) else None
    if not isinstance(properties, dict):
        raise BadInput(path, f"feature {number} has no properties")
    return _record(path, number, properties, feature)


def _record(path: Path, number: int, properties: Any, holder: Any) -> ChangeRecord:
    where = f"change {number}"
    if not isinstance(properties, dict):
        raise BadInput(path, f"{where} is not an object")
    for key in ("kind", "class"):
        if not isinstance(properties.get(key), str):
            raise BadInput(path, f"{where}: {key} is missing")
    probability = properties.get("probability", 1.0)
    if isinstance(probability, bool) or not isinstance(probability, int | float):
        raise BadInput(path, f"{where}: probability is not a number")
    if not 0 <= probability <= 1:
        raise BadInput(path, f"{where}: probability {probability} is outside [0, 1]")
    return ChangeRecord(
        kind=properties["kind"],
        class_name=properties["class"],
        lonlat=_geometry(path, where, holder.get("geometry")),
        probability=float(probability),
        change_id=str(properties.get("change_id") or number),
        element_id=str(properties.get("element_id") or ""),
    )


def _geometry(path: Path, where: str, geometry: Any) -> Array:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    parts = geometry.get("coordinates") if isinstance(geometry, dict) else None
    if kind in ("MultiLineString", "MultiPolygon") and isinstance(parts, list) and len(parts) == 1:
        kind, parts = kind.removeprefix("Multi"), parts[0]
    if kind == "Polygon" and isinstance(parts, list) and parts:
        return _positions(path, where, parts[0])
    if kind == "LineString":
        return _positions(path, where, parts)
    raise BadInput(path, f"{where}: geometry must be one LineString or Polygon, not {kind}")


def _positions(path: Path, where: str, value: Any) -> Array:
    try:
        points = np.array([p[:2] for p in value], dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInput(path, f"{where}: its coordinates are not [lon, lat] pairs") from None
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise BadInput(path, f"{where}: its coordinates are not [lon, lat] pairs")
    if not np.isfinite(points).all() or (np.abs(points) > [180, 90]).any():
        raise BadInput(path, f"{where}: its coordinates are not longitude and latitude in degrees")
    return points


def _area(path: Path, geometry: Any) -> list[Array]:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in ("Polygon", "MultiPolygon"):
        raise BadInput(path, "area is not a Polygon or MultiPolygon")
    polygons = [geometry["coordinates"]] if kind == "Polygon" else geometry["coordinates"]
    return [_positions(path, "area", ring) for polygon in polygons for ring in polygon]
