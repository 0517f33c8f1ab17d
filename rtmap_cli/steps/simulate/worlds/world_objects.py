"""Boxes beside the road: buildings, trees, poles; and vehicles on it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import transform, xyyaw_of
from rtmap_cli.logs.log import Occluder

if TYPE_CHECKING:
    from rtmap_cli.steps.simulate.worlds.world import World

Array = NDArray[np.float64]

OBJECT_COLUMNS = ("x", "y", "yaw", "length", "width", "bottom", "top", "r", "g", "b", "kind")
"""Columns of ``World.objects``: map frame, metres, RGB 0…255; kind 0 box, 1 crown of a tree."""

BUILDING, CROWN = 0.0, 1.0


def roadside(surface: Any, seed: int) -> Array:
    """(n, 11) objects along the outer edges of the asphalt, never on it; see OBJECT_COLUMNS."""
    rng = np.random.default_rng([seed, 47])
    if surface.is_empty:
        return np.zeros((0, len(OBJECT_COLUMNS)))
    density = rng.uniform(0.4, 1.0)
    rows: list[list[float]] = []
    edge = shapely.boundary(surface)
    for ring in shapely.get_parts(edge):
        at = 0.0
        while at < ring.length:
            p, q = ring.interpolate(at), ring.interpolate(min(at + 1.0, ring.length))
            at += rng.exponential(7.0 / density) + 2.0
            heading = float(np.arctan2(q.y - p.y, q.x - p.x))
            out = rng.uniform(1.6, 14.0) * rng.choice([-1.0, 1.0])
            x, y = p.x - np.sin(heading) * out, p.y + np.cos(heading) * out
            rows += _object(rng, x, y, heading, abs(out))
    table = np.array(rows).reshape(-1, len(OBJECT_COLUMNS))
    if not len(table):
        return table
    clearance = shapely.distance(surface, shapely.points(table[:, :2]))
    reach = np.hypot(table[:, 3], table[:, 4]) / 2
    return table[clearance > np.where(table[:, 10] == CROWN, 1.0, reach + 0.8)]


def _object(
    rng: np.random.Generator, x: float, y: float, heading: float, away: float
) -> list[list[float]]:
    kind = rng.random()
    if kind < 0.4 and away > 5:
        size = min(away - 1.0, 9.0)
        shade = np.array([1, 0.95, 0.9]) * rng.uniform(55, 190) * (1 + rng.normal(0, 0.06, 3))
        box = [x, y, heading, rng.uniform(1.0, 1.8) * size, size, 0.0, rng.uniform(4, 16)]
        return [[*box, *shade, BUILDING]]
    if kind < 0.72:
        trunk = [x, y, 0.0, 0.3, 0.3, 0.0, 2.6, 70.0, 60.0, 50.0, BUILDING]
        green = np.array([rng.uniform(35, 80), rng.uniform(60, 110), rng.uniform(25, 60)])
        size = rng.uniform(2.5, 5.0)
        low = rng.uniform(1.8, 2.6)
        return [trunk, [x, y, 0.0, size, size, low, low + size, *green, CROWN]]
    grey = rng.uniform(60, 170)
    return [[x, y, 0.0, 0.18, 0.18, 0.0, rng.uniform(2.2, 8.0), grey, grey, grey, BUILDING]]


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
