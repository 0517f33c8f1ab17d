"""Drives for images: along the lanes of a town or along a log, with traffic on the lanes.

What the vehicle knows of its poses (GNSS, odometry) comes from ``drives.initial_poses``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.errors import BadInput, UsageError
from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.logs.log import Occluder
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.simulate.driving.drives import Drive, drive_over_route, thinned
from rtmap_cli.steps.simulate.driving.routes import Lane, route_of
from rtmap_cli.steps.simulate.driving.tours import tour_of
from rtmap_cli.steps.simulate.perceiving.noise import generator
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.towns.profiles import STYLES
from rtmap_cli.steps.simulate.towns.town import make_town
from rtmap_cli.steps.simulate.worlds.world_objects import random_vehicle

Array = NDArray[np.float64]

TOWN_SPEED = 8.0
"""Metres per second of a drive through a town."""

REACH = 70.0
"""Vehicles farther than this are left out of a frame, metres."""

OFF_ROAD = 0.1
"""Share of lane vertices off the asphalt above which lanes and map do not belong together."""


def town_lanes(info: dict[str, Any], vector_map: VectorMap, surface: Any, path: Path) -> list[Lane]:
    """The lanes of a town map, made again from the seed, size and style that its history records.

    BadInput when the map is no town, or when the lanes do not lie on its asphalt.
    """
    made = info.get("town")
    if not isinstance(made, dict) or not {"seed", "size"} <= set(made):
        raise BadInput(
            path, "was not made by rtmap simulate town, its lanes are unknown", "name a --log"
        )
    style = str(made.get("style", "mixed"))
    if style not in STYLES:
        raise BadInput(path, f"its town has an unknown style {style}", "make it again")
    town = make_town(int(made["seed"]), float(made["size"]), style=style)
    points = np.concatenate(town.lanes)
    off = 1 - shapely.contains_xy(surface, points[:, 0], points[:, 1]).mean()
    if vector_map.crs != town.vector_map.crs or off > OFF_ROAD:
        raise BadInput(path, "its town was made by another version of rtmap", "make it again")
    return linked(town.lanes)


def linked(lines: Sequence[Array]) -> list[Lane]:
    """Lanes (n, 2) with their successors: those that start where a lane ends (within 5 cm)."""
    starts = cKDTree(np.array([line[0] for line in lines]))
    after = starts.query_ball_point(np.array([line[-1] for line in lines]), 0.05)
    return [
        Lane(
            f"{k:05d}",
            np.column_stack([line, np.zeros(len(line))]),
            tuple(f"{i:05d}" for i in sorted(after[k])),
        )
        for k, line in enumerate(lines)
    ]


def town_drive(
    lanes: Sequence[Lane], crs: str, key: DriveKey, kind: str, length: float, spacing: float
) -> Drive:
    """Drive number ``key.traversal`` over the lanes: drives of one world share a corridor.

    ``kind`` is straight, turning or tour; a frame every ``spacing`` metres. NoAnswer when the
    lanes hold no such route.
    """
    find = tour_of if kind == "tour" else partial(route_of, kind=kind)
    route = find(lanes, length_m=length, world_seed=key.world_seed, number=key.traversal)
    rate = TOWN_SPEED / spacing
    name = f"town-{kind}"
    return drive_over_route(name, crs, route, spacing, rate, lateral=0.0, key=key)


def lane_traffic(
    drive: Drive, lanes: Sequence[Lane], surface: Any, key: DriveKey, mean: float = 9.0
) -> Drive:
    """The drive with vehicles that follow lanes near it or are parked at their side.

    ``mean`` vehicles are drawn (Poisson); those that would run into the ego vehicle are left out.
    """
    rng = generator(*key.drive, "lane traffic")
    seconds = (drive.timestamp_ns - drive.timestamp_ns[0]) / 1e9
    ego = xyyaw_of(drive.pose)
    tree = cKDTree(ego[:, :2])
    near = [k for k, lane in enumerate(lanes) if tree.query(lane.points[:, :2])[0].min() < 30.0]
    boxes: list[list[Occluder]] = [[] for _ in range(len(drive))]
    for _ in range(rng.poisson(mean) if near else 0):
        lane = lanes[near[int(rng.integers(len(near)))]]
        parked = rng.random() < 0.45
        path = lane.points[:, :2] if parked else _follow(rng, lanes, lane)
        track = _parked(rng, path, surface, len(drive)) if parked else None
        if track is None:
            speed = TOWN_SPEED * rng.uniform(0.4, 1.3)
            track = _moving(path, seconds, speed, rng.uniform(-0.5, 1.0) * seconds[-1])
        vehicle = random_vehicle(rng, 0.0, 0.0, 0.0)
        frames = _seen_frames(ego, track, vehicle)
        for k in () if frames is None else frames:
            boxes[k].append(_in_ego(ego[k], track[k], vehicle))
    return replace(drive, occluders=[tuple(b) for b in boxes])


def _follow(rng: np.random.Generator, lanes: Sequence[Lane], lane: Lane) -> Array:
    """The way of a vehicle from one lane on, about 300 m, taking successors at random."""
    by_id = {x.lane_id: x for x in lanes}
    parts = [lane.points[:, :2]]
    total = float(arc_length(parts[0])[-1])
    while total < 300 and (known := [s for s in lane.successors if s in by_id]):
        lane = by_id[known[int(rng.integers(len(known)))]]
        parts.append(lane.points[1:, :2])
        total += float(arc_length(lane.points)[-1])
    return np.concatenate(parts)


def _moving(path: Array, seconds: Array, speed: float, delay: float) -> Array:
    """(n, 3) x, y, yaw along a path; NaN before its start and after its end."""
    s = arc_length(path)
    at = (seconds - delay) * speed
    yaw = np.unwrap(np.arctan2(*np.gradient(path, axis=0).T[::-1]))
    out = np.stack([np.interp(at, s, v) for v in (path[:, 0], path[:, 1], yaw)], axis=-1)
    out[(at < 0) | (at > s[-1])] = np.nan
    return out


def _parked(rng: np.random.Generator, path: Array, surface: Any, frames: int) -> Array | None:
    """(n, 3) a place at the right curb, None where the road leaves no room for it."""
    k = int(rng.integers(len(path) - 1))
    d = path[k + 1] - path[k]
    yaw = float(np.arctan2(d[1], d[0]))
    right = np.array([np.sin(yaw), -np.cos(yaw)])
    reach = np.arange(0.5, 8.0, 0.25)
    probes = path[k] + reach[:, None] * right
    outside = np.flatnonzero(~shapely.contains_xy(surface, probes[:, 0], probes[:, 1]))
    if not len(outside) or (offset := reach[outside[0]] - 1.4) < 1.6:
        return None
    return np.tile([*(path[k] + offset * right), yaw], (frames, 1))


def _seen_frames(ego: Array, track: Array, vehicle: Occluder) -> NDArray[np.int64] | None:
    """Frames in which the vehicle is near; None when it would run into the ego vehicle."""
    gap = track[:, :2] - ego[:, :2]
    along = gap[:, 0] * np.cos(ego[:, 2]) + gap[:, 1] * np.sin(ego[:, 2])
    across = gap[:, 1] * np.cos(ego[:, 2]) - gap[:, 0] * np.sin(ego[:, 2])
    # The ego origin lies over its rear axle: 4 m of vehicle in front, 1 m behind.
    half = vehicle.length / 2
    beside = (np.abs(across) < 1.6 + vehicle.width / 2) & (along > -2 - half) & (along < 5 + half)
    return None if beside.any() else np.flatnonzero(np.hypot(along, across) < REACH)


def _in_ego(ego: Array, place: Array, vehicle: Occluder) -> Occluder:
    c, s = np.cos(ego[2]), np.sin(ego[2])
    dx, dy = place[0] - ego[0], place[1] - ego[1]
    x, y, yaw = float(c * dx + s * dy), float(c * dy - s * dx), float(place[2] - ego[2])
    return replace(vehicle, x=x, y=y, yaw=(yaw + np.pi) % (2 * np.pi) - np.pi)


def first_frames(drive: Drive, spacing: float | None, rate: float | None, count: int) -> Drive:
    """The drive thinned to a spacing or rate, and its first ``count`` frames (0: all)."""
    if spacing is not None and rate is not None:
        raise UsageError("--spacing and --rate exclude each other")
    drive = thinned(drive, spacing, rate)
    n = min(count, len(drive)) if count else len(drive)
    boxes = None if drive.occluders is None else drive.occluders[:n]
    return replace(drive, timestamp_ns=drive.timestamp_ns[:n], pose=drive.pose[:n], occluders=boxes)
