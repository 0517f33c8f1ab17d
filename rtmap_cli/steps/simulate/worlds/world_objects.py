"""Vehicles on the road, and what of a world is near."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import transform, xyyaw_of
from rtmap_cli.logs.log import Occluder
from rtmap_cli.steps.simulate.worlds.world import World

Array = NDArray[np.float64]


def random_occluders(
    world: World,
    map_SE3_ego: Array,
    rng: np.random.Generator,
    mean: float = 4.0,
    ground_z: float = 0.0,
) -> tuple[Occluder, ...]:
    """Vehicles at random places on the asphalt within 40 m (Poisson ``mean``), for single frames.

    They point roughly along or against the ego heading and never stand on the ego vehicle.
    """
    out: list[Occluder] = []
    wanted = int(rng.poisson(mean))
    places = rng.uniform([-40.0, -18.0], [40.0, 18.0], (wanted * 6, 2))
    inside = shapely.contains_xy(world.surface, *transform(map_SE3_ego, places).T)
    for x, y in places[inside]:
        if abs(x - 1.4) < 6 and abs(y) < 2.4:
            continue
        if any(np.hypot(o.x - x, o.y - y) < 6 for o in out):
            continue
        yaw = float(rng.choice([0.0, np.pi]) + rng.normal(0, 0.1))
        out.append(random_vehicle(rng, float(x), float(y), yaw, ground_z))
        if len(out) >= wanted:
            break
    return tuple(out)


def random_vehicle(
    rng: np.random.Generator, x: float, y: float, yaw: float, ground_z: float = 0.0
) -> Occluder:
    """A car, or in 15 % of cases a van or truck."""
    if rng.random() < 0.85:
        size = (rng.uniform(3.9, 5.2), rng.uniform(1.75, 2.0), rng.uniform(1.4, 1.85))
    else:
        size = (rng.uniform(6.0, 11.0), rng.uniform(2.1, 2.5), rng.uniform(2.4, 3.5))
    length, width, height = (float(v) for v in size)
    return Occluder(x, y, yaw, length, width, height, ground_z)


def objects_near(world: World, map_SE3_ego: Array, radius: float = 70.0) -> Array:
    """``World.objects`` around the vehicle with x, y, yaw in the ego frame."""
    x, y, yaw = xyyaw_of(map_SE3_ego)
    table = world.objects
    near = table[np.hypot(table[:, 0] - x, table[:, 1] - y) < radius].copy()
    c, s = np.cos(yaw), np.sin(yaw)
    near[:, :2] = (near[:, :2] - (x, y)) @ np.array([[c, -s], [s, c]])
    near[:, 2] -= yaw
    return near
