"""One frame as the network gets it: images and projections, the wide picture, the truth around."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rtmap_cli.geometry.cameras import levelled
from rtmap_cli.maps.crop import MapIndex
from rtmap_models.bev import BevWarp
from rtmap_models.config import ModelConfig
from rtmap_models.data.samples import Array, Scene
from rtmap_models.data.shards import SCENE_MARGIN_M, window_half, window_size, write_shard


@dataclass(frozen=True)
class View:
    """Images uint8 (N, H, W, 3), ``ego_to_image`` (N, 3, 4) from the ego frame on the road, the
    elements around it, and its true pose."""

    images: NDArray[np.uint8]
    ego_to_image: NDArray[np.float32]
    scene: Scene
    map_SE3_ego: Array
    plane: Array | None = None  # (3,) the road z = a x + b y + c in that frame, where known


def scene_at(index: MapIndex, pose: Array, config: ModelConfig) -> Scene:
    """The elements around a pose, also a little outside the range."""
    local = index.crop(pose, config.range_m, margin=SCENE_MARGIN_M)
    local = [e for e in local if e.class_name in config.classes]
    points = [e.points[:, :2] for e in local]
    return Scene(
        np.concatenate([*points, np.zeros((0, 2))]),
        np.cumsum([0] + [len(p) for p in points]).astype(np.int64),
        np.array([config.classes.index(e.class_name) for e in local], dtype=np.int64),
    )


def wide_warp(config: ModelConfig) -> BevWarp:
    """What makes the wide bird's-eye picture: the module that the graph runs, a wider window."""
    return BevWarp(*window_half(config), *window_size(config), config.supersample)


@torch.no_grad()
def wide_picture(warp: BevWarp, view: View) -> NDArray[np.uint8]:
    """(rows, columns, 4) bird's-eye picture of a view."""
    images, projections = (torch.from_numpy(x)[None] for x in (view.images, view.ego_to_image))
    picture = warp(images, projections)[0]
    return picture.round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


LEFT_PLANE = np.array([0.002, 0.003, 0.015])
"""Standard deviations of what stays wrong after levelling: slopes along x and y, metres."""

LEFT_SPREAD = 0.5
"""By how much that differs from frame to frame: the spread of the logarithm of a factor."""


class Pictures:
    """Collects views and writes them as a shard of training frames.

    Where a view's plane is known its picture is levelled but for `LEFT_PLANE`.
    """

    def __init__(self, config: ModelConfig, rng: np.random.Generator, keep_images: bool):
        self.warp, self.rng, self.keep_images = wide_warp(config), rng, keep_images
        self.views: list[View] = []
        self.pictures: list[NDArray[np.uint8]] = []

    def add(self, view: View) -> None:
        """Make the picture of one more view."""
        if view.plane is not None:
            left = LEFT_PLANE * np.exp(self.rng.normal(0.0, LEFT_SPREAD))
            plane = view.plane + self.rng.normal(0.0, 1.0, 3) * left
            cameras = levelled(view.ego_to_image, plane).astype("f4")
            view = replace(view, ego_to_image=cameras, plane=view.plane - plane)
        self.views.append(view)
        self.pictures.append(wide_picture(self.warp, view))

    def write(self, folder: Path, name: str, info: dict[str, Any]) -> None:
        """Write the shard ``name``."""
        kept: dict[str, Any] = {}
        if self.keep_images:
            kept["images"] = np.stack([v.images for v in self.views])
            kept["ego_to_image"] = np.stack([v.ego_to_image for v in self.views])
            unknown = np.full(3, np.nan)
            kept["plane"] = np.stack([unknown if v.plane is None else v.plane for v in self.views])
        scenes = [v.scene for v in self.views]
        write_shard(folder, name, np.stack(self.pictures), scenes, info, **kept)
