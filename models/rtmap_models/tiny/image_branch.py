"""The image-feature branch of the default network: what a bird's-eye picture cannot show.

A picture warped over the plane of the road smears whatever stands up, and is wrong by metres where
the cameras pitch or roll against the road by a quarter of a degree. The branch runs a small
convolutional network over every camera image; its features say how the cameras lean (`TiltHead`),
before the picture is warped, and are read at several heights above every 1 m cell (`CellLift`) and
added to the coarse map. Both start at zero: a network given the weights of one without the branch
starts at exactly its answers.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from rtmap_models.bev import cell_centres
from rtmap_models.cameras import at, best_views, camera_features, levelled, read_maps
from rtmap_models.config import TinyConfig
from rtmap_models.tiny.backbone import Residual, conv_block

STRIDE = 8
"""Pixels per cell of the image features."""

RIDGE = 0.1
"""Weight of "the cameras do not lean" against the votes of all cells (about 1 per camera)."""

VOTE_CELLS = 8.0
"""Cells that a vote of 1 means: from zero, small weights must soon reach the size of a tilt."""

NEAR_CELLS = 2.0
"""Cells this far from the calibrated horizon and further look alike to the tilt head."""


class Looked(NamedTuple):
    """What the branch hands on: ``ego_to_image`` (B, N, 3, 4) corrected; ``coarse`` (B,
    coarse_width, H/4, W/4) to be added to the coarse map, where it has any."""

    ego_to_image: Tensor
    coarse: Tensor | None


class Tilts(NamedTuple):
    """Guesses of the tilt head for its loss: ``slopes`` (T, B, 2) of the road in the frames of T
    sets of cameras, the batch's own first, and ``true`` (T, B, 2), NaN where unknown."""

    slopes: Tensor
    true: Tensor


class TiltHead(nn.Module):
    """How the road lies in the frame that the cameras project from: slopes along x and y.

    Every cell of the image features votes for how much higher the horizon lies in its direction
    than calibration says, with a weight. A plane z = a x + b y has its horizon at the elevation
    a cos φ + b sin φ in the direction φ, so that all votes of all cameras together give a and b by
    weighted least squares, in the ego frame. Votes start at zero.
    """

    def __init__(self, width: int):
        super().__init__()
        self.look = nn.Conv2d(width, width, 1)
        self.place = nn.Conv2d(2, width, 1, bias=False)
        self.vote = nn.Conv2d(width, 2, 1)
        nn.init.zeros_(self.vote.weight[:1])
        nn.init.zeros_(self.vote.bias)

    def forward(self, features: Tensor, ego_to_image: Tensor) -> Tensor:
        """``features`` (B, N, C, h, w), ``ego_to_image`` (B, N, 3, 4) → slopes (B, 2), radians or
        so (rise per run)."""
        batch, cameras, _, h, w = features.shape
        rays, per_cell = rays_of(ego_to_image, h, w)
        flat = rays[..., :2].square().sum(-1).sqrt().clamp(min=1e-6)
        # Elevation over the calibrated horizon, in cells: where the horizon should be it is zero.
        above = (rays[..., 2] / flat / per_cell).clamp(-NEAR_CELLS, NEAR_CELLS)
        place = torch.stack([above, torch.exp(-above.square())], dim=2).flatten(0, 1)
        seen = (self.look(features.flatten(0, 1)) + self.place(place)).relu()
        out = self.vote(seen).float().reshape(batch, cameras, 2, h, w)
        present = ego_to_image.float().abs().amax(dim=(2, 3)) > 0
        weight = out[:, :, 1].sigmoid() * present[..., None, None].float() * (2.0 / (h * w))
        vote = out[:, :, 0] * VOTE_CELLS * per_cell
        return _plane(rays[..., :2] / flat[..., None], vote, weight)


def rays_of(ego_to_image: Tensor, h: int, w: int) -> tuple[Tensor, Tensor]:
    """Directions (B, N, h, w, 3) in the ego frame that the cells of a feature map look along, in
    any length, and by how much the elevation changes per cell (B, N, 1, 1).

    Solves M d = (u, v, 1) for ``ego_to_image = [M | p]`` by cross products.
    """
    rows = ego_to_image.float()[..., :3].unbind(-2)
    pairs = ((1, 2), (2, 0), (0, 1))
    crossed = torch.stack([torch.linalg.cross(rows[i], rows[j]) for i, j in pairs], dim=-2)
    det = (rows[0] * crossed[..., 0, :]).sum(-1)[..., None, None]
    inverse = crossed / torch.where(det.abs() < 1e-9, torch.ones_like(det), det)
    across, down, centre = (inverse[:, :, k, None, None] for k in range(3))
    u = torch.arange(w, device=det.device, dtype=det.dtype)[:, None] * STRIDE
    v = torch.arange(h, device=det.device, dtype=det.dtype)[:, None, None] * STRIDE
    # A ray of depth 1 moves by this much from one row of pixels to the next.
    step = down.square().sum(-1).sqrt() * STRIDE
    return u * across + v * down + centre, step.clamp(min=1e-6)


