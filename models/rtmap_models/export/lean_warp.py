"""The warp to the bird's-eye picture in few, large operations, as runtimes of ONNX like it.

The same points, cameras and bilinear values as `BevWarp.forward`. The pixels are gathered as bytes
straight from the images as they come in: ``GridSample`` would want all of them as planes of floats
first, and onnxruntime works out its places on one thread.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.bev import BLOCK, MIN_DEPTH, BevWarp

HAIR = 1.0 - 2.0**-23
"""Places stop one step of float32 before the last pixel: there is always a pixel behind them."""

AT_ONCE = 2
"""Cells of a block whose points are read at the same time: these numbers stay in the caches."""


def warp(self: BevWarp, images: Tensor, ego_to_image: Tensor) -> Tensor:
    """``images`` uint8 (B, N, H, W, 3), ``ego_to_image`` (B, N, 3, 4) → (B, 4, rows, columns)."""
    batch, _, height, width = images.shape[:4]
    e = ego_to_image.float()
    plane = e[..., [3, 0, 1]]  # (B, N, 3, 3): what multiplies 1, x, y
    centres = torch.cat([torch.ones_like(self.centres[:1]), self.centres])
    best, seen = _choose(plane, centres, height, width)  # (B, blocks)
    chosen = [_chosen(plane[:, :, k], centres, best) for k in range(3)]
    flat, first = images.flatten(1), (best.int() * (height * width * 3))[:, None]
    offsets = (self.ground[:, :, 0] - self.centres[:, :1]).t()
    terms = torch.cat([torch.ones_like(offsets[:, :1]), offsets], dim=1)
    count = self.supersample**2
    samples = []
    # One point of so many cells of every block at a time.
    for some in terms.reshape(-1, AT_ONCE, count, 3).transpose(1, 2).flatten(0, 1):
        u, v, depth = (some @ row for row in chosen)  # (B, AT_ONCE, blocks)
        depth = depth.clamp(min=0.1)
        x = (u / depth).clamp(0.0, (width - 1) * HAIR)
        y = (v / depth).clamp(0.0, (height - 1) * HAIR)
        samples.append(_read(flat, first, x, y, width))
    cells = [sum(samples[k + 1 : k + count], samples[k]) for k in range(0, len(samples), count)]
    colour = torch.cat([c.reshape(batch, 3, AT_ONCE, -1) for c in cells], dim=2)
    quality = (self._quality(e, best) * 255.0 * seen)[:, None, None]
    quality = quality.expand(-1, 1, BLOCK**2, -1)
    picture = torch.cat([colour * (seen / count)[:, None, None], quality], dim=1)
    count_y, count_x = self.blocks
    picture = F.pixel_shuffle(picture.reshape(batch, 4 * BLOCK**2, count_y, count_x), BLOCK)
    if (self.rows, self.columns) != (count_y * BLOCK, count_x * BLOCK):
        picture = picture[:, :, : self.rows, : self.columns]
    return picture


def _choose(plane: Tensor, centres: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """(B, blocks) the camera that sees each block best, and 1 where one sees it at all."""
    # From the middle of the image, in sizes of the image: u / depth / W + 0.5 / W - 0.5, alike v.
    middle = torch.tensor(
        [[1.0 / width, 0.0, 0.5 / width - 0.5], [0.0, 1.0 / height, 0.5 / height - 0.5]]
    )
    across, down = ((row @ plane) @ centres for row in middle)  # (B, N, blocks)
    depth = plane[:, :, 2] @ centres
    inside = 0.5 - torch.maximum(across.abs(), down.abs()) / depth.clamp(min=0.1)
    inside = torch.minimum(inside, (depth - MIN_DEPTH) * 1e9)  # not above 0 up to `MIN_DEPTH`
    margin, best = inside.max(dim=1)
    return best, (margin > 0).float()


def _chosen(row: Tensor, centres: Tensor, best: Tensor) -> Tensor:
    """One row (B, N, 3) of the projections of 1, x, y → of the camera chosen for each block: its
    value at the centre and its slopes along x and y (B, 3, blocks)."""
    row = row.transpose(1, 2).gather(2, best[:, None].expand(-1, 3, -1))
    return torch.cat([(row * centres).sum(dim=1, keepdim=True), row[:, 1:]], dim=1)


def _read(flat: Tensor, first: Tensor, x: Tensor, y: Tensor, width: int) -> Tensor:
    """Images as bytes (B, L), read bilinearly at pixels x, y (B, n, K) of the image that begins at
    ``first`` (B, 1, K) → (B, 3 · n · K)."""
    column, row = x.int(), y.int()
    at = (((row * width + column) * 3) + first).flatten(1)
    at = torch.cat([at, at + 1, at + 2], dim=1)  # red, green, blue of the pixel above, left
    across, down = ((a - b.float()).flatten(1) for a, b in ((x, column), (y, row)))
    across, down = torch.cat([across] * 3, dim=1), torch.cat([down] * 3, dim=1)

    def corner(offset: int) -> Tensor:
        return flat.gather(1, (at + offset).long()).float()

    left, line = corner(0), 3 * width
    top = left + (corner(3) - left) * across
    left = corner(line)
    bottom = left + (corner(line + 3) - left) * across
    return top + (bottom - top) * down
