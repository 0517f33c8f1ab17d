"""LiDAR sweeps of a world: rays against the ground, boxes and crowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert, transform
from rtmap_cli.steps.simulate.sensing.ground_labels import (
    CROSSWALK,
    CURB,
    LABEL,
    MARKING,
    PAINTED,
    RAISED,
    ROAD,
    SIDEWALK,
    TERRAIN,
    GroundLabels,
)
from rtmap_cli.steps.simulate.sensing.scene import Scene
from rtmap_cli.steps.simulate.worlds.roadside import CROWN

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR: elevations of its rings and step in azimuth (degrees), reach (m), mount
    ``x`` and height above the road (m)."""

    elevations: tuple[float, ...]
    azimuth_step: float
    reach: float
    x: float = 0.8
    height: float = 2.0


LIDARS = {
    "vlp16": Lidar(tuple(range(-15, 16, 2)), 0.2, 100.0),
    "hdl32": Lidar(tuple(np.linspace(-30.67, 10.67, 32).tolist()), 0.2, 70.0),
    "os64": Lidar(tuple(np.linspace(-22.5, 22.5, 64).tolist()), 0.35, 100.0),
    "hdl64": Lidar(tuple(np.linspace(-24.8, 2.0, 64).tolist()), 0.25, 120.0),
}
"""Like a Velodyne VLP-16 (28,800 rays), an HDL-32E (57,600), an Ouster OS1-64 (65,856) and a
Velodyne HDL-64E (92,160)."""

NEAR_BOX = 2.0
"""The vehicle moves less during a turn (m)."""
FARTHEST_CURB = 60.0
"""Beyond it (m) curbs are not drawn: a beam is wider than they are high."""
RANGE_NOISE, DROPPED = 0.02, 0.03
"""Standard deviation of a range (m), share of rays without an answer."""
BRIGHTNESS = {ROAD: 0.10, CROSSWALK: 0.10, MARKING: 0.10, CURB: 0.20, SIDEWALK: 0.22, TERRAIN: 0.30}
PAINT, BODY = 0.55, 0.35
"""Mean intensity of the ground by label, of paint and of everything that stands."""


@dataclass(frozen=True)
class Turning:
    """How the vehicle moves while the LiDAR turns: ``time`` (k,) s from the frame's time, rising
    to 0, and ``now_SE3_then`` (k, 4, 4), the ego frame of these times in the frame's."""

    time: Array
    now_SE3_then: Array

    def at(self, share: Array) -> tuple[Array, Array]:
        """Times (n,) and motions (n, 4, 4) after shares (n,) of the turn."""
        slot = np.minimum((share * len(self.time)).astype(np.int64), len(self.time) - 1)
        return self.time[slot], self.now_SE3_then[slot]


def sweep(
    lidar: Lidar,
    ground: GroundLabels,
    scene: Scene,
    rng: np.random.Generator,
    turning: Turning | None = None,
    curb: float = 0.0,
) -> Array:
    """(n, 4) x, y, z (ego frame, m) and intensity in [0, 1] of one turn of a LiDAR in a scene.

    The vehicle stands still during the turn; with ``turning`` it moves, and the result is (n, 5)
    with the time of each point, in whose ego frame it is. What lies behind a curb is ``curb``
    metres higher than the road, with a face between them.
    """
    lean = scene.level_SE3_ego
    turn = np.radians(np.arange(0.0, 360.0, lidar.azimuth_step))
    rise = np.radians(np.array(lidar.elevations))
    azimuth, elevation = (a.ravel() for a in np.meshgrid(turn, rise))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    back = rng.random(len(rays)) >= DROPPED
    rays, azimuth = rays[back], azimuth[back]
    mount = np.array([[lidar.x, 0.0, lidar.height + scene.ground_z]])
    time = np.zeros(len(rays))
    own = rays
    if turning is None:
        origin, rays = transform(lean, mount)[0], rays @ lean[:3, :3].T
    else:
        time, moves = turning.at(azimuth / (2 * np.pi))
        pose = lean @ moves
        origin = pose[:, :3, :3] @ mount[0] + pose[:, :3, 3]
        rays = np.einsum("nij,nj->ni", pose[:, :3, :3], rays)
    distance = scene.ground_distance(origin, rays)
    if curb:
        distance = _over_curbs(ground, scene, origin, rays, distance, curb)
    on_ground = np.ones(len(rays), bool)
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    centre = origin if origin.ndim == 1 else origin.mean(axis=0)
    for box in scene.boxes:
        rows = _towards(centre, bearing, box)
        if not len(rows):
            continue
        start = origin if origin.ndim == 1 else origin[rows]
        meet = _sphere if box[10] == CROWN else _box
        hit = meet(start, rays[rows], box)
        nearer = hit < distance[rows]
        rows = rows[nearer]
        distance[rows], on_ground[rows] = hit[nearer], False
    kept = distance < lidar.reach
    rays, distance, on_ground = rays[kept], distance[kept], on_ground[kept]
    if turning is not None:
        origin = origin[kept]
    exact = origin + distance[:, None] * rays
    intensity = np.full(len(rays), BODY)
    labels = ground.at(transform(scene.map_SE3_level, exact[on_ground, :2]))
    table = np.array([BRIGHTNESS.get(k, 0.1) for k in range(LABEL + 1)])
    intensity[on_ground] = np.where(labels & PAINTED, PAINT, table[labels & np.uint8(LABEL)])
    intensity *= np.exp(rng.normal(0, 0.25, len(rays)))
    far = (distance + rng.normal(0, RANGE_NOISE, len(rays)))[:, None]
    light = np.clip(intensity, 0, 1)
    if turning is not None:
        return np.column_stack([mount + far * own[kept], light, time[kept]])
    return np.column_stack([transform(invert(lean), origin + far * rays), light])


