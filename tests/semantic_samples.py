"""Masks for real images by a stated simple rule, and small logs with masks for tests."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import uniform_filter

from rtmap_cli.geometry.cameras import horizon_row
from rtmap_cli.logs.log import Camera, Frame, Log, Rig
from rtmap_cli.logs.native import NativeLogWriter, decode_image

VOID, ROAD, MARKING, TERRAIN = range(4)
NAMES = ("void--unlabeled", "construction--flat--road", "marking--general", "nature--terrain")


EYE = 1.5
"""Height of a camera above the ground that the rule assumes (m)."""


def paint_rule(image: NDArray[np.uint8], horizon: float, focal: float) -> NDArray[np.uint8]:
    """Labels (H, W) of an image (H, W, 3): nothing above the horizon; red (R − G > 25), blue (B − R
    > 15) and black (below 25) is the car itself, nothing; green (2G − R − B > 24, G > R) is
    terrain; what is 25 grey levels brighter than the ground 0.25 m to both sides of it, across or
    along the view, is a marking, and so is yellow (min(R, G) − B > 45) that is 8 brighter; the rest
    is road. The ground is taken to lie `EYE` m under the camera."""
    rgb = image.astype(np.float32)
    r, g, b = np.moveaxis(rgb, -1, 0)
    grey = uniform_filter(rgb.mean(axis=-1), 3)
    height, width = grey.shape
    below = np.maximum(np.arange(height) - horizon, 1.0)[:, None]
    columns, rows = np.arange(width)[None, :], np.arange(height)[:, None]
    across = np.round(0.25 * below / EYE).astype(int) + 2
    along = np.round(0.25 * below**2 / (focal * EYE)).astype(int) + 2
    left, right = np.maximum(columns - across, 0), np.minimum(columns + across, width - 1)
    up = np.broadcast_to(np.maximum(rows - along, 0), grey.shape)
    down = np.broadcast_to(np.minimum(rows + along, height - 1), grey.shape)
    beside = np.maximum(
        np.take_along_axis(grey, left, axis=1), np.take_along_axis(grey, right, axis=1)
    )
    before = np.maximum(
        np.take_along_axis(grey, up, axis=0), np.take_along_axis(grey, down, axis=0)
    )
    brighter = grey - np.minimum(beside, before)
    out = np.full(grey.shape, ROAD, np.uint8)
    yellow = (np.minimum(r, g) - b > 45) & (brighter > 8)
    out[(brighter > 25) | yellow] = MARKING
    out[(2 * g - r - b > 24) & (g > r) & ~yellow] = TERRAIN
    out[(r - g > 25) & ~yellow | (b - r > 15) | (grey < 25)] = VOID
    out[: max(0, int(horizon))] = VOID
    return out


def write_labels(folder: Path, names: tuple[str, ...] = NAMES) -> None:
    """labels.json of a mask folder."""
    folder.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {"labels": [{"name": n} for n in names]}
    (folder / "labels.json").write_text(json.dumps(content), encoding="utf-8")


def write_paint_masks(log: Log, folder: Path) -> None:
    """Masks of all images of a log by `paint_rule`, named by frame."""
    write_labels(folder)
    cameras = {c.name: c for c in log.rig or ()}
    for frame in log.frames():
        for name, path in frame.images.items():
            camera = cameras[name]
            horizon = horizon_row(camera.intrinsics, camera.ego_SE3_camera)
            focal = float(camera.intrinsics[0, 0])
            labels = paint_rule(decode_image(path), horizon, focal)
            file = folder / name / f"{frame.index:06d}.png"
            file.parent.mkdir(exist_ok=True)
            Image.fromarray(labels).save(file)


CAMERA = "front"
SPEED, STEP_S = 10.0, 0.5
"""Of the vehicle of `ribbon_log` (m/s), and between its frames (s)."""
RIBBON = (
    "void--unlabeled",
    "construction--flat--road",
    "construction--flat--crosswalk-plain",
    "marking--general",
    "construction--flat--sidewalk",
)
"""Label list of `ribbon_log`."""


def ribbon_label(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.uint8]:
    """What lies at places of the map of `ribbon_log` (m): a road along x with a line at y = 1 and
    a crosswalk at x = 12 … 15, sidewalks beyond |y| = 4."""
    out = np.full(np.shape(x), 1, np.uint8)
    out[np.abs(y - 1) < 0.15] = 3
    out[(x > 12) & (x < 15)] = 2
    out[np.abs(y) > 4] = 4
    return out


def ribbon_rig() -> Rig:
    """One camera 1.5 m above the road that looks forward and 15° down."""
    down = np.radians(15)
    pose = np.eye(4)
    pose[:3, 0] = (0, -1, 0)
    pose[:3, 1] = (-np.sin(down), 0, -np.cos(down))
    pose[:3, 2] = (np.cos(down), 0, -np.sin(down))
    pose[:3, 3] = (1.0, 0.0, 1.5)
    k = np.array([[220.0, 0, 159.5], [0, 220.0, 99.5], [0, 0, 1.0]])
    return Rig((Camera(CAMERA, 320, 200, k, pose),))


def ribbon_mask(camera: Camera, x: float) -> NDArray[np.uint8]:
    """Labels (H, W) that the camera sees from the vehicle at (x, 0)."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    k, pose = camera.intrinsics, camera.ego_SE3_camera
    local = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones(u.shape)], -1)
    rays = local @ pose[:3, :3].T
    depth = -pose[2, 3] / np.minimum(rays[..., 2], -1e-6)
    labels = ribbon_label(x + pose[0, 3] + depth * rays[..., 0], depth * rays[..., 1])
    return np.where(rays[..., 2] < -0.02, labels, 0).astype(np.uint8)


