"""Hybrid queries: elements proposed from the picture, then the prior's elements in their slots."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.bev import cell_centres
from rtmap_models.config import TinyConfig
from rtmap_models.tiny.backbone import conv_block

OFFSET_SCALE = 8.0
"""Metres per unit of the proposal head, so that its weights stay near one."""


class Queries(NamedTuple):
    """What a decoder refines: ``features`` (B, Q, D), ``points`` (B, Q, V, 2) ego metres and
    ``class_id`` (B, Q), what each was proposed as."""

    features: Tensor
    points: Tensor
    class_id: Tensor


class DenseProposals(NamedTuple):
    """Per cell of the 1 m map: ``heat`` logits (B, C, h, w), ``points`` (B, C, h, w, V, 2) m."""

    heat: Tensor
    points: Tensor


class FieldHead(nn.Module):
    """From every cell, for every class: how far and where the nearest element is."""

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.classes = len(config.classes)
        self.stem = conv_block(config.fine_width, config.field_width)
        self.offset = nn.Conv2d(config.field_width, 2 * self.classes, 1)
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)

    def forward(self, fine: Tensor) -> Tensor:
        """Fine map (B, F, H/2, W/2) → (B, C, 2, H/2, W/2) metres, x and y."""
        offset = self.offset(self.stem(fine)).float() * 2.0
        return offset.unflatten(1, (self.classes, 2))


class ProposalHead(nn.Module):
    """Every cell proposes one element per class with its middle there; the best become queries."""

    centres: Tensor

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.count, self.vertices = config.new_queries, config.vertex_count
        self.classes = len(config.classes)
        width = config.coarse_width
        self.stem = conv_block(width, width)
        self.heat = nn.Conv2d(width, self.classes, 1)
        self.shape = nn.Conv2d(width, self.classes * self.vertices * 2, 1)
        self.embed = nn.Linear(width + self.classes, config.query_width)
        nn.init.constant_(self.heat.bias, -3.5)
        nn.init.zeros_(self.shape.weight)
        with torch.no_grad():
            self.shape.bias.copy_(_first_shapes(config).reshape(-1) / OFFSET_SCALE)
        rows, columns = (size // 4 for size in config.picture_size)
        centres = cell_centres(*config.half_range, rows, columns)
        self.register_buffer("centres", centres, persistent=False)

    def forward(self, coarse: Tensor) -> tuple[Queries, DenseProposals]:
        """Coarse map (B, width, h, w) → the best proposals as queries, and all of them.

        The queries' points are detached: proposals learn from their own loss.
        """
        batch, _, rows, columns = coarse.shape
        cells = rows * columns
        stem = self.stem(coarse)
        heat = self.heat(stem).float()
        offsets = self.shape(stem).float() * OFFSET_SCALE
        offsets = offsets.reshape(batch, self.classes, self.vertices * 2, cells)
        offsets = offsets.transpose(2, 3)  # (B, C, cells, 2 V)
        peak = heat.detach()
        # A cell beside a higher one of its class is suppressed, not forbidden.
        peak = torch.where(F.max_pool2d(peak, 3, 1, 1) > peak, peak - 8.0, peak).flatten(1)
        index = peak.topk(self.count, dim=1).indices  # (B, Q)
        class_id, cell = index // cells, index % cells
        flat = offsets.detach().reshape(batch, self.classes * cells, self.vertices * 2)
        points = flat.gather(1, index[..., None].expand(-1, -1, self.vertices * 2))
        points = points.reshape(batch, self.count, self.vertices, 2)
        points = points + self.centres.reshape(cells, 2)[cell][:, :, None]
        feature = stem.flatten(2).transpose(1, 2)
        feature = feature.gather(1, cell[..., None].expand(-1, -1, feature.shape[-1])).float()
        one_hot = F.one_hot(class_id, self.classes).float()
        queries = Queries(
            self.embed(torch.cat([feature, one_hot], dim=-1)).float(), points, class_id
        )
        dense = offsets.reshape(batch, self.classes, rows, columns, self.vertices, 2)
        return queries, DenseProposals(heat, dense + self.centres[:, :, None])


def _first_shapes(config: TinyConfig) -> Tensor:
    """(C, V, 2) metres: rings start as an ellipse, lines as 20 m along x."""
    v = config.vertex_count
    angle = torch.arange(v) / (v - 1) * 2 * math.pi
    ring = torch.stack([angle.cos() * 2, angle.sin() * 3], dim=-1)
    line = torch.stack([torch.linspace(-10, 10, v), torch.zeros(v)], dim=-1)
    return torch.stack([ring if k in config.ring_ids else line for k in range(len(config.classes))])


class PriorEncoder(nn.Module):
    """Elements of the prior map as queries; their geometry enters through the reference points."""

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.classes = len(config.classes)
        self.embed = nn.Linear(self.classes, config.query_width)

    def forward(self, points: Tensor, class_id: Tensor, mask: Tensor) -> Queries:
        """(B, P, V, 2) metres, (B, P) int64, (B, P) 1 = used → queries; unused slots are zero."""
        used = mask.float()
        one_hot = F.one_hot(class_id.clamp(0, self.classes - 1), self.classes).float()
        features = self.embed(one_hot).float() * used[..., None]
        return Queries(features, points * used[..., None, None], class_id)


def join(new: Queries, prior: Queries) -> Queries:
    """The hybrid queries: first all new ones, then the prior slots, in the order of the input."""
    return Queries(
        torch.cat([new.features, prior.features], dim=1),
        torch.cat([new.points, prior.points], dim=1),
        torch.cat([new.class_id, prior.class_id.clamp(min=0)], dim=1),
    )
