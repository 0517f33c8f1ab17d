"""Boxes in images: vehicles with cabins and wheels, buildings, poles, tree crowns."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import transform
from rtmap_cli.logs.log import Camera, Occluder
from rtmap_cli.steps.simulate.images.slopes import Terrain
from rtmap_cli.steps.simulate.images.style import Style
from rtmap_cli.steps.simulate.worlds.roadside import CROWN, OBJECT_COLUMNS
from rtmap_cli.steps.simulate.worlds.world_objects import objects_near

if TYPE_CHECKING:
    from rtmap_cli.steps.simulate.worlds.world import World

Array = NDArray[np.float64]

FACES = ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7))
"""Sides and top of a box with corners (+,+), (+,-), (-,-), (-,+), first the bottom ones."""
SIDES = np.radians([0.0, -90.0, 180.0, 90.0])
"""Directions of the four sides in the axes of the box."""

NEAR = 0.15
"""Nearest depth that is drawn, metres."""


def scene_boxes(
    world: World,
    map_SE3_ego: Array,
    occluders: Sequence[Occluder],
    style: Style,
    ground_z: float,
    terrain: Terrain | None = None,
) -> Array:
    """(n, 11) boxes in the ego frame, far ones first: roadside objects and vehicles.

    The parts of a vehicle keep their order, whatever their own distances. On a ``terrain`` the
    boxes are in its level frame, and everything stands upright on it.
    """
    still = objects_near(world, map_SE3_ego)
    if terrain:
        still[:, 5:7] += terrain.heights(still[:, :2])[:, None]
        places = np.array([[o.x, o.y, o.z] for o in occluders]).reshape(-1, 3)
        xy = transform(terrain.level_SE3_ego, places)[:, :2]
        occluders = [
            replace(o, x=float(x), y=float(y), z=float(z))
            for o, (x, y), z in zip(occluders, xy, terrain.heights(xy), strict=True)
        ]
    else:
        still[:, 5:7] += ground_z
    rows: list[list[float]] = []
    away: list[float] = []
    for vehicle in occluders:
        parts = _vehicle(vehicle, style)
        rows += parts
        away += [float(np.hypot(vehicle.x, vehicle.y))] * len(parts)
    moving = np.array(rows).reshape(-1, len(OBJECT_COLUMNS))
    distance = np.concatenate([np.hypot(still[:, 0], still[:, 1]), away])
    return np.concatenate([still, moving])[np.argsort(-distance, kind="stable")]


def _vehicle(v: Occluder, style: Style) -> list[list[float]]:
    """Body, cabin and shadow of a vehicle; its colour follows its size, so it stays the same."""
    key = f"{v.length:.2f} {v.width:.2f} {v.height:.2f}"
    rng = np.random.default_rng([style.seed, zlib.crc32(key.encode())])
    grey = rng.uniform(15, 235)
    colour = grey * (1 + rng.normal(0, 0.03, 3))
    if rng.random() < 0.35:
        colour = rng.uniform(20, 200, 3)
    colour = np.clip(colour, 5, 250)
    glass = np.array([30.0, 34.0, 38.0]) * rng.uniform(0.7, 1.6)
    shadow = np.array(style.asphalt) * 0.3
    low = v.z + min(0.25, 0.15 * v.height)
    place = [v.x, v.y, v.yaw]
    out = [[*place, v.length, v.width, v.z + 0.01, v.z + 0.02, *shadow, 0.0]]
    if v.height > 2.3 or v.length < 2.6:
        out.append([*place, v.length, v.width, low, v.z + v.height, *colour, 0.0])
        return out
    waist = v.z + 0.58 * v.height
    back = -0.08 * v.length
    cabin = [v.x + np.cos(v.yaw) * back, v.y + np.sin(v.yaw) * back, v.yaw]
    out.append([*place, v.length, v.width, low, waist, *colour, 0.0])
    out.append([*cabin, 0.52 * v.length, 0.88 * v.width, waist, v.z + v.height, *glass, 0.0])
    top = [0.46 * v.length, 0.84 * v.width, v.z + v.height - 0.04, v.z + v.height]
    out.append([*cabin, *top, *colour, 0.0])
    return out


def draw_boxes(
    cv2: Any, image: NDArray[np.float32], camera: Camera, pose: Array, boxes: Array, style: Style
) -> None:
    """Draw boxes (ego frame, in this order) into a float image, with haze and shading."""
    if not len(boxes):
        return
    rotation, place = pose[:3, :3], pose[:3, 3]
    away = boxes[:, :2] - place[:2]
    distance = np.hypot(away[:, 0], away[:, 1])
    ahead = away @ rotation[:2, 2]
    radius = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
    side = np.abs(away @ rotation[:2, 0])
    half = camera.width / (2 * camera.intrinsics[0, 0])
    seen = (ahead > -radius) & (side < np.maximum(ahead, 0) * (half + 0.15) + 1.5 * radius + 0.5)
    seen &= radius * camera.intrinsics[0, 0] > 0.15 * np.maximum(ahead, 0.1)
    haze = np.array(style.haze)
    for k in np.flatnonzero(seen):
        box = boxes[k]
        fog = 1 - np.exp(-distance[k] / style.visibility)
        if box[10] == CROWN:
            _crown(cv2, image, camera, rotation, place, box, fog, haze)
            continue
        _box(cv2, image, camera, rotation, place, box, fog, haze, style)


def corners_of(box: Array) -> Array:
    """(8, 3) corners in the ego frame, bottom ring first."""
    c, s = np.cos(box[2]), np.sin(box[2])
    lx, ly = box[3] / 2, box[4] / 2
    x = np.array([lx, lx, -lx, -lx])
    y = np.array([ly, -ly, -ly, ly])
    ring = np.stack([box[0] + c * x - s * y, box[1] + s * x + c * y], axis=-1)
    low, high = np.full((4, 1), box[5]), np.full((4, 1), box[6])
    return np.concatenate([np.hstack([ring, low]), np.hstack([ring, high])])


def _box(
    cv2: Any, image: NDArray[np.float32], camera: Camera, rotation: Array, place: Array,
    box: Array, fog: float, haze: Array, style: Style,
) -> None:  # fmt: skip
    corners = corners_of(box)
    local = (corners - place) @ rotation
    if local[:, 2].max() < NEAR:
        return
    whole = local[:, 2].min() >= NEAR
    uv = project(camera, local) if whole else None
    if uv is not None:
        (u0, v0), (u1, v1) = uv.min(axis=0), uv.max(axis=0)
        if u1 < 0 or v1 < 0 or u0 > camera.width or v0 > camera.height:
            return
    # The viewer in the axes of the box tells which faces are turned towards it.
    c, s = np.cos(box[2]), np.sin(box[2])
    dx, dy = place[0] - box[0], place[1] - box[1]
    along, across = c * dx + s * dy, c * dy - s * dx
    seen = (
        along > box[3] / 2,
        across < -box[4] / 2,
        along < -box[3] / 2,
        across > box[4] / 2,
        place[2] > box[6],
    )
    lit = style.contrast * np.cos(style.sun - box[2] - SIDES)
    for n, face in enumerate(FACES):
        if not seen[n]:
            continue
        light = 1.08 if n == 4 else 0.82 + lit[n]
        colour = box[7:10] * light
        colour = colour + fog * (haze - colour)
        if uv is not None:
            _fill(cv2, image, uv[list(face)], colour)
            continue
        polygon = clip_near(local[list(face)])
        if polygon is not None:
            _fill(cv2, image, project(camera, polygon), colour)


def _crown(
    cv2: Any, image: NDArray[np.float32], camera: Camera, rotation: Array, place: Array,
    box: Array, fog: float, haze: Array,
) -> None:  # fmt: skip
    """A tree's crown: a round blot of its colour with a lighter upper half."""
    centre = np.array([box[0], box[1], (box[5] + box[6]) / 2])
    local = (centre - place) @ rotation
    if local[2] < 1.0:
        return
    uv = project(camera, local[None])[0]
    size = camera.intrinsics[0, 0] * box[3] / 2 / local[2]
    if not np.isfinite(uv).all() or np.abs(uv).max() > 20_000:
        return
    for shift, radius, light in ((0.0, size, 0.85), (0.25, 0.7 * size, 1.1)):
        colour = box[7:10] * light
        colour = colour + fog * (haze - colour)
        middle = (round(float(uv[0]) * 16), round(float(uv[1] - shift * size) * 16))
        cv2.circle(image, middle, round(radius * 16), colour.tolist(), -1, cv2.LINE_8, 4)