def ribbon_sweep(x: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """(n, 4) points of the ground around the vehicle at (x, 0), paint brighter."""
    xy = rng.uniform((2.0, -7.0), (24.0, 7.0), (6000, 2))
    painted = ribbon_label(x + xy[:, 0], xy[:, 1]) == 3
    intensity = np.clip(np.where(painted, 0.6, 0.1) * rng.lognormal(0, 0.2, len(xy)), 0, 1)
    return np.column_stack([xy, np.zeros(len(xy)), intensity])


def ribbon_log(folder: Path, frames: int = 4, delay: float = 0.1, sweeps: bool = True) -> Path:
    """A native log along +x at `SPEED` whose camera exposes ``delay`` s after the frame, its LiDAR
    0.04 s before it; sweeps are in the ego frame of their own time."""
    rig = ribbon_rig()
    rng = np.random.default_rng(0)
    writer = NativeLogWriter(folder, "ribbon", "EPSG:32632", rig)
    folder.mkdir(parents=True, exist_ok=True)
    early = 0.04
    for k in range(frames):
        time = 10**18 + round(k * STEP_S * 1e9)
        x = 500_000.0 + SPEED * STEP_S * k
        pose = np.eye(4)
        pose[:2, 3] = x, 5_000_000.0
        moved = np.array([SPEED * STEP_S, 0.0, 0.0]) if k else None
        frame = Frame(k, time, pose, np.array([0.5, 0.5, 0.01]), moved, np.full(3, 0.01))
        mask = ribbon_mask(rig.cameras[0], SPEED * (STEP_S * k + delay))
        writer.add(
            frame,
            {CAMERA: _encoded(np.repeat(mask[..., None] * np.uint8(50), 3, axis=-1), "JPEG")},
            {CAMERA: time + round(delay * 1e9)},
            ribbon_sweep(SPEED * (STEP_S * k - early), rng) if sweeps else None,
            {CAMERA: _encoded(mask, "PNG")},
            time - round(early * 1e9),
        )
    writer.close()
    write_labels(folder / "masks", RIBBON)
    return folder


def _encoded(image: NDArray[np.uint8], kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, kind)
    return buffer.getvalue()
