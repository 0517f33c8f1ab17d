"""From image features to the bird's-eye map, by calibration and learned attention.

Every cell looks into the images at several heights; for each height its two best cameras are
read, bilinearly, where calibration says. Attention weighs what was read, by the features and by
the geometry of the view. As BEVFormer's spatial cross-attention and GKT this needs no depth, takes
any number of cameras and any calibration, and exports with standard operators.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.bev import MIN_DEPTH, cell_centres
from rtmap_models.config import PaperConfig
from rtmap_models.tiny.decoder import BLOCKED

VIEWS = 2
"""Cameras per point: neighbours overlap, never more than two by much."""


class Samples(NamedTuple):
    """Where S = heights · views samples of each of K cells are read, all (B, S, K)."""

    camera: Tensor  # int64; the last one is a camera that sees nothing
    column: Tensor  # of the feature map, -1 … 1
    row: Tensor
    seen: Tensor  # 1 = the camera sees the point
    geometry: Tensor  # (B, S, K, 3): margin to the rim, distance, height


def project(points: Tensor, ego_to_image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels u, v and depth (B, N, K) of ego points (3, K) m in cameras (B, N, 3, 4)."""
    e = ego_to_image[..., None].float()
    x, y, z = points
    u, v, depth = (e[:, :, k, 0] * x + e[:, :, k, 1] * y + e[:, :, k, 2] * z + e[:, :, k, 3]
                   for k in range(3))  # fmt: skip
    inverse = 1.0 / depth.clamp(min=0.1)
    return u * inverse, v * inverse, depth


def at(pixel: Tensor, stride: int, cells: int) -> Tensor:
    """Pixels → -1 … 1 of a feature map of so many cells, whose cell i lies at pixel stride · i."""
    return (pixel / stride + 0.5) * (2.0 / cells) - 1.0


class CameraLift(nn.Module):
    """Image features of N calibrated cameras → the bird's-eye map."""

    points: Tensor

    def __init__(self, config: PaperConfig):
        super().__init__()
        rows, columns = config.bev_size
        self.rows, self.columns, self.heads = rows, columns, config.heads
        self.height, self.width = config.image_size
        self.stride = config.image_stride
        centres = cell_centres(*config.half_range, rows, columns).reshape(-1, 2).t()
        layers = [torch.cat([centres, torch.full_like(centres[:1], z)]) for z in config.heights_m]
        self.register_buffer("points", torch.cat(layers, dim=1).contiguous(), persistent=False)
        self.value = nn.Conv2d(config.image_width, config.width, 1)
        self.key = nn.Conv2d(config.image_width, config.heads, 1)
        self.geometry = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, config.heads))
        self.out = nn.Linear(config.width, config.width)
        self.row = nn.Parameter(torch.randn(config.width, rows, 1) * 0.1)
        self.column = nn.Parameter(torch.randn(config.width, 1, columns) * 0.1)

    def forward(self, features: Tensor, ego_to_image: Tensor) -> Tensor:
        """``features`` (B, N, C, H / stride, W / stride), ``ego_to_image`` (B, N, 3, 4).

        Returns (B, width, rows, columns); absent cameras (all zeros) change nothing. Projection
        and sampling are float32 throughout: coordinates do not survive bfloat16.
        """
        batch, cameras, _, h, w = features.shape
        flat = features.flatten(0, 1)
        both = torch.cat([self.value(flat), self.key(flat)], dim=1).float()
        both = both.reshape(batch, cameras, -1, h, w)
        # A last camera that sees nothing: there are always two to choose from.
        both = torch.cat([both, torch.zeros_like(both[:, :1])], dim=1)
        e = torch.cat([ego_to_image.float(), torch.zeros_like(ego_to_image[:, :1]).float()], dim=1)
        samples = self._choose(e, h, w)
        read = self._read(both, samples)  # (B, width + heads, S, K)
        value, key = read[:, : -self.heads], read[:, -self.heads :]
        bias = self.geometry(samples.geometry).float().permute(0, 3, 1, 2)
        seen = samples.seen[:, None]
        weight = (key + bias + (seen - 1.0) * -BLOCKED).softmax(dim=2) * seen
        value = value.reshape(batch, self.heads, -1, *value.shape[2:])
        mixed = (value * weight[:, :, None]).sum(dim=3).flatten(1, 2)  # (B, width, K)
        bev = self.out(mixed.transpose(1, 2)).transpose(1, 2)
        bev = bev.reshape(batch, -1, self.rows, self.columns)
        return bev + self.row + self.column

    def _choose(self, e: Tensor, h: int, w: int) -> Samples:
        """The two cameras that see each point farthest from their rims."""
        u, v, depth = project(self.points, e)
        margin = 1.0 - torch.maximum(
            ((u + 0.5) * (2.0 / self.width) - 1.0).abs(),
            ((v + 0.5) * (2.0 / self.height) - 1.0).abs(),
        )
        margin = torch.where(depth > MIN_DEPTH, margin, torch.full_like(margin, -1.0))
        best, camera = margin.topk(VIEWS, dim=1)  # (B, 2, heights · K)
        column, row, distance = (t.gather(1, camera) for t in (u, v, depth))
        height = self.points[2].expand_as(distance)
        near = distance.clamp(0.0, 60.0) / 20.0
        geometry = torch.stack([best.clamp(min=0.0), near, height], dim=-1)
        cells = self.rows * self.columns
        batch = e.shape[0]
        return Samples(
            camera.reshape(batch, -1, cells),
            at(column, self.stride, w).clamp(-1.0, 1.0).reshape(batch, -1, cells),
            at(row, self.stride, h).clamp(-1.0 + 1.0 / h, 1.0 - 1.0 / h).reshape(batch, -1, cells),
            (best > 0).float().reshape(batch, -1, cells),
            geometry.reshape(batch, -1, cells, 3),
        )

    def _read(self, features: Tensor, samples: Samples) -> Tensor:
        """(B, N, C, h, w) float32 at S · K places → (B, C, S, K).

        All images of a frame stand one over the other, so that one sampling serves them all; rows
        stay half a cell from the rims, so that no neighbour in the stack is read.
        """
        batch, cameras, channels, h, w = features.shape
        atlas = features.transpose(1, 2).reshape(batch, channels, cameras * h, w)
        row = (samples.camera.float() + (samples.row + 1.0) * 0.5) * (2.0 / cameras) - 1.0
        where = torch.stack([samples.column, row], dim=-1)
        return F.grid_sample(
            atlas, where, mode="bilinear", padding_mode="border", align_corners=False
        )
