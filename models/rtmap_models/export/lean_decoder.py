"""The decoder in few, large operations, as runtimes of ONNX like it.

The same sums as `RefineLayer.forward`, with coordinates and channels in front and vertices last
(B, C, Q, V): then x and y are whole planes, all places where a map is read stand in one list, the
samples come as the products with weights want them, and the convolution along the vertices is an
ordinary one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.tiny.decoder import (
    FIELD_SCALE_M,
    NORMAL_OFFSET_M,
    WIDE_OFFSETS_M,
    Decoder,
    LayerOutput,
    RefineLayer,
)
from rtmap_models.tiny.queries import Queries

BESIDE = (0.0, NORMAL_OFFSET_M, -NORMAL_OFFSET_M)
"""Metres to the left at which the fine map is read."""

WIDE = tuple(o for d in WIDE_OFFSETS_M for o in (d, -d))
"""And the thinned coarse map."""


class _Read(NamedTuple):
    """What is the same for all layers: the maps as in `Maps`; ``own`` (B, C, 1, 1, Q, V), 1 for
    the query's class; ``vertex`` (V, Q V), 1 for the vertex."""

    fine: Tensor
    coarse: Tensor
    side: Tensor
    field: Tensor
    own: Tensor
    vertex: Tensor


def decode(
    self: Decoder, queries: Queries, fine: Tensor, coarse: Tensor, field: Tensor, bias: Tensor
) -> list[LayerOutput]:
    """As `Decoder.forward`; only the last layer's output."""
    classes, vertices = self.layers[0].classes, queries.points.shape[2]
    own = F.one_hot(queries.class_id, classes).float().transpose(1, 2)[:, :, None, None, :, None]
    own = own.expand(-1, -1, -1, -1, -1, vertices)
    vertex = torch.eye(vertices).repeat(1, queries.points.shape[1])
    maps = _Read(fine, coarse, self.side(coarse), field, own, vertex)
    q, points = queries.features, queries.points.permute(0, 3, 1, 2)
    for layer in self.layers:
        q, points, log_scale, logits = _refine(layer, q, points, maps, bias)
    return [LayerOutput(points.permute(0, 2, 3, 1), log_scale, logits)]


