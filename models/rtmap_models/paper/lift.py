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

from rtmap_models.bev import cell_centres
from rtmap_models.cameras import at, best_views, read_maps
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
        batch, _, _, h, w = features.shape
        e = torch.cat([ego_to_image.float(), torch.zeros_like(ego_to_image[:, :1]).float()], dim=1)
        samples = self._choose(e, h, w)
        where = samples.camera, samples.column, samples.row
        flat = features.flatten(0, 1)
        # Read apart, so that training need not copy what was read, by far its largest tensor.
        value, key = (
            read_maps(_with_blind_camera(made(flat), batch), *where)  # (B, …, S, K)
            for made in (self.value, self.key)
        )
        bias = self.geometry(samples.geometry).float().permute(0, 3, 1, 2)
        seen = samples.seen[:, None]
        weight = (key + bias + (seen - 1.0) * -BLOCKED).softmax(dim=2) * seen
        value = value.reshape(batch, self.heads, -1, *value.shape[2:])
        mixed = (value * weight[:, :, None]).sum(dim=3).flatten(1, 2)  # (B, width, K)
        bev = self.out(mixed.transpose(1, 2)).transpose(1, 2)
        bev = bev.reshape(batch, -1, self.rows, self.columns)
        return bev + (self.row + self.column)

    def _choose(self, e: Tensor, h: int, w: int) -> Samples:
        """The two cameras that see each point farthest from their rims."""
        best = best_views(self.points, e, (self.height, self.width), VIEWS)
        height = self.points[2].expand_as(best.depth)
        near = best.depth.clamp(0.0, 60.0) / 20.0
        geometry = torch.stack([best.margin.clamp(min=0.0), near, height], dim=-1)
        cells = self.rows * self.columns
        batch = e.shape[0]
        return Samples(
            best.camera.reshape(batch, -1, cells),
            at(best.column, self.stride, w).reshape(batch, -1, cells),
            at(best.row, self.stride, h).reshape(batch, -1, cells),
            (best.margin > 0).float().reshape(batch, -1, cells),
            geometry.reshape(batch, -1, cells, 3),
        )


def _with_blind_camera(maps: Tensor, batch: int) -> Tensor:
    """(B · N, C, h, w) → (B, N + 1, C, h, w) float32: the last camera sees nothing, so that there
    are always two to choose from."""
    maps = maps.float().reshape(batch, -1, *maps.shape[1:])
    return torch.cat([maps, torch.zeros_like(maps[:, :1])], dim=1)
