"""Changes of a map with the evidence behind each: GeoJSON for people, Parquet for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.features import counter_clockwise, feature, write_features
from rtmap_cli.logs.run_files import CHANGES
from rtmap_cli.maps.element import RING_CLASSES
from rtmap_cli.maps.evidence import Counts, DriveEvidence
from rtmap_cli.tables import read_table, table_metadata, write_table

Array = NDArray[np.float64]

KINDS = ("insert", "delete", "modify")
"""Seen from the map: missing in it, no longer real, displaced."""

CHANGES_SCHEMA = "rtmap.changes"
CHANGES_VERSION = "1.0"


@dataclass(frozen=True)
class ChangeEvent:
    """One change. ``points`` (n, 2 or 3) in the map frame: of a deleted stretch the stretch, of
    an inserted element its outline, of a modified one where it lies now. ``probability`` that the
    change is real, ``log_odds`` of the same."""

    change_id: str
    kind: str
    class_name: str
    element_id: str | None
    points: Array
    probability: float
    log_odds: float
    counts: Counts

    def properties(self) -> dict[str, Any]:
        """What GeoJSON carries besides the geometry; also the object that ``--json`` prints."""
        c = self.counts
        return {
            "id": self.change_id,
            "change_id": self.change_id,
            "kind": self.kind,
            "class": self.class_name,
            "element_id": self.element_id,
            "probability": round(self.probability, 6),
            "log_odds": round(self.log_odds, 4),
            "frames_seen": c.frames_seen,
            "frames_in_view": c.frames_in_view,
            "traversals_seen": c.traversals_seen,
            "traversals_in_view": c.traversals_in_view,
            "first_seen_ns": c.first_seen_ns,
            "last_seen_ns": c.last_seen_ns,
            "runs": list(c.runs),
            "evidence": [_drive_properties(d) for d in c.drives],
        }


def _drive_properties(drive: DriveEvidence) -> dict[str, Any]:
    """What one drive says: frames, scores and its vote, ``log_odds`` that the element exists."""
    return {
        "run": drive.run_id,
        "frames_seen": drive.frames_seen,
        "frames_in_view": drive.frames_in_view,
        "seen_ns": list(drive.seen_ns),
        "score": None if drive.score is None else round(drive.score, 4),
        "log_odds": round(drive.log_odds, 4),
        "found": drive.seen,
    }


def write_changes(
    changes: Sequence[ChangeEvent],
    crs: str,
    path: str | Path,
    info: dict[str, Any] | None = None,
    reasons: Mapping[str, str] | None = None,
) -> None:
    """Write changes as GeoJSON in WGS84, whole or not at all (``-``: stdout).

    ``reasons`` by change id become the property ``reason``.
    """
    members = {
        "rtmap": {"schema": CHANGES_SCHEMA, "schema_version": CHANGES_VERSION} | (info or {})
    }
    # In every feature too: editors drop the members of a collection.
    version = (info or {}).get("map_version")
    own = {} if version is None else {"map_version": version}
    why = reasons or {}
    features = [
        _feature(c, crs, own | ({"reason": why[c.change_id]} if c.change_id in why else {}))
        for c in changes
    ]
    write_features(features, path, members)


def _feature(change: ChangeEvent, crs: str, own: dict[str, Any]) -> dict[str, Any]:
    closed = change.class_name in RING_CLASSES and len(change.points) > 3
    points = change.points
    if closed and not counter_clockwise(points):
        points = points[::-1]
    return feature(points, crs, closed, change.properties() | own)


def write_change_table(changes: Sequence[ChangeEvent], path: str | Path, crs: str) -> None:
    """Write changes.parquet (design §3): geometry as WKB in the map frame."""
    import shapely

    rows = [c.properties() for c in changes]
    names = [n for n in CHANGES.columns.names if n not in ("class_name", "geometry")]
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in names}
    columns["class_name"] = [c.class_name for c in changes]
    columns["geometry"] = [shapely.to_wkb(_shape(c), include_srid=False) for c in changes]
    table = pa.table(
        {n: pa.array(columns[n], CHANGES.columns.field(n).type) for n in CHANGES.columns.names}
    )
    write_table(table, path, CHANGES, {"rtmap.crs": crs})


def _shape(change: ChangeEvent) -> Any:
    import shapely

    xy = change.points[:, :2]
    if change.class_name in RING_CLASSES and len(xy) > 3:
        return shapely.Polygon(xy)
    return shapely.LineString(xy)


def read_change_table(path: str | Path) -> tuple[list[ChangeEvent], str]:
    """Read changes.parquet: the changes and the CRS of their map frame."""
    import shapely

    table = read_table(path, CHANGES)
    crs = table_metadata(table).get("rtmap.crs")
    if crs is None:
        raise BadInput(path, "does not state its CRS (rtmap.crs in its metadata)")
    out = []
    for k, row in enumerate(table.to_pylist()):
        try:
            shape = shapely.from_wkb(row["geometry"])
        except (shapely.errors.GEOSException, TypeError):
            raise BadInput(path, f"row {k}: the geometry is not WKB") from None
        line = shape.exterior if shape.geom_type == "Polygon" else shape
        counts = Counts(
            row["frames_seen"],
            row["frames_in_view"],
            row["traversals_seen"],
            row["traversals_in_view"],
            row["first_seen_ns"],
            row["last_seen_ns"],
            tuple(row["runs"] or ()),
        )
        out.append(
            ChangeEvent(
                row["change_id"],
                row["kind"],
                row["class_name"],
                row["element_id"],
                np.asarray(line.coords),
                row["probability"],
                row["log_odds"],
                counts,
            )
        )
    return out, crs
