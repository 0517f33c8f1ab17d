"""The decoder: hybrid queries in; scores, points, scales and existence out, layer by layer."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.config import TinyConfig
from rtmap_models.queries import Queries

NORMAL_OFFSET_M = 0.8
"""The picture is read on the line and this far to its left and right."""

BLOCKED = -1e4
"""Attention bias of a key that must not be seen (finite, so that an empty row stays defined)."""


class LayerOutput(NamedTuple):
    """Of every query after one layer: ``points`` (B, Q, V, 2) m, ``log_scale`` (B, Q, V, 2) of
    the Laplace scale in metres, ``logits`` (B, Q, C + 1): the classes, then existence."""

    points: Tensor
    log_scale: Tensor
    logits: Tensor


def sample_map(features: Tensor, points: Tensor, half_range: Tensor) -> Tensor:
    """Bilinear values of (B, C, h, w) float32 at (B, K, 2) ego metres → (B, K, C)."""
    where = (points / half_range)[:, None]
    values = F.grid_sample(
        features, where, mode="bilinear", padding_mode="border", align_corners=False
    )
    return values[:, :, 0].transpose(1, 2)


def unit_tangents(points: Tensor) -> Tensor:
    """(..., V, 2) central differences of unit length, one-sided at the ends."""
    steps = torch.cat(
        [
            points[..., 1:2, :] - points[..., :1, :],
            points[..., 2:, :] - points[..., :-2, :],
            points[..., -1:, :] - points[..., -2:-1, :],
        ],
        dim=-2,
    )
    return steps / (steps.square().sum(-1, keepdim=True).sqrt() + 1e-3)


def attention_bias(new_count: int, prior_mask: Tensor, prior_visible: Tensor) -> Tensor:
    """(B, 1, Q, Q) additive bias: unused slots are never seen; where ``prior_visible`` (B,) is 0
    the new queries do not see the prior either (training without a prior beside refinement)."""
    batch, slots = prior_mask.shape
    used = (prior_mask.float() - 1.0) * -BLOCKED  # (B, P): 0 used, BLOCKED unused
    keys = torch.cat([used.new_zeros(batch, new_count), used], dim=1)
    hidden = ((prior_visible.float() - 1.0) * -BLOCKED)[:, None, None]
    corner = hidden.expand(batch, new_count, slots)
    top = torch.cat([used.new_zeros(batch, new_count, new_count), corner], dim=2)
    rows = torch.cat([top, used.new_zeros(batch, slots, new_count + slots)], dim=1)
    return (rows + keys[:, None]).clamp(min=BLOCKED)[:, None]


class RefineLayer(nn.Module):
    """Read the maps along each polyline, talk to the other elements, move the polyline."""

    frequencies: Tensor

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.heads, width, point = config.heads, config.query_width, config.point_width
        vertices = config.vertex_count
        self.read = nn.Linear(3 * config.fine_width + config.coarse_width, point)
        self.place = nn.Linear(4 + 32, point)
        self.ask = nn.Linear(width, point)
        self.vertex = nn.Parameter(torch.randn(vertices, point) * 0.05)
        self.along = nn.Conv1d(point, point, 5, padding=2)
        self.point_norm = nn.LayerNorm(point)
        self.gather = nn.Linear(vertices * point, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))
        self.position = nn.Sequential(
            nn.Linear(2 * vertices, width), nn.ReLU(inplace=True), nn.Linear(width, width)
        )
        self.query_key, self.value = nn.Linear(width, 2 * width), nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.feed = nn.Sequential(
            nn.Linear(width, 2 * width), nn.ReLU(inplace=True), nn.Linear(2 * width, width)
        )
        self.classify = nn.Linear(width, len(config.classes) + 1)
        self.from_point, self.from_query = nn.Linear(point, 64), nn.Linear(width, 64)
        self.head_vertex = nn.Parameter(torch.randn(vertices, 64) * 0.05)
        self.move, self.whole = nn.Linear(64, 4), nn.Linear(width, 2 * vertices)
        for head in (self.move, self.whole):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)
        nn.init.constant_(self.classify.bias, -2.0)
        half = torch.tensor(config.half_range)
        self.register_buffer("half_range", half, persistent=False)
        self.register_buffer("frequencies", 2.0 ** torch.arange(8) * math.pi / 2, persistent=False)

    def forward(
        self, queries: Queries, fine: Tensor, coarse: Tensor, bias: Tensor
    ) -> tuple[Tensor, LayerOutput]:
        """Float32 maps (B, ·, h, w) and bias (B, 1, Q, Q) → new features (B, Q, D), output."""
        q, points = queries
        batch, count, vertices, _ = points.shape
        scaled = points / self.half_range
        e = F.relu(
            self.read(self._look(points, fine, coarse))
            + self.place(self._geometry(points, scaled))
            + self.ask(q)[:, :, None]
            + self.vertex
        )
        flat = e.reshape(batch * count, vertices, -1).transpose(1, 2)
        flat = F.relu(self.along(flat)).transpose(1, 2).reshape(e.shape)
        e = self.point_norm(e + flat)
        q = self.norms[0](q + self.gather(e.flatten(2)))
        q = self.norms[1](q + self._attend(q, self.position(scaled.flatten(2)), bias))
        q = self.norms[2](q + self.feed(q))
        h = F.relu(self.from_point(e) + self.from_query(q)[:, :, None] + self.head_vertex)
        step = self.move(h).float()
        shift = self.whole(q).float().reshape(batch, count, vertices, 2)
        moved = points + 2.0 * step[..., :2] + 8.0 * shift
        return q, LayerOutput(moved, step[..., 2:].clamp(-4, 4), self.classify(q).float())

    def _look(self, points: Tensor, fine: Tensor, coarse: Tensor) -> Tensor:
        """(B, Q, V, 3 · fine + coarse) features on the line, left of it and right of it."""
        batch, count, vertices, _ = points.shape
        t = unit_tangents(points)
        normal = torch.stack([-t[..., 1], t[..., 0]], dim=-1) * NORMAL_OFFSET_M
        at = torch.stack([points, points + normal, points - normal], dim=3)
        near = sample_map(fine, at.reshape(batch, -1, 2), self.half_range)
        far = sample_map(coarse, points.reshape(batch, -1, 2), self.half_range)
        near = near.reshape(batch, count, vertices, -1)
        return torch.cat([near, far.reshape(batch, count, vertices, -1)], dim=-1)

    def _geometry(self, points: Tensor, scaled: Tensor) -> Tensor:
        """(B, Q, V, 36): tangent, place within the element, sines and cosines of the position."""
        angle = (scaled[..., None] * self.frequencies).flatten(-2)
        local = (points - points.mean(dim=2, keepdim=True)) / 10.0
        return torch.cat([unit_tangents(points), local, angle.sin(), angle.cos()], dim=-1)

    def _attend(self, q: Tensor, position: Tensor, bias: Tensor) -> Tensor:
        batch, count, width = q.shape
        size = width // self.heads
        query, key = self.query_key(q + position).chunk(2, dim=-1)
        query, key, value = (
            x.reshape(batch, count, self.heads, size).transpose(1, 2)
            for x in (query, key, self.value(q))
        )
        weight = (query * size**-0.5) @ key.transpose(-1, -2) + bias.to(query.dtype)
        mixed = weight.softmax(dim=-1) @ value
        return self.out(mixed.transpose(1, 2).reshape(batch, count, width))


class Decoder(nn.Module):
    """A stack of refinement layers; each starts from the detached points of the one before."""

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.layers = nn.ModuleList(RefineLayer(config) for _ in range(config.layers))

    def forward(
        self, queries: Queries, fine: Tensor, coarse: Tensor, bias: Tensor
    ) -> list[LayerOutput]:
        """Hybrid queries and maps → the output of every layer, the last one being the answer."""
        fine, coarse = fine.float().contiguous(), coarse.float().contiguous()
        outputs: list[LayerOutput] = []
        for layer in self.layers:
            features, output = layer(queries, fine, coarse, bias)
            outputs.append(output)
            queries = Queries(features, output.points.detach())
        return outputs
