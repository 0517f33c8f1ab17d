"""The decoder: hybrid queries in; scores, points, scales and existence out, layer by layer."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.config import TinyConfig
from rtmap_models.tiny.queries import Queries

NORMAL_OFFSET_M = 0.8
"""The fine map is read on the line and this far to its left and right."""

WIDE_OFFSETS_M = (2.5, 5.0)
"""The coarse map is read this far to either side too: proposals may be metres off."""

FIELD_SCALE_M = 2.0
"""Metres per unit of the offset field as a feature."""


class Maps(NamedTuple):
    """What a decoder reads, float32: ``fine`` (B, F, H/2, W/2), ``coarse`` (B, G, h, w), ``side``
    (B, S, h, w), the coarse map thinned; ``field`` (B, 3 C, H/2, W/2): per class the logit of an
    element there, and the metres x, y to the nearest one."""

    fine: Tensor
    coarse: Tensor
    side: Tensor
    field: Tensor


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
        # What came later starts at zero: a network trained without it keeps its answers.
        self.wide = nn.Linear(2 * len(WIDE_OFFSETS_M) * config.side_width + 9, point, bias=False)
        nn.init.zeros_(self.wide.weight)
        self.gate = nn.Linear(64, 1)
        nn.init.zeros_(self.gate.weight)
        nn.init.zeros_(self.gate.bias)
        self.classes = len(config.classes)
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

    def forward(self, queries: Queries, maps: Maps, bias: Tensor) -> tuple[Tensor, LayerOutput]:
        """Maps and bias (B, 1, Q, Q) → new features (B, Q, D), output."""
        q, points, class_id = queries
        batch, count, vertices, _ = points.shape
        scaled = points / self.half_range
        wide, pull = self._look_wide(points, class_id, maps)
        e = F.relu(
            self.read(self._look(points, maps))
            + self.wide(wide)
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
        drawn = self.gate(h).float().sigmoid() * pull
        moved = points + drawn + 2.0 * step[..., :2] + 8.0 * shift
        return q, LayerOutput(moved, step[..., 2:].clamp(-4, 4), self.classify(q).float())

    def _look(self, points: Tensor, maps: Maps) -> Tensor:
        """(B, Q, V, 3 · fine + coarse) features on the line, left of it and right of it."""
        batch, count, vertices, _ = points.shape
        t = unit_tangents(points)
        normal = torch.stack([-t[..., 1], t[..., 0]], dim=-1) * NORMAL_OFFSET_M
        at = torch.stack([points, points + normal, points - normal], dim=3)
        near = sample_map(maps.fine, at.reshape(batch, -1, 2), self.half_range)
        far = sample_map(maps.coarse, points.reshape(batch, -1, 2), self.half_range)
        near = near.reshape(batch, count, vertices, -1)
        return torch.cat([near, far.reshape(batch, count, vertices, -1)], dim=-1)

    def _look_wide(self, points: Tensor, class_id: Tensor, maps: Maps) -> tuple[Tensor, Tensor]:
        """(B, Q, V, ·) features metres away and the field of the query's own class, read on the
        line and beside it; (B, Q, V, 2) metres that the field says the vertex is off."""
        batch, count, vertices, _ = points.shape
        t = unit_tangents(points)
        normal = torch.stack([-t[..., 1], t[..., 0]], dim=-1)
        at = torch.stack(
            [points + o * normal for d in WIDE_OFFSETS_M for o in (d, -d)], dim=3
        ).reshape(batch, -1, 2)
        wide = sample_map(maps.side, at, self.half_range).reshape(batch, count, vertices, -1)
        step = normal * NORMAL_OFFSET_M
        at = torch.stack([points, points + step, points - step], dim=3).reshape(batch, -1, 2)
        field = sample_map(maps.field, at, self.half_range)
        field = field.reshape(batch, count, vertices, 3, self.classes, 3)
        own = F.one_hot(class_id, self.classes).to(field.dtype)[:, :, None, None, :, None]
        field = (field * own).sum(dim=4)  # (B, Q, V, 3 places, 3)
        pull = field[:, :, :, 0, 1:]
        across = (field[..., 1:] * normal[:, :, :, None]).sum(-1)
        along = (pull * t).sum(-1, keepdim=True)
        seen = torch.cat([field[..., 0], across / FIELD_SCALE_M, along / FIELD_SCALE_M], dim=-1)
        return torch.cat([wide, seen, pull / FIELD_SCALE_M], dim=-1), pull

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
        self.side = nn.Conv2d(config.coarse_width, config.side_width, 1)

    def forward(
        self, queries: Queries, fine: Tensor, coarse: Tensor, field: Tensor, bias: Tensor
    ) -> list[LayerOutput]:
        """Hybrid queries, maps and the offset field (B, 3 C, H/2, W/2) → the output of every
        layer, the last one being the answer."""
        side = self.side(coarse).float().contiguous()
        maps = Maps(fine.float().contiguous(), coarse.float().contiguous(), side, field)
        outputs: list[LayerOutput] = []
        for layer in self.layers:
            features, output = layer(queries, maps, bias)
            outputs.append(output)
            queries = Queries(features, output.points.detach(), queries.class_id)
        return outputs