def clip_near(polygon: Array) -> Array | None:
    """The part of a camera-frame polygon beyond the near plane (Sutherland–Hodgman)."""
    depth = polygon[:, 2]
    if (depth >= NEAR).all():
        return polygon
    if (depth < NEAR).all():
        return None
    out = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= NEAR:
            out.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            out.append(a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(out)


def project(camera: Camera, local: Array) -> Array:
    """Camera-frame points (n, 3) → pixels (n, 2), with distortion."""
    xy = local[:, :2] / local[:, 2:]
    if any(camera.distortion):
        k1, k2, k3 = camera.distortion
        # Beyond the field of view the polynomial turns over; the radius is held there.
        r = np.minimum((xy * xy).sum(axis=1, keepdims=True), 1.2)
        xy = xy * (1 + r * (k1 + r * (k2 + r * k3)))
    k = camera.intrinsics
    u = k[0, 0] * xy[:, 0] + k[0, 1] * xy[:, 1] + k[0, 2]
    return np.stack([u, k[1, 1] * xy[:, 1] + k[1, 2]], axis=-1)


def _fill(cv2: Any, image: NDArray[np.float32], uv: Array, colour: Array) -> None:
    """Fill a convex polygon given in pixels."""
    points = np.round(np.clip(uv, -30_000, 30_000) * 16).astype(np.int32)
    cv2.fillConvexPoly(image, points, colour.tolist(), cv2.LINE_AA, 4)
