"""Whose path a simulation follows: a log on disk, or lanes of a town."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.log import Log, Rig
from rtmap_cli.logs.native import NativeLog
from rtmap_cli.logs.open import notes_of, open_log
from rtmap_cli.maps.crs import check_same_crs
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import history
from rtmap_cli.steps.simulate.driving.drive import town_drive, town_lanes
from rtmap_cli.steps.simulate.driving.drives import Drive, drive_of_log
from rtmap_cli.steps.simulate.driving.routes import Lane
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.worlds.heights import ground_of, stand_on
from rtmap_cli.steps.simulate.worlds.world import even_odd_surface

Array = NDArray[np.float64]

TOWN = "town:"
IN_RANGE = 40.0
"""A map whose bounding box is farther than this from every pose is out of range, metres."""


@dataclass(frozen=True)
class Source:
    """A drive with what belongs to it: the rig (None: unknown) and, in a town, the lanes;
    ``notes`` says what a log lacks."""

    drive: Drive
    rig: Rig | None
    ground_z: float
    lanes: list[Lane] | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Route:
    """Which way a drive through a town takes: ``kind`` straight or turning, lengths in metres."""

    kind: str
    length: float
    spacing: float


def find_source(
    spec: str, map_path: Path, vector_map: VectorMap, key: DriveKey, route: Route
) -> Source:
    """The drive that ``--log`` names: ``town:`` (lanes of the map itself) or a log folder.

    BadInput when the log or the town cannot be read, has another CRS or lies out of the map's
    range; NoAnswer when a town holds no such route.
    """
    if spec.startswith(TOWN):
        town = Path(spec.removeprefix(TOWN) or map_path)
        surface = even_odd_surface(vector_map)
        lanes = town_lanes(town_info(town), vector_map, surface, town)
        drive = town_drive(lanes, vector_map.crs, key, route.kind, route.length, route.spacing)
        drive = replace(drive, pose=stand_on(ground_of(vector_map), drive.pose))
        return Source(drive, None, 0.0, lanes)
    if spec + ":" == TOWN:
        raise BadInput(spec, "no such log folder", "write town: with a colon for lanes of the map")
    log = open_log(spec)
    check_same_crs(vector_map.crs, log.crs, map_path)
    drive = drive_of_log(log, _truth(log), 0.0)
    check_range(vector_map, drive.pose[:, :2, 3], map_path, spec)
    return Source(drive, log.rig, log.ground_z, None, tuple(notes_of(log)))


def _truth(log: Log) -> Any:
    """True poses of a native log, None where the log's own poses are the best known."""
    return log.truth_poses() if isinstance(log, NativeLog) else None


def town_info(path: Path) -> dict[str, Any]:
    """What the first version of a map says about how it was made."""
    versions = history(path)
    first = min(versions, key=lambda v: v.version)
    return dict(first.info)


def check_range(vector_map: VectorMap, path_xy: Array, map_path: Path, spec: str) -> None:
    """BadInput with the distance when the whole map lies away from a path (n, 2)."""
    if not len(vector_map):
        raise BadInput(map_path, "holds no element", "make it with rtmap import or simulate town")
    x0, y0, x1, y1 = vector_map.bounds()
    dx = np.maximum(np.maximum(x0 - path_xy[:, 0], path_xy[:, 0] - x1), 0)
    dy = np.maximum(np.maximum(y0 - path_xy[:, 1], path_xy[:, 1] - y1), 0)
    distance = float(np.hypot(dx, dy).min())
    if distance > IN_RANGE:
        raise BadInput(
            map_path,
            f"lies out of range of the drive of {spec}: {distance:.0f} m away",
            "use the map of that place (rtmap import av2 LOG_DIR -o MAP)",
        )