def _over_curbs(
    ground: GroundLabels, scene: Scene, origin: Array, rays: Array, road: Array, curb: float
) -> Array:
    """(n,) distances to a ground that is ``curb`` metres higher behind the curbs.

    A ray that passes the raised height over the road and would meet the road behind the curb meets
    the face of the curb between the two, which is found by bisection.
    """
    origin = np.broadcast_to(origin, rays.shape)

    def raised(t: Array, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        places = transform(scene.map_SE3_level, (origin[rows] + t[:, None] * rays[rows])[:, :2])
        return (ground.at(places) & RAISED) != 0

    out = road.copy()
    # Where the height over the road is curb, by the secant: the ground is even over that length.
    near = np.flatnonzero(road < FARTHEST_CURB)
    back = np.minimum(curb / np.maximum(-rays[near, 2], 0.02), 0.5 * road[near])
    over = scene.clearance(origin[near] + (road[near] - back)[:, None] * rays[near])
    top = road.copy()
    top[near] = np.maximum(road[near] - back * curb / np.maximum(over, 0.2 * curb), 0.0)
    behind = raised(top[near], near)
    out[near[behind]] = top[near[behind]]
    rest = near[~behind]
    rest = rest[np.isfinite(road[rest])]
    face = rest[raised(road[rest], rest)]
    low, high = top[face], road[face]
    for _ in range(8):
        middle = (low + high) / 2
        inside = raised(middle, face)
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    out[face] = (low + high) / 2
    return out


def _towards(centre: Array, bearing: Array, box: Array) -> NDArray[np.int64]:
    """The rays whose bearing (n,) may meet a box."""
    radius = np.hypot(box[3], box[4]) / 2 + NEAR_BOX
    dx, dy = box[0] - centre[0], box[1] - centre[1]
    away = np.hypot(dx, dy)
    if away <= radius:
        return np.arange(len(bearing))
    off = (bearing - np.arctan2(dy, dx) + np.pi) % (2 * np.pi) - np.pi
    return np.flatnonzero(np.abs(off) <= np.arcsin(radius / away))


def _box(origin: Array, rays: Array, box: Array) -> Array:
    """(n,) distance to a box along rays (n, 3), inf where they miss (slabs)."""
    c, s = np.cos(box[2]), np.sin(box[2])
    dx, dy = origin[..., 0] - box[0], origin[..., 1] - box[1]
    start = np.stack([c * dx + s * dy, c * dy - s * dx, origin[..., 2]], axis=-1)
    along = np.stack(
        [c * rays[:, 0] + s * rays[:, 1], c * rays[:, 1] - s * rays[:, 0], rays[:, 2]], axis=-1
    )
    low = np.array([-box[3] / 2, -box[4] / 2, box[5]])
    high = np.array([box[3] / 2, box[4] / 2, box[6]])
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - start) / along, (high - start) / along
    enter, leave = np.fmin(a, b).max(axis=1), np.fmax(a, b).min(axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def _sphere(origin: Array, rays: Array, box: Array) -> Array:
    """(n,) distance to a crown along rays, inf where they miss."""
    centre = np.array([box[0], box[1], (box[5] + box[6]) / 2]) - origin
    along = (rays * centre).sum(axis=-1)
    off = (centre**2).sum(axis=-1) - along**2
    room = (box[3] / 2) ** 2 - off
    enter = along - np.sqrt(np.maximum(room, 0))
    return np.where((room > 0) & (enter > 0), enter, np.inf)