def _plane(direction: Tensor, vote: Tensor, weight: Tensor) -> Tensor:
    """(B, 2) slopes a, b that minimise Σ w (vote - a x - b y)² + ridge (a² + b²); directions
    (B, N, h, w, 2), votes and weights (B, N, h, w)."""
    x, y = direction[..., 0], direction[..., 1]

    def total(value: Tensor) -> Tensor:
        return (weight * value).sum(dim=(1, 2, 3))

    xx, xy, yy = total(x * x) + RIDGE, total(x * y), total(y * y) + RIDGE
    vx, vy = total(vote * x), total(vote * y)
    det = xx * yy - xy * xy
    return torch.stack([yy * vx - xy * vy, xx * vy - xy * vx], dim=-1) / det[..., None]


class CellLift(nn.Module):
    """Image features read at several heights above every 1 m cell, each from its best camera."""

    points: Tensor

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.rows, self.columns = (size // 4 for size in config.picture_size)
        self.size, width = config.image_size, config.image_width
        centres = cell_centres(*config.half_range, self.rows, self.columns).reshape(-1, 2).t()
        layers = [
            torch.cat([centres, torch.full_like(centres[:1], z)]) for z in config.image_heights_m
        ]
        self.register_buffer("points", torch.cat(layers, dim=1).contiguous(), persistent=False)
        self.mix = nn.Sequential(
            conv_block(len(layers) * (width + 1), width, 1), conv_block(width, width)
        )
        self.join = nn.Conv2d(width, config.coarse_width, 1)
        nn.init.zeros_(self.join.weight)
        nn.init.zeros_(self.join.bias)

    def forward(self, features: Tensor, ego_to_image: Tensor) -> Tensor:
        """``features`` (B, N, C, h, w), ``ego_to_image`` (B, N, 3, 4) → (B, coarse_width, rows,
        columns). Absent cameras (all zeros) change nothing."""
        h, w = features.shape[-2:]
        best = best_views(self.points, ego_to_image.float(), self.size, 1)
        column, row = at(best.column, STRIDE, w), at(best.row, STRIDE, h)
        read = read_maps(features.float(), best.camera, column, row)[:, :, 0]
        near = 5.0 / best.depth.clamp(min=5.0)
        seen = torch.cat([read, near], dim=1) * (best.margin > 0).float()
        cells = seen.reshape(seen.shape[0], -1, self.rows, self.columns)
        return self.join(self.mix(cells.contiguous(memory_format=torch.channels_last))).float()


class ImageBranch(nn.Module):
    """Features of all cameras, the tilt head and the lift, as far as the configuration has them."""

    def __init__(self, config: TinyConfig):
        super().__init__()
        width = config.image_width
        self.extract = nn.Sequential(
            conv_block(3, 16, 3, 2),
            conv_block(16, 24, 3, 2),
            Residual(24, width, 2),
            Residual(width, width),
        )
        self.tilt_sigma = config.tilt_sigma
        self.tilt = TiltHead(width) if config.tilt_sigma > 0 else None
        self.lift = CellLift(config) if config.image_heights_m else None

    def forward(self, images: Tensor, ego_to_image: Tensor) -> Looked:
        """``images`` uint8 (B, N, H, W, 3), ``ego_to_image`` (B, N, 3, 4)."""
        features = camera_features(self._features, images, ego_to_image, self.training)
        slopes = None if self.tilt is None else self.tilt(features, ego_to_image)
        return self._corrected(features, ego_to_image, slopes)

    def learn(
        self, images: Tensor, ego_to_image: Tensor, plane: Tensor
    ) -> tuple[Looked, Tilts | None]:
        """The same, and what the tilt head says, for its loss.

        ``plane`` (B, 3) is the road in the frame of ``ego_to_image``, NaN where unknown. Levelling
        leaves little to learn from: in training the head also sees the projections leaning by
        ``tilt_sigma`` more.
        """
        features = camera_features(self._features, images, ego_to_image, self.training)
        if self.tilt is None:
            return self._corrected(features, ego_to_image, None), None
        true = plane[:, :2]
        added = [torch.zeros_like(true)]
        if self.training:
            added.append(torch.randn_like(true) * self.tilt_sigma)
        slopes = torch.stack([self.tilt(features, levelled(ego_to_image, q)) for q in added])
        tilts = Tilts(slopes, torch.stack([true - q for q in added]))
        return self._corrected(features, ego_to_image, slopes[0]), tilts

    def _features(self, images: Tensor) -> Tensor:
        """uint8 (M, H, W, 3) → (M, image_width, H / 8, W / 8); cell i looks at pixel 8 · i."""
        x = (images.permute(0, 3, 1, 2).float() - 110.0) / 60.0
        out: Tensor = self.extract(x.contiguous(memory_format=torch.channels_last))
        return out

    def _corrected(self, features: Tensor, ego_to_image: Tensor, slopes: Tensor | None) -> Looked:
        """Where the cameras look is not learnt through the picture: the slopes have a loss."""
        level = ego_to_image.float()
        if slopes is not None:
            level = levelled(level, slopes.detach())
        return Looked(level, None if self.lift is None else self.lift(features, level))
