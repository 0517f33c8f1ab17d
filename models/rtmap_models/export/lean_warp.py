"""The warp to the bird's-eye picture in few, large operations, as runtimes of ONNX like it.

The same points, cameras and bilinear values as `BevWarp.forward`: projections are matrix products
instead of sums of products, and the sampling pads with zeros, after its places were drawn half a
pixel in from every rim, because that is what onnxruntime's fast path of GridSample wants.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.bev import BLOCK, MIN_DEPTH, BevWarp


def warp(self: BevWarp, images: Tensor, ego_to_image: Tensor) -> Tensor:
    """``images`` uint8 (B, N, H, W, 3), ``ego_to_image`` (B, N, 3, 4) → (B, 4, rows, columns)."""
    batch, cameras, height, width = images.shape[:4]
    e = ego_to_image.float()
    plane = e[..., [3, 0, 1]]  # (B, N, 3, 3): what multiplies 1, x, y
    centres = torch.cat([torch.ones_like(self.centres[:1]), self.centres])
    # Straight to 0 … 1 across the image: u / depth / W + 0.5 / W, alike v.
    scale = torch.tensor([[1.0 / width], [1.0 / height], [1.0]])
    rows = (plane * scale).reshape(batch, cameras * 3, 3) @ centres
    rows = rows.reshape(batch, cameras, 3, -1)  # u, v, depth of every block in every camera
    half_pixel = torch.tensor([[0.5 / width], [0.5 / height]])
    place = rows[:, :, :2] / rows[:, :, 2:].clamp(min=0.1) + half_pixel
    inside = 0.5 - (place - 0.5).abs().amax(dim=2)
    inside = torch.where(rows[:, :, 2] > MIN_DEPTH, inside, -1.0)
    margin, best = inside.max(dim=1)  # (B, blocks)
    seen = (margin > 0).float()

    offsets = (self.ground[:, :, 0] - self.centres[:, :1]).t()  # (points per block, 2)
    terms = torch.cat([torch.ones_like(offsets[:, :1]), offsets], dim=1)
    at_centre = rows.gather(1, best[:, None, None].expand(-1, 1, 3, -1))[:, 0]  # (B, 3, blocks)
    turn = (plane[..., 1:] * scale).permute(0, 2, 3, 1)  # (B, 3, 2, N)
    slope = turn.gather(3, best[:, None, None].expand(-1, 3, 2, -1))  # (B, 3, 2, blocks)
    points = terms @ torch.cat([at_centre[:, :, None], slope], dim=2)  # (B, 3, points, blocks)
    place = points[:, :2] / points[:, 2:].clamp(min=0.1) + half_pixel[:, None]
    rim = torch.tensor([0.5 / width, 0.5 / height])[:, None, None]
    across, down = torch.minimum(torch.maximum(place, rim), 1.0 - rim).unbind(1)
    down = (best.float()[:, None] + down) / (cameras * 0.5)
    atlas = images.permute(0, 4, 1, 2, 3).reshape(batch, 3, cameras * height, width).float()
    grid = torch.stack([across * 2.0, down], dim=-1) - 1.0
    # One call per point of a block: what onnxruntime works out for a call then fits the caches.
    samples = [
        F.grid_sample(atlas, at, padding_mode="zeros", align_corners=False)
        for at in grid.split(1, dim=1)
    ]
    count = self.supersample**2
    cells = [
        sum(samples[k * count + 1 : (k + 1) * count], samples[k * count]) for k in range(BLOCK**2)
    ]
    colour = torch.cat(cells, dim=2) / count
    quality = (self._quality(e, best) * 255.0)[:, None, None].expand(-1, 1, BLOCK**2, -1)
    picture = torch.cat([colour, quality], dim=1) * seen[:, None, None]
    count_y, count_x = self.blocks
    picture = picture.reshape(batch, 4 * BLOCK**2, count_y, count_x)
    return F.pixel_shuffle(picture, BLOCK)[:, :, : self.rows, : self.columns]
