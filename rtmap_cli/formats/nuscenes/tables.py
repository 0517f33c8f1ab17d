"""The tables of a nuScenes v1.0 folder: JSON lists of records that refer to each other by tokens.

Only what a log needs is kept: keyframes of ``sample_data`` and their poses. The tables of the full
data set have gigabytes of text, which is read once per process.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.crs import local_crs

Record = dict[str, Any]

ORIGINS = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}
"""Latitude and longitude of the south-western corners of the maps (nuScenes devkit,
scripts/export_poses.py)."""


def location_crs(location: str) -> str:
    """The CRS of a map frame of nuScenes: metres east and north of the map's corner.

    nuScenes states corners but no projection: a transverse Mercator with scale 1 through the corner
    is taken, so that coordinates stay those of the files. An unknown location gets a local frame.
    """
    if location not in ORIGINS:
        return local_crs(f"nuScenes map frame, {location}")
    latitude, longitude = ORIGINS[location]
    return (
        f"+proj=tmerc +lat_0={latitude} +lon_0={longitude} +k=1 +x_0=0 +y_0=0 "
        "+datum=WGS84 +units=m +no_defs +type=crs"
    )


class Tables:
    """The records of one version folder by table and token; ``root`` is where file names start."""

    def __init__(self, version: Path) -> None:
        self.version, self.root = version, version.parent
        self.scene = self._table("scene")
        self.sample = self._table("sample")
        self.log = self._table("log")
        self.sensor = self._table("sensor")
        self.calibrated_sensor = self._table("calibrated_sensor")
        self.sample_data = self._table("sample_data", lambda r: r.get("is_key_frame", True))
        wanted = {r.get("ego_pose_token") for r in self.sample_data.values()}
        self.ego_pose = self._table("ego_pose", lambda r: r.get("token") in wanted)
        self._of_sample: dict[str, list[Record]] = {}
        for record in self.sample_data.values():
            self._of_sample.setdefault(str(record.get("sample_token")), []).append(record)
        self._of_scene: dict[str, list[Record]] = {}
        for record in self.sample.values():
            self._of_scene.setdefault(str(record.get("scene_token")), []).append(record)

    def path(self, table: str) -> Path:
        """The file of a table."""
        return self.version / f"{table}.json"

    def get(self, table: str, token: Any) -> Record:
        """One record; BadInput when the token leads nowhere."""
        records: dict[str, Record] = getattr(self, table)
        if token not in records:
            raise BadInput(self.path(table), f"has no record {token!r}", "copy the table again")
        return records[token]

    def field(self, table: str, record: Record, key: str) -> Any:
        """A field of a record; BadInput when it is missing."""
        if key not in record:
            raise BadInput(self.path(table), f"record {record.get('token')!r} has no {key}")
        return record[key]

    def scenes(self) -> dict[str, Record]:
        """The scenes by name."""
        return {str(self.field("scene", r, "name")): r for r in self.scene.values()}

    def samples_of(self, scene: Record) -> list[Record]:
        """The samples of a scene in time order."""
        found = self._of_scene.get(str(scene["token"]), [])
        return sorted(found, key=lambda r: int(self.field("sample", r, "timestamp")))

    def data_of(self, sample: Record) -> dict[str, Record]:
        """The keyframe data of a sample by the channel of their sensors."""
        out = {}
        for record in self._of_sample.get(str(sample["token"]), ()):
            token = self.field("sample_data", record, "calibrated_sensor_token")
            calibrated = self.get("calibrated_sensor", token)
            sensor_token = self.field("calibrated_sensor", calibrated, "sensor_token")
            sensor = self.get("sensor", sensor_token)
            out[str(self.field("sensor", sensor, "channel"))] = record
        return out

    def _table(
        self, name: str, keep: Callable[[Record], bool] = lambda _: True
    ) -> dict[str, Record]:
        path = self.path(name)
        if not path.exists():
            raise BadInput(path, "no such table", "a nuScenes version folder holds it")

        def row(record: Record) -> Record | None:
            # Records that nobody needs are dropped while the file is read: most of them are.
            return record if keep(record) else None

        try:
            with path.open(encoding="utf-8") as file:
                records = json.load(file, object_hook=row)
        except (ValueError, OSError, RecursionError) as error:
            raise BadInput(path, f"cannot be read as JSON ({error})", "copy it again") from None
        if not isinstance(records, list):
            raise BadInput(path, "is not a list of records")
        kept = [r for r in records if r is not None]
        if not all(isinstance(r, dict) and isinstance(r.get("token"), str) for r in kept):
            raise BadInput(path, "holds a record without a token")
        return {r["token"]: r for r in kept}


def find_version(folder: Path) -> Path:
    """The folder of the tables: ``folder`` itself or its only ``v1.0-*``; BadInput otherwise."""
    if not folder.is_dir():
        raise BadInput(folder, "no such folder")
    if (folder / "sample_data.json").exists():
        return folder
    found = sorted(p.parent for p in folder.glob("v1.0-*/sample_data.json"))
    if len(found) > 1:
        names = ", ".join(p.name for p in found)
        raise BadInput(folder, f"holds {names}", f"name one: {found[0]}")
    if not found:
        raise BadInput(folder, "holds no tables (v1.0-*/sample_data.json)")
    return found[0]


def read_tables(folder: Path) -> Tables:
    """The tables of a data set, kept for the next scene of the same one."""
    version = find_version(folder).resolve()
    stamp = tuple(p.stat().st_mtime_ns for p in sorted(version.glob("*.json")))
    return _cached(version, stamp)


@lru_cache(maxsize=2)
def _cached(version: Path, _stamp: tuple[int, ...]) -> Tables:
    return Tables(version)
