"""A cloud folder as LAZ, as PLY, and as a picture from above."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.clouds import write_laz, write_ply
from rtmap_cli.logs.cloud import CloudFolder
from rtmap_cli.tables import whole_file

Array = NDArray[np.float64]

PIXELS = 1600
"""Longest side of the picture."""
LOW, HIGH = np.array([30.0, 42.0, 90.0]), np.array([250.0, 220.0, 120.0])
PATH = {"ok": (255, 60, 60), "degenerate": (255, 0, 255), "lost": (255, 255, 255)}


def _bounds(cloud: CloudFolder) -> Array:
    """(2, 3) corners of what a cloud holds; BadInput when it holds nothing."""
    boxes = [
        (v.xyz.min(axis=0), v.xyz.max(axis=0))
        for v in (cloud.read_tile(*t) for t in cloud.tiles())
        if len(v)
    ]
    if not boxes:
        raise BadInput(cloud.path, "holds no point")
    low, high = (np.array(side) for side in zip(*boxes, strict=True))
    return np.stack([low.min(axis=0), high.max(axis=0)])


def _parts(cloud: CloudFolder) -> Iterator[tuple[Array, Array]]:
    """Points and intensities, tile by tile."""
    for tile in cloud.tiles():
        voxels = cloud.read_tile(*tile)
        yield voxels.xyz, voxels.intensity


def write_laz_of(cloud: CloudFolder, path: Path) -> None:
    """cloud.laz, tile by tile."""
    write_laz(path, _parts(cloud), _bounds(cloud), cloud.crs)


def write_ply_of(cloud: CloudFolder, path: Path) -> None:
    """cloud.ply, float32 about its lower corner, tile by tile."""
    count = sum(len(xyz) for xyz, _ in _parts(cloud))
    write_ply(path, _parts(cloud), count, np.floor(_bounds(cloud)[0]), cloud.crs)


def write_overview(cloud: CloudFolder, path: Path) -> None:
    """A picture from above: colour by the height over the lowest point nearby, bright where the
    LiDAR's intensity is high; the trajectory by status."""
    from PIL import Image

    bounds = _bounds(cloud)
    size = np.ptp(bounds[:, :2], axis=0)
    scale = PIXELS / max(float(size.max()), 1.0)
    shape = np.ceil(size * scale).astype(int) + 1
    image = np.zeros((shape[1], shape[0], 3))
    for tile in cloud.tiles():
        voxels = cloud.read_tile(*tile)
        if not len(voxels):
            continue
        order = np.argsort(voxels.xyz[:, 2])
        xyz, light = voxels.xyz[order], voxels.intensity[order]
        at = ((xyz[:, :2] - bounds[0, :2]) * scale).astype(int)
        over = np.clip((xyz[:, 2] - np.percentile(xyz[:, 2], 5)) / 5.0, 0, 1)
        colour = LOW + over[:, None] * (HIGH - LOW) + 260.0 * np.clip(light, 0, 0.6)[:, None]
        image[shape[1] - 1 - at[:, 1], at[:, 0]] = np.clip(colour, 0, 255)
    trajectory = cloud.trajectory()
    at = ((trajectory.pose[:, :2, 3] - bounds[0, :2]) * scale).astype(int)
    for k, (x, y) in enumerate(np.clip(at, 1, shape - 2).tolist()):
        row = shape[1] - 1 - y
        image[row - 1 : row + 2, x - 1 : x + 2] = PATH[str(trajectory.status[k])]
    with whole_file(path) as temporary:
        Image.fromarray(image.astype(np.uint8)).save(temporary, "PNG")
