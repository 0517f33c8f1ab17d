"""LiDAR sweeps of a world: rays against the ground, boxes and crowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert, transform
from rtmap_cli.steps.simulate.sensing.ground_labels import (
    CROSSWALK,
    CURB,
    MARKING,
    PAINTED,
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
}
"""Like a Velodyne VLP-16 (28,800 rays), an HDL-32E (57,600) and an Ouster OS1-64 (65,856)."""

RANGE_NOISE, DROPPED = 0.02, 0.03
"""Standard deviation of a range (m), share of rays without an answer."""
BRIGHTNESS = {ROAD: 0.10, CROSSWALK: 0.10, MARKING: 0.10, CURB: 0.20, SIDEWALK: 0.22, TERRAIN: 0.30}
PAINT, BODY = 0.55, 0.35
"""Mean intensity of the ground by label, of paint and of everything that stands."""


def sweep(lidar: Lidar, ground: GroundLabels, scene: Scene, rng: np.random.Generator) -> Array:
    """(n, 4) x, y, z (ego frame, m) and intensity in [0, 1] of one turn of a LiDAR in a scene.

    The vehicle stands still during the turn.
    """
    lean = scene.level_SE3_ego
    turn = np.radians(np.arange(0.0, 360.0, lidar.azimuth_step))
    rise = np.radians(np.array(lidar.elevations))
    azimuth, elevation = (a.ravel() for a in np.meshgrid(turn, rise))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    rays = rays[rng.random(len(rays)) >= DROPPED] @ lean[:3, :3].T
    origin = transform(lean, np.array([[lidar.x, 0.0, lidar.height + scene.ground_z]]))[0]
    distance = scene.ground_distance(origin, rays)
    on_ground = np.ones(len(rays), bool)
    for box in scene.boxes:
        hit = _sphere(origin, rays, box) if box[10] == CROWN else _box(origin, rays, box)
        nearer = hit < distance
        distance[nearer], on_ground[nearer] = hit[nearer], False
    kept = distance < lidar.reach
    rays, distance, on_ground = rays[kept], distance[kept], on_ground[kept]
    exact = origin + distance[:, None] * rays
    intensity = np.full(len(rays), BODY)
    labels = ground.at(transform(scene.map_SE3_level, exact[on_ground, :2]))
    table = np.array([BRIGHTNESS.get(k, 0.1) for k in range(PAINTED)])
    intensity[on_ground] = np.where(labels & PAINTED, PAINT, table[labels & ~np.uint8(PAINTED)])
    intensity *= np.exp(rng.normal(0, 0.25, len(rays)))
    measured = origin + (distance + rng.normal(0, RANGE_NOISE, len(rays)))[:, None] * rays
    return np.column_stack([transform(invert(lean), measured), np.clip(intensity, 0, 1)])


def _box(origin: Array, rays: Array, box: Array) -> Array:
    """(n,) distance to a box along rays (n, 3), inf where they miss (slabs)."""
    c, s = np.cos(box[2]), np.sin(box[2])
    dx, dy = origin[0] - box[0], origin[1] - box[1]
    start = np.array([c * dx + s * dy, c * dy - s * dx, origin[2]])
    along = np.stack([c * rays[:, 0] + s * rays[:, 1], c * rays[:, 1] - s * rays[:, 0], rays[:, 2]])
    low = np.array([-box[3] / 2, -box[4] / 2, box[5]])
    high = np.array([box[3] / 2, box[4] / 2, box[6]])
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - start)[:, None] / along, (high - start)[:, None] / along
    enter, leave = np.fmin(a, b).max(axis=0), np.fmax(a, b).min(axis=0)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def _sphere(origin: Array, rays: Array, box: Array) -> Array:
    """(n,) distance to a crown along rays, inf where they miss."""
    centre = np.array([box[0], box[1], (box[5] + box[6]) / 2]) - origin
    along = rays @ centre
    off = centre @ centre - along**2
    room = (box[3] / 2) ** 2 - off
    enter = along - np.sqrt(np.maximum(room, 0))
    return np.where((room > 0) & (enter > 0), enter, np.inf)
