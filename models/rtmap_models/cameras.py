"""Feature maps of any number of calibrated cameras: made, chosen from, and read at ego points.

What both networks share. An absent camera is all zeros in its projection: it sees nothing and
changes nothing. Projection and sampling are float32 throughout: coordinates do not survive
bfloat16.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.bev import MIN_DEPTH


class BestViews(NamedTuple):
    """The cameras that see each of K points farthest from their rims, best first, all (B, V, K)."""

    camera: Tensor  # int64
    margin: Tensor  # to the nearest rim, 1 in the middle of the image; not above 0 = not seen
    column: Tensor  # pixels
    row: Tensor
    depth: Tensor  # metres


def project(points: Tensor, ego_to_image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels u, v and depth (B, N, K) of ego points (3, K) m in cameras (B, N, 3, 4)."""
    e = ego_to_image[..., None].float()
    x, y, z = points
    u, v, depth = (e[:, :, k, 0] * x + e[:, :, k, 1] * y + e[:, :, k, 2] * z + e[:, :, k, 3]
                   for k in range(3))  # fmt: skip
    inverse = 1.0 / depth.clamp(min=0.1)
    return u * inverse, v * inverse, depth


def best_views(
    points: Tensor, ego_to_image: Tensor, size: tuple[int, int], count: int
) -> BestViews:
    """The ``count`` ≤ N best cameras (B, N, 3, 4) for ego points (3, K) m; ``size`` of their images
    (height, width)."""
    u, v, depth = project(points, ego_to_image)
    margin = 1.0 - torch.maximum(
        ((u + 0.5) * (2.0 / size[1]) - 1.0).abs(), ((v + 0.5) * (2.0 / size[0]) - 1.0).abs()
    )
    margin = torch.where(depth > MIN_DEPTH, margin, torch.full_like(margin, -1.0))
    best, camera = margin.topk(count, dim=1)
    return BestViews(camera, best, *(t.gather(1, camera) for t in (u, v, depth)))


def at(pixel: Tensor, stride: int, cells: int) -> Tensor:
    """Pixels → -1 … 1 of a feature map of so many cells, whose cell i lies at pixel stride · i."""
    return (pixel / stride + 0.5) * (2.0 / cells) - 1.0


def read_maps(features: Tensor, camera: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """(B, N, C, h, w) float32 at places (B, S, K), -1 … 1 of the map of a camera → (B, C, S, K).

    All maps of a frame stand one over the other, so that one sampling serves them all; rows are
    kept half a cell from the rims, so that no neighbour in the stack is read.
    """
    batch, cameras, channels, h, w = features.shape
    stack = features.transpose(1, 2).reshape(batch, channels, cameras * h, w)
    row = row.clamp(-1.0 + 1.0 / h, 1.0 - 1.0 / h)
    row = (camera.float() + (row + 1.0) * 0.5) * (2.0 / cameras) - 1.0
    where = torch.stack([column.clamp(-1.0, 1.0), row], dim=-1)
    return F.grid_sample(stack, where, mode="bilinear", padding_mode="border", align_corners=False)


def camera_features(
    extract: Callable[[Tensor], Tensor], images: Tensor, ego_to_image: Tensor, training: bool
) -> Tensor:
    """``extract`` takes uint8 (M, H, W, 3) to (M, C, h, w); here of images (B, N, H, W, 3).

    Returns (B, N, C, h, w). In training absent cameras do not reach the statistics of the batch.
    """
    if training:
        present = ego_to_image.abs().amax(dim=(2, 3)) > 0
        if not bool(present.all()):
            some = extract(images[present])
            features = some.new_zeros(*present.shape, *some.shape[1:])
            features[present] = some
            return features
    features = extract(images.flatten(0, 1))
    return features.reshape(*images.shape[:2], *features.shape[1:])


def levelled(ego_to_image: Tensor, slopes: Tensor) -> Tensor:
    """Projections (B, N, 3, 4) in which the road z = a x + b y, ``slopes`` (B, 2), is z = 0.

    As `rtmap_cli.geometry.cameras.levelled`: with e_k the columns, a point of the road is seen at
    e_0 x + e_1 y + e_2 (a x + b y) + e_3.
    """
    e = ego_to_image.float()
    a, b = (slopes[:, None, None, k].float() for k in (0, 1))
    up = e[..., 2]
    return torch.stack([e[..., 0] + a * up, e[..., 1] + b * up, up, e[..., 3]], dim=-1)
