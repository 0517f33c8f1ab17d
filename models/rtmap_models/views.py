"""One frame as the network gets it: images and projections, the wide picture, the truth around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from rtmap_cli.maps.crop import MapIndex
from rtmap_models.bev import BevWarp
from rtmap_models.config import ModelConfig
from rtmap_models.samples import Array, Scene
from rtmap_models.shards import SCENE_MARGIN_M, window_half, window_size


@dataclass(frozen=True)
class View:
    """Images uint8 (N, H, W, 3), ``ego_to_image`` (N, 3, 4) from the ego frame on the road, the
    elements around it, and its true pose."""

    images: NDArray[np.uint8]
    ego_to_image: NDArray[np.float32]
    scene: Scene
    map_SE3_ego: Array


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
def wide_picture(
    warp: BevWarp, images: NDArray[np.uint8], ego_to_image: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """(rows, columns, 4) bird's-eye picture of (N, H, W, 3) images."""
    picture = warp(torch.from_numpy(images)[None], torch.from_numpy(ego_to_image)[None])[0]
    return picture.round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
