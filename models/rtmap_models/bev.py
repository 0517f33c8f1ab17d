"""From the cameras to a bird's-eye picture of the road, inside the graph.

The ground is the plane z = 0 of the frame that ``ego_to_image`` projects from. Each cell takes its
colour from the camera that sees it nearest to the middle of its image; the fourth channel is
√(camera height / distance), which falls with the quality of the view, and 0 where nothing is seen.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

MIN_DEPTH = 0.3
"""Metres in front of the camera under which nothing is taken."""


def cell_centres(half_x: float, half_y: float, rows: int, columns: int) -> Tensor:
    """(rows, columns, 2) ego coordinates of cell centres; rows go with +y, columns with +x."""
    y = ((torch.arange(rows) + 0.5) / rows * 2 - 1) * half_y
    x = ((torch.arange(columns) + 0.5) / columns * 2 - 1) * half_x
    return torch.stack([x[None].expand(rows, -1), y[:, None].expand(-1, columns)], dim=-1)


def camera_centres(ego_to_image: Tensor) -> Tensor:
    """(..., 3) camera centres in the frame that (..., 3, 4) projects from.

    Solves ``M c = -p`` for ``ego_to_image = [M | p]`` by cross products; an absent camera (all
    zeros) gives the origin.
    """
    r0, r1, r2 = (ego_to_image[..., k, :3] for k in range(3))
    p = ego_to_image[..., 3]
    c12, c20, c01 = _cross(r1, r2), _cross(r2, r0), _cross(r0, r1)
    det = (r0 * c12).sum(-1, keepdim=True)
    numerator = c12 * p[..., 0:1] + c20 * p[..., 1:2] + c01 * p[..., 2:3]
    return -numerator / torch.where(det.abs() < 1e-9, torch.ones_like(det), det)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    ax, ay, az = a.unbind(-1)
    bx, by, bz = b.unbind(-1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=-1)


class BevWarp(nn.Module):
    """Images of N calibrated cameras → one picture (4 channels, values 0 … 255)."""

    ground: Tensor

    def __init__(self, half_x: float, half_y: float, rows: int, columns: int, supersample: int):
        super().__init__()
        self.rows, self.columns, self.supersample = rows, columns, supersample
        fine = cell_centres(half_x, half_y, rows * supersample, columns * supersample)
        flat = fine.reshape(-1, 2)
        ones = torch.ones(len(flat), 1)
        ground = torch.cat([flat, torch.zeros_like(ones), ones], dim=1)
        self.register_buffer("ground", ground, persistent=False)

    def forward(self, images: Tensor, ego_to_image: Tensor) -> Tensor:
        """``images`` uint8 or float (B, N, H, W, 3), ``ego_to_image`` (B, N, 3, 4).

        Returns float (B, 4, rows, columns): red, green, blue and the quality of the view,
        each in 0 … 255; everything is 0 where no camera sees the ground. Float32 throughout:
        coordinates do not survive bfloat16.
        """
        batch, cameras, height, width = images.shape[:4]
        u, v, depth = (ego_to_image.float() @ self.ground.t()).unbind(2)  # each (B, N, cells)
        safe = depth.clamp(min=0.1)
        gx = (u / safe + 0.5) * (2.0 / width) - 1.0
        gy = (v / safe + 0.5) * (2.0 / height) - 1.0
        inside = 1.0 - torch.maximum(gx.abs(), gy.abs())
        inside = torch.where(depth > MIN_DEPTH, inside, torch.full_like(inside, -1.0))
        margin, best = inside.max(dim=1, keepdim=True)
        seen = (margin > 0).float()  # (B, 1, cells)
        gx, gy = gx.gather(1, best)[:, 0], gy.gather(1, best)[:, 0]
        # All images of a sample stand one over the other, so that one sampling serves them all.
        limit = 1.0 - 1.0 / height
        gy = (best[:, 0].float() + (gy.clamp(-limit, limit) + 1.0) * 0.5) * 2.0 / cameras - 1.0
        atlas = images.float().permute(0, 4, 1, 2, 3).reshape(batch, 3, cameras * height, width)
        rows, columns = self.rows * self.supersample, self.columns * self.supersample
        where = torch.stack([gx.clamp(-1, 1), gy], dim=-1).reshape(batch, rows, columns, 2)
        colour = F.grid_sample(
            atlas, where, mode="bilinear", padding_mode="border", align_corners=False
        )
        seen = seen.reshape(batch, 1, rows, columns)
        quality = self._quality(ego_to_image.float(), best).reshape(batch, 1, rows, columns)
        picture = torch.cat([colour, quality * 255.0], dim=1) * seen
        return F.avg_pool2d(picture, self.supersample) if self.supersample > 1 else picture

    def _quality(self, ego_to_image: Tensor, best: Tensor) -> Tensor:
        """(B, 1, cells): √(height / distance) of the camera chosen for each cell."""
        centre = camera_centres(ego_to_image)  # (B, N, 3)
        chosen = [centre[..., k].gather(1, best[:, 0]) for k in range(3)]
        dx, dy = chosen[0] - self.ground[:, 0], chosen[1] - self.ground[:, 1]
        height = chosen[2].clamp(min=0.0)
        distance = (dx * dx + dy * dy + height * height).sqrt().clamp(min=1e-3)
        return (height / distance).clamp(0.0, 1.0).sqrt()[:, None]


def normalize_picture(picture: Tensor) -> Tensor:
    """(B, 4, rows, columns) in 0 … 255 → network input: colours centred, zero where unseen."""
    seen = (picture[:, 3:] > 12.0).to(picture.dtype)
    return torch.cat([(picture[:, :3] - 110.0) / 60.0 * seen, picture[:, 3:] / 128.0], dim=1)
