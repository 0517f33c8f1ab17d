"""From the cameras to a bird's-eye picture of the road, inside the graph.

The ground is the plane z = 0 of the frame that ``ego_to_image`` projects from. Each block of
cells takes its colour from the camera that sees it nearest to the middle of its image; the fourth
channel is √(camera height / distance), which falls with the quality of the view, and 0 where
nothing is seen.
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


BLOCK = 2
"""Cells side by side that share a camera and a quality, per axis."""


class BevWarp(nn.Module):
    """Images of N calibrated cameras → one picture (4 channels, values 0 … 255).

    The camera is chosen per block of `BLOCK`² cells; ``supersample``² points of each cell are read
    and averaged.
    """

    centres: Tensor
    ground: Tensor

    def __init__(self, half_x: float, half_y: float, rows: int, columns: int, supersample: int):
        super().__init__()
        self.rows, self.columns, self.supersample = rows, columns, supersample
        self.blocks = -(-rows // BLOCK), -(-columns // BLOCK)
        count_y, count_x = self.blocks
        # The last blocks may reach beyond the picture; they are cut off in the end.
        y, x = (2 * half_y / rows) * BLOCK, (2 * half_x / columns) * BLOCK
        grid = torch.meshgrid(
            (torch.arange(count_y) + 0.5) * y - half_y,
            (torch.arange(count_x) + 0.5) * x - half_x,
            indexing="ij",
        )
        centres = torch.stack(grid[::-1]).reshape(2, -1)
        self.register_buffer("centres", centres, persistent=False)
        # (x and y, cells of a block · points of a cell, blocks), so that blocks lie side by side.
        inside = (torch.arange(BLOCK * supersample) + 0.5) / (BLOCK * supersample) - 0.5
        shape = (BLOCK, supersample, BLOCK, supersample)
        dy = (inside * y)[:, None].expand(-1, len(inside)).reshape(shape).transpose(1, 2)
        dx = (inside * x)[None].expand(len(inside), -1).reshape(shape).transpose(1, 2)
        offsets = torch.stack([dx.reshape(-1), dy.reshape(-1)])
        ground = centres[:, None] + offsets[:, :, None]
        self.register_buffer("ground", ground.contiguous(), persistent=False)

    def forward(self, images: Tensor, ego_to_image: Tensor) -> Tensor:
        """``images`` uint8 or float (B, N, H, W, 3), ``ego_to_image`` (B, N, 3, 4).

        Returns float (B, 4, rows, columns): red, green, blue and the quality of the view,
        each in 0 … 255; everything is 0 where no camera sees the ground. Float32 throughout:
        coordinates do not survive bfloat16.
        """
        batch, cameras, height, width = images.shape[:4]
        e = ego_to_image.float()
        best, seen = self._choose(e, height, width)  # (B, blocks)
        gx, gy = self._look_up(e, best, height, width)  # (B, points per block, blocks)
        # All images of a sample stand one over the other, so that one sampling serves them all.
        gy = (best.float()[:, None] + (gy + 1.0) * 0.5) * 2.0 / cameras - 1.0
        atlas = images.float().permute(0, 4, 1, 2, 3).reshape(batch, 3, cameras * height, width)
        colour = F.grid_sample(
            atlas,
            torch.stack([gx, gy], dim=-1),
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
        )
        count = self.supersample**2
        colour = colour.reshape(batch, 3, BLOCK**2, count, -1).mean(dim=3)
        quality = (self._quality(e, best) * 255.0)[:, None, None].expand(-1, 1, BLOCK**2, -1)
        picture = torch.cat([colour, quality], dim=1) * seen[:, None, None]
        rows, columns = self.blocks
        picture = picture.reshape(batch, 4, BLOCK, BLOCK, rows, columns)
        picture = picture.permute(0, 1, 4, 2, 5, 3)
        picture = picture.reshape(batch, 4, BLOCK * rows, BLOCK * columns)
        return picture[:, :, : self.rows, : self.columns]

    def _choose(self, e: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """(B, blocks) the camera that sees each block best, and 1 where one sees it at all."""
        x, y = self.centres
        u, v, depth = (
            e[:, :, k, 0:1] * x + e[:, :, k, 1:2] * y + e[:, :, k, 3:4] for k in range(3)
        )
        inverse = 1.0 / depth.clamp(min=0.1)
        gx = ((u * inverse + 0.5) * (2.0 / width) - 1.0).abs()
        gy = ((v * inverse + 0.5) * (2.0 / height) - 1.0).abs()
        inside = 1.0 - torch.maximum(gx, gy)
        inside = torch.where(depth > MIN_DEPTH, inside, torch.full_like(inside, -1.0))
        margin, best = inside.max(dim=1)
        return best, (margin > 0).float()

    def _look_up(self, e: Tensor, best: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """(B, points per block, blocks) places in the image of the chosen camera, -1 … 1."""
        x, y = self.ground
        rows = []
        for k in range(3):
            a, b, d = (e[:, :, k, j].gather(1, best)[:, None] for j in (0, 1, 3))
            rows.append(a * x + b * y + d)
        inverse = 1.0 / rows[2].clamp(min=0.1)
        # Half a pixel from the rim, so that no neighbour in the stack of images is read.
        limit = 1.0 - 1.0 / height
        gx = (rows[0] * inverse + 0.5) * (2.0 / width) - 1.0
        gy = (rows[1] * inverse + 0.5) * (2.0 / height) - 1.0
        return gx.clamp(-1.0, 1.0), gy.clamp(-limit, limit)

    def _quality(self, e: Tensor, best: Tensor) -> Tensor:
        """(B, blocks): √(height / distance) of the camera chosen for each block."""
        centre = camera_centres(e)  # (B, N, 3)
        x, y, height = (centre[..., k].gather(1, best) for k in range(3))
        height = height.clamp(min=0.0)
        dx, dy = x - self.centres[0], y - self.centres[1]
        distance = (dx * dx + dy * dy + height * height).sqrt().clamp(min=1e-3)
        return (height / distance).clamp(0.0, 1.0).sqrt()


def normalize_picture(picture: Tensor) -> Tensor:
    """(B, 4, rows, columns) in 0 … 255 → network input: colours centred, zero where unseen."""
    seen = (picture[:, 3:] > 12.0).to(picture.dtype)
    return torch.cat([(picture[:, :3] - 110.0) / 60.0 * seen, picture[:, 3:] / 128.0], dim=1)
