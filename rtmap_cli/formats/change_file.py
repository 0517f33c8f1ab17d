"""Change files that people review: GeoJSON as detect-changes and update write it, also after QGIS
or JOSM had it.

Editors drop members of the collection, make texts of numbers, multi-geometries of lines and closed
lines of polygons. So everything that a change needs stands in its own properties: ``change_id``,
``kind``, ``class``, ``element_id``, ``map_version`` and, once somebody decided, ``review``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.changes import CHANGES_SCHEMA, CHANGES_VERSION, KINDS
from rtmap_cli.formats.features import geojson_lines, geometry_parts, read_features
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.maps.crs import lonlat_to, same_crs
from rtmap_cli.maps.edits import Edit
from rtmap_cli.maps.element import RING_CLASSES
from rtmap_cli.tables import whole_file

Array = NDArray[np.float64]

REVIEW = "review"
ACCEPTED, REJECTED = "accepted", "rejected"
STATES = (ACCEPTED, REJECTED)

_OWN = {
    "id", "change_id", "kind", "class", "element_id", "map_version", REVIEW, "probability",
    "log_odds", "frames_seen", "frames_in_view", "traversals_seen", "traversals_in_view",
    "first_seen_ns", "last_seen_ns", "runs", "evidence", "reason",
}  # fmt: skip


@dataclass(frozen=True)
class ChangeFeature:
    """One feature of a change file: its number, id, decision (None: open) and properties, in which
    texts that are numbers, lists or nulls are read as such."""

    number: int
    change_id: str
    kind: str
    class_name: str
    element_id: str | None
    review: str | None
    map_version: int | None
    properties: dict[str, Any]
    geometry: Any

    @property
    def name(self) -> str:
        """How errors call it."""
        return f"change {self.change_id}"


@dataclass(frozen=True)
class ReviewFile:
    """A change file: its collection without features, features as they lie in the file, and what
    they say."""

    path: Path
    members: dict[str, Any]
    raw: list[dict[str, Any]]
    changes: list[ChangeFeature]

    def by_id(self, change_id: str) -> ChangeFeature:
        """One change; BadInput when there is none of that id."""
        for change in self.changes:
            if change.change_id == change_id:
                return change
        hint = ", ".join(c.change_id for c in self.changes[:3])
        raise BadInput(self.path, f"has no change {change_id}", f"its first ones are {hint or '–'}")

    @property
    def map_version(self) -> int | None:
        """The version of the map that the changes are about; BadInput when they disagree."""
        stated = self.members.get("rtmap")
        found = {c.map_version for c in self.changes if c.map_version is not None}
        if isinstance(stated, dict) and isinstance(stated.get("map_version"), int):
            found.add(stated["map_version"])
        if len(found) > 1:
            told = " and ".join(map(str, sorted(found)))
            raise BadInput(
                self.path, f"its changes are about versions {told}", "apply one file each"
            )
        return next(iter(found), None)

    @property
    def crs_of_map(self) -> str | None:
        """CRS of the map, where the file still says it."""
        stated = self.members.get("rtmap")
        found = stated.get("crs_of_map") if isinstance(stated, dict) else None
        return found if isinstance(found, str) else None


def read_review_file(path: str | Path) -> ReviewFile:
    """A change file with everything checked that can be checked without the map; BadInput names
    the change and what is wrong with it."""
    path = Path(path)
    members, raw = read_features(path)
    stated = members.get("rtmap")
    if isinstance(stated, dict):
        _check_schema(stated, path)
    changes = [_change(k, feature, path) for k, feature in enumerate(raw)]
    seen: set[str] = set()
    for change in changes:
        if change.change_id in seen:
            raise BadInput(path, f"two changes are called {change.change_id}", "ids are unique")
        seen.add(change.change_id)
    return ReviewFile(path, members, raw, changes)


def _check_schema(stated: dict[str, Any], path: Path) -> None:
    if stated.get("schema") != CHANGES_SCHEMA:
        raise BadInput(path, f"holds {stated.get('schema')}, not changes of a map")
    version = str(stated.get("schema_version", "?"))
    if version.split(".")[0] != CHANGES_VERSION.split(".")[0]:
        raise BadInput(path, f"{CHANGES_SCHEMA} version {version} is unknown to this rtmap")


def _change(number: int, feature: dict[str, Any], path: Path) -> ChangeFeature:
    properties = {k: _unquoted(v) for k, v in (feature.get("properties") or {}).items()}
    found = properties.get("change_id") or properties.get("id") or feature.get("id")
    change_id = str(found) if found not in (None, "") else f"feature-{number}"
    where = f"change {change_id}"
    kind, class_name = properties.get("kind"), properties.get("class")
    if kind not in KINDS:
        raise BadInput(path, f"{where}: its kind is {kind!r}", f"one of {', '.join(KINDS)}")
    if not isinstance(class_name, str) or not class_name:
        raise BadInput(path, f"{where}: it has no class", "give it a property `class`")
    element_id = properties.get("element_id")
    element_id = None if element_id in (None, "") else str(element_id)
    if kind != "insert" and element_id is None:
        raise BadInput(path, f"{where}: a {kind} names no element_id", "give it one, or delete it")
    review = properties.get(REVIEW) or None
    if review is not None and review not in STATES:
        raise BadInput(path, f"{where}: its review is {review!r}", f"one of {', '.join(STATES)}")
    version = properties.get("map_version")
    if version is not None and (isinstance(version, bool) or not isinstance(version, int)):
        raise BadInput(path, f"{where}: its map_version is {version!r}, not a number")
    return ChangeFeature(
        number, change_id, kind, class_name, element_id, review, version, properties,
        feature.get("geometry"),
    )  # fmt: skip


def _unquoted(value: Any) -> Any:
    """What a text of an editor stands for: a number, a list, null; other texts as they are."""
    if not isinstance(value, str):
        return value
    text = value.strip()
    if not text or (text[0] not in "-0123456789[{" and text not in ("null", "true", "false")):
        return value
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return value


def write_review_file(file: ReviewFile, decisions: dict[str, str | None], path: str | Path) -> None:
    """The file with the decisions by change id (None: open again), everything else as it was."""
    features = []
    for raw, change in zip(file.raw, file.changes, strict=True):
        if change.change_id in decisions:
            own = {k: v for k, v in (raw.get("properties") or {}).items() if k != REVIEW}
            state = decisions[change.change_id]
            raw = raw | {"properties": own | ({REVIEW: state} if state else {})}
        features.append(raw)
    members = {k: v for k, v in file.members.items() if k != "type"}
    with whole_file(path) as temporary:
        temporary.write_text("".join(geojson_lines(features, members)), encoding="utf-8")


def edits_of(file: ReviewFile, changes: Sequence[ChangeFeature], crs: str) -> list[Edit]:
    """Changes of a file as edits of a map in ``crs``; BadInput for what is no line or ring, or when
    the file is about a map in another CRS."""
    stated = file.crs_of_map
    if stated is not None and not same_crs(stated, crs):
        raise BadInput(file.path, f"is about a map in {stated}, this one is in {crs}")
    return [_edit(file, change, crs) for change in changes]


def _edit(file: ReviewFile, change: ChangeFeature, crs: str) -> Edit:
    p = change.properties
    closed = change.class_name in RING_CLASSES
    return Edit(
        change.change_id,
        change.kind,
        change.class_name,
        change.element_id,
        _points(file, change, crs, closed),
        _value(p, "log_odds", 0.0),
        int(_value(p, "frames_seen", 0)),
        int(_value(p, "frames_in_view", 0)),
        int(_value(p, "traversals_in_view", 0)),
        _time(p, "first_seen_ns"),
        _time(p, "last_seen_ns"),
        tuple(str(r) for r in p["runs"]) if isinstance(p.get("runs"), list) else (),
        {
            str(k): v if isinstance(v, str) else json.dumps(v, ensure_ascii=False)
            for k, v in p.items()
            if change.kind == "insert" and k not in _OWN and v is not None
        },
    )


def _points(file: ReviewFile, change: ChangeFeature, crs: str, closed: bool) -> Array:
    """(n, 3) vertices in the map frame; a ring is closed exactly."""
    parts = geometry_parts(change.geometry, file.path, change.name)
    if len(parts) > 1:
        what = "has holes" if any(p.hole for p in parts) else f"has {len(parts)} parts"
        raise BadInput(file.path, f"{change.name}: its geometry {what}", "make it one line or ring")
    lonlat = parts[0].lonlat
    points = np.column_stack([lonlat_to(crs, lonlat[:, :2]), lonlat[:, 2]])
    if not np.isfinite(points[:, :2]).all():
        raise BadInput(file.path, f"{change.name}: lies outside {crs}")
    if closed and change.kind != "delete" and (not is_ring(points, 0.05) or len(points) < 4):
        what = f"a {change.class_name} is a closed ring"
        raise BadInput(file.path, f"{change.name}: {what}: use a Polygon")
    if len(points) > 3 and is_ring(points, 0.05):
        points[-1] = points[0]
    step = np.hypot(*np.diff(points[:, :2], axis=0).T)
    kept = points[np.concatenate([[True], step > 1e-4])]
    if len(kept) < 2:
        raise BadInput(file.path, f"{change.name}: its line has no length")
    return kept


def _value(properties: dict[str, Any], key: str, default: float) -> float:
    value = properties.get(key)
    good = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
    return float(value) if good and value is not None else default


def _time(properties: dict[str, Any], key: str) -> int | None:
    value = properties.get(key)
    return int(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