def _refine(
    layer: RefineLayer, q: Tensor, points: Tensor, maps: _Read, bias: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features (B, Q, D), ``points`` (B, 2, Q, V) → both anew, log scales (B, Q, V, 2), logits."""
    batch, _, count, vertices = points.shape
    flat = points.flatten(2)  # (B, 2, Q V), and so are all planes until the convolution
    scaled = flat / layer.half_range[:, None]
    tangent = tangents(points)
    local = ((points - points.mean(dim=3, keepdim=True)) / 10.0).flatten(2)
    normal = torch.cat([-tangent[:, 1:], tangent[:, :1]], dim=1)
    near, far, wide, offset, pull = _look(flat, tangent, normal, maps, layer.half_range)
    angle = (scaled[:, :, None] * layer.frequencies[:, None]).flatten(1, 2)
    vertex = maps.vertex[None].expand(batch, -1, -1)
    rest = torch.cat([offset, tangent, local, angle.sin(), angle.cos(), vertex], dim=1)
    beside, straight, aside, other = _weights(layer, far.shape[1])
    e = beside @ near + straight @ far + aside @ wide + other @ rest
    asked = layer.ask(q) + (layer.read.bias + layer.place.bias)
    e = F.relu(e.unflatten(2, (count, vertices)) + asked.transpose(1, 2)[..., None])
    along = F.conv2d(e, layer.along.weight[:, :, None], layer.along.bias, padding=(0, 2))
    e = layer.point_norm((e + F.relu(along)).permute(0, 2, 3, 1))  # (B, Q, V, point_width)
    q = layer.norms[0](q + layer.gather(e.flatten(2)))
    place = scaled.reshape(batch, 2, count, vertices).permute(0, 2, 3, 1).flatten(2)
    q = layer.norms[1](q + layer._attend(q, layer.position(place), bias))
    q = layer.norms[2](q + layer.feed(q))
    query = layer.from_query(q)[:, :, None] + (layer.head_vertex + layer.from_point.bias)
    h = F.relu(e @ layer.from_point.weight.t() + query)
    step = layer.move(h)
    drawn = layer.gate(h)[..., 0].sigmoid()[:, None] * pull.unflatten(2, (count, vertices))
    shift = layer.whole(q).unflatten(2, (vertices, 2)) * 8.0
    moved = points + drawn + (step[..., :2] * 2.0 + shift).permute(0, 3, 1, 2)
    return q, moved, step[..., 2:].clamp(-4, 4), layer.classify(q)


def _weights(layer: RefineLayer, coarse: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of what is read beside the line, on it, metres to its sides (each (point_width, channels of
    the map · places), as samples come), and of the rest."""
    field = 3 * len(BESIDE)
    beside = layer.read.weight[:, :-coarse].unflatten(1, (len(BESIDE), -1)).transpose(1, 2)
    aside = layer.wide.weight[:, :-field].unflatten(1, (len(WIDE), -1)).transpose(1, 2)
    other = torch.cat([layer.wide.weight[:, -field:], layer.place.weight, layer.vertex.t()], dim=1)
    return beside.flatten(1), layer.read.weight[:, -coarse:], aside.flatten(1), other


def tangents(points: Tensor) -> Tensor:
    """As `unit_tangents`, of (B, 2, Q, V) → (B, 2, Q V)."""
    steps = torch.cat(
        [
            points[..., 1:2] - points[..., :1],
            points[..., 2:] - points[..., :-2],
            points[..., -1:] - points[..., -2:-1],
        ],
        dim=-1,
    ).flatten(2)
    return steps / (steps.square().sum(1, keepdim=True).sqrt() + 1e-3)


def _look(
    points: Tensor, tangent: Tensor, normal: Tensor, maps: _Read, half_range: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Planes (B, 2, K) → samples (B, channels · places, K) beside the line, on it and metres to
    its sides, what `wide` takes of the field, and the pull."""
    offsets = torch.tensor([*BESIDE, *WIDE])[:, None]
    at = (points[:, :, None] + normal[:, :, None] * offsets) / half_range[:, None, None]
    near = _sample(maps.fine, at[:, :, :3]).flatten(1, 2)
    far = _sample(maps.coarse, at[:, :, :1])[:, :, 0]
    wide = _sample(maps.side, at[:, :, 3:]).flatten(1, 2)
    field = _sample(maps.field, at[:, :, :3])  # (B, 3 C, 3 places, K)
    classes, (count, vertices) = maps.own.shape[1], maps.own.shape[4:]
    field = field.unflatten(3, (count, vertices)).unflatten(1, (classes, 3))
    own = (field * maps.own).sum(dim=1).flatten(3)  # (B, 3 values, 3 places, K)
    offset = own[:, 1:] / FIELD_SCALE_M
    across = (offset * normal[:, :, None]).sum(1)
    pull = offset[:, :, 0]
    along = (pull * tangent).sum(1, keepdim=True)
    return near, far, wide, torch.cat([own[:, 0], across, along, pull], dim=1), own[:, 1:, 0]


def _sample(features: Tensor, at: Tensor) -> Tensor:
    """(B, C, h, w) at (B, 2, n, K) in -1 … 1 → (B, C, n, K). Places are drawn half a cell in from
    the rim, which is what padding with the border's values gives."""
    height, width = features.shape[-2:]
    rim = torch.tensor([1.0 - 1.0 / width, 1.0 - 1.0 / height])[:, None, None]
    grid = torch.minimum(torch.maximum(at, -rim), rim).permute(0, 2, 3, 1)
    return F.grid_sample(features, grid, padding_mode="zeros", align_corners=False)
