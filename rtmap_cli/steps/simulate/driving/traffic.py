"""Vehicles beside the path and the sectors that they hide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.logs.log import Occluder
from rtmap_cli.maps.visibility import hidden

Array = NDArray[np.float64]

CAR = (4.6, 1.9, 1.6)
TRUCK = (9.0, 2.5, 3.2)
"""Length, width, height in metres."""

REACH = 60.0
"""Vehicles farther than this from the ego hide nothing in range and are left out, metres."""


@dataclass(frozen=True)
class _Vehicle:
    start: float  # metres along the path at the first frame
    speed: float  # metres per second along the path, negative: oncoming
    lateral: float  # metres to the left of the path
    heading: float  # radians relative to the path
    size: tuple[float, float, float]


def generated_traffic(
    rng: np.random.Generator, xyyaw: Array, seconds: Array, mean_count: float
) -> list[tuple[Occluder, ...]]:
    """Vehicles along a drive: same direction, oncoming, parked; 15 % trucks.

    ``xyyaw`` (n, 3) true poses in the map frame, ``seconds`` (n,). Returns the boxes of every
    frame in its ego frame. Vehicles keep to lanes beside the path, so none overlaps the ego.
    """
    travelled = arc_length(xyyaw)
    speed = travelled[-1] / max(seconds[-1] - seconds[0], 1e-9) if len(xyyaw) > 1 else 0.0
    vehicles = [_vehicle(rng, travelled, speed) for _ in range(rng.poisson(mean_count))]
    out = []
    for i, (x, y, yaw) in enumerate(xyyaw):
        boxes = []
        for v in vehicles:
            place = _on_path(v, v.start + v.speed * (seconds[i] - seconds[0]), travelled, xyyaw)
            dx, dy = place[0] - x, place[1] - y
            if np.hypot(dx, dy) > REACH:
                continue
            c, s = np.cos(yaw), np.sin(yaw)
            heading = float(wrap_angle(place[2] + v.heading - yaw))
            boxes.append(Occluder(c * dx + s * dy, c * dy - s * dx, heading, *v.size))
        out.append(tuple(boxes))
    return out


def _vehicle(rng: np.random.Generator, travelled: Array, speed: float) -> _Vehicle:
    size = TRUCK if rng.random() < 0.15 else CAR
    kind = rng.integers(3)
    if kind == 0:
        # Anywhere along the path: those that stay beside the ego all the way are few.
        start, side = rng.uniform(-40, travelled[-1] + 40), rng.choice([-1.0, 1.0])
        pace = speed * rng.uniform(0.6, 1.4)
        return _Vehicle(start, pace, side * rng.uniform(3.2, 3.8), 0.0, size)
    if kind == 1:
        start = rng.uniform(0, 2 * travelled[-1] + 1.0)
        return _Vehicle(start, -max(speed, 3.0), rng.uniform(3.5, 7.0), np.pi, size)
    side = rng.choice([-1.0, 1.0])
    lateral = side * rng.uniform(3.4, 5.5)
    return _Vehicle(rng.uniform(0, travelled[-1] + 1.0), 0.0, lateral, 0.0, size)


def _on_path(vehicle: _Vehicle, at: float, travelled: Array, xyyaw: Array) -> Array:
    """x, y, yaw of the path at ``at`` metres, shifted to the vehicle's lane; straight beyond."""
    inside = float(np.clip(at, 0.0, travelled[-1]))
    yaw = np.interp(inside, travelled, np.unwrap(xyyaw[:, 2]))
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    base = [np.interp(inside, travelled, xyyaw[:, k]) for k in range(2)]
    left = vehicle.lateral * np.array([-forward[1], forward[0]])
    return np.array([*(np.array(base) + (at - inside) * forward + left), yaw])


def visible(points: Array, occluders: tuple[Occluder, ...]) -> NDArray[np.bool_]:
    """(n,) True where no box lies between the ego origin and the point (n, 2) of the ego frame."""
    boxes = np.array([(o.x, o.y, o.yaw, o.length, o.width) for o in occluders])
    return ~hidden(points, boxes.reshape(-1, 5))
