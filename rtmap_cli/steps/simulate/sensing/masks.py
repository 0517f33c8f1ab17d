"""Label masks of simulated cameras: the ground pixel by pixel, boxes drawn over it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from rtmap_cli.geometry.poses import transform
from rtmap_cli.logs.log import Camera
from rtmap_cli.steps.simulate.images.render import lattice_rays, optics_of, pixel_rays
from rtmap_cli.steps.simulate.images.render_boxes import FACES, clip_near, corners_of, project
from rtmap_cli.steps.simulate.sensing.ground_labels import (
    CROSSWALK,
    CURB,
    LABEL,
    MARKING,
    ROAD,
    SIDEWALK,
    SKY,
    TERRAIN,
    GroundLabels,
)
from rtmap_cli.steps.simulate.sensing.scene import Scene
from rtmap_cli.steps.simulate.worlds.roadside import CROWN
from rtmap_cli.steps.simulate.worlds.world_ground import noise_fields, opencv

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]

FARTHEST = 150.0
"""Ground beyond it (m) is labelled terrain: a pixel covers metres of it."""
FLAT = 0.05
"""Boxes lower than this are shadows (m)."""


def draw_mask(ground: GroundLabels, scene: Scene, camera: Camera) -> Mask:
    """(H, W) labels of what a camera of a scene sees."""
    cv2 = opencv()
    pose = scene.level_SE3_ego @ camera.ego_SE3_camera
    optics = optics_of(camera)
    rx, ry = pixel_rays(camera.width, camera.height, optics, 1)
    direction = np.stack([rx, ry, np.ones_like(rx)], axis=-1).reshape(-1, 3) @ pose[:3, :3].T
    if scene.terrain is None:
        slope, rise = -direction[:, 2], float(pose[2, 3] - scene.ground_z)
    else:
        rays = lattice_rays(camera.width, camera.height, optics)
        seen, rise = scene.terrain.slant(cv2, camera.width, camera.height, 1, rays, pose)
        slope = seen.ravel().astype(np.float64)
    out = np.where(slope > 0, TERRAIN, SKY).astype(np.uint8)
    near = np.flatnonzero(slope > rise / FARTHEST)
    places = pose[:2, 3] + (rise / slope[near])[:, None] * direction[near, :2]
    out[near] = ground.at(transform(scene.map_SE3_level, places)) & np.uint8(LABEL)
    mask = out.reshape(camera.height, camera.width)
    for box, kind in zip(scene.boxes, scene.kinds, strict=True):
        if box[6] - box[5] >= FLAT:
            _draw(cv2, mask, camera, pose, box, int(kind))
    return mask


def spoil(mask: Mask, share: float, rng: np.random.Generator) -> Mask:
    """A mask (H, W) as a network might have drawn it: borders off by about 8 · ``share`` pixels,
    paint, crossings and kerbs taken for road in patches that cover ``share`` of the image,
    sidewalk for road and verge for sidewalk in patches half as frequent."""
    fields = noise_fields()
    height, width = mask.shape

    def field(layer: int) -> NDArray[np.float32]:
        i, j = rng.integers(0, len(fields), 2)
        rows = (np.arange(height) + i) % len(fields)
        columns = (np.arange(width) + j) % len(fields)
        return fields[rows[:, None], columns, layer]

    off = 8 * share
    row = np.arange(height)[:, None] + np.round(off * field(1)).astype(int)
    column = np.arange(width)[None, :] + np.round(off * field(1)).astype(int)
    out = mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    missed, mixed = field(2) < norm.ppf(share), field(2) < norm.ppf(share / 2)
    out[missed & np.isin(out, (MARKING, CROSSWALK, CURB))] = ROAD
    out[mixed & (out == SIDEWALK)] = ROAD
    out[mixed & (out == TERRAIN)] = SIDEWALK
    return out


def _draw(cv2: Any, mask: Mask, camera: Camera, pose: Array, box: Array, label: int) -> None:
    rotation, place = pose[:3, :3], pose[:3, 3]
    if box[10] == CROWN:
        centre = (np.array([box[0], box[1], (box[5] + box[6]) / 2]) - place) @ rotation
        if centre[2] > 1.0:
            uv = project(camera, centre[None])[0]
            radius = camera.intrinsics[0, 0] * box[3] / 2 / centre[2]
            if np.abs(uv).max() < 20_000:
                cv2.circle(mask, tuple(round(c) for c in uv.tolist()), round(radius), label, -1)
        return
    local = (corners_of(box) - place) @ rotation
    for face in FACES:
        polygon = clip_near(local[list(face)])
        if polygon is not None:
            uv = np.clip(project(camera, polygon), -30_000, 30_000)
            cv2.fillConvexPoly(mask, np.round(uv * 16).astype(np.int32), label, cv2.LINE_8, 4)
