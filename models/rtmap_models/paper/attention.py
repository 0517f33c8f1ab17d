"""Attention between tokens, and from tokens to the bird's-eye map by ``grid_sample``."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class SelfAttention(nn.Module):
    """Multi-head attention of T tokens to each other, with residual and normalisation."""

    def __init__(self, width: int, heads: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.query_key, self.value = nn.Linear(width, 2 * width), nn.Linear(width, width)
        self.out, self.norm = nn.Linear(width, width), nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, place: Tensor, bias: Tensor | None = None) -> Tensor:
        """Tokens and their places (M, T, D), additive ``bias`` (M, 1, T, T) → (M, T, D)."""
        batch, count, width = x.shape
        query, key = self.query_key(x + place).chunk(2, dim=-1)
        query, key, value = (
            t.reshape(batch, count, self.heads, width // self.heads).transpose(1, 2)
            for t in (query, key, self.value(x))
        )
        if bias is not None:
            bias = bias.to(query.dtype)
        mixed = _attend(query, key, value, bias)
        mixed = mixed.transpose(1, 2).reshape(batch, count, width)
        return self.norm(x + self.dropout(self.out(mixed)).float())


def _attend(query: Tensor, key: Tensor, value: Tensor, bias: Tensor | None) -> Tensor:
    """(M, heads, T, d) each, additive ``bias`` → (M, heads, T, d)."""
    if query.device.type == "cpu" and query.dtype == torch.bfloat16:
        # torch's fused kernel goes back 2 to 9 times slower than this in bfloat16 on a CPU.
        score = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
        score = score if bias is None else score + bias
        return score.softmax(dim=-1).to(value.dtype) @ value
    return F.scaled_dot_product_attention(query, key, value, attn_mask=bias)


class DeformableAttention(nn.Module):
    """Each token reads the map at a few learned offsets from its reference point.

    As Deformable DETR's attention of one level, written with ``grid_sample`` alone. Coordinates
    and sampling are float32 whatever surrounds them.
    """

    half_range: Tensor
    cell: Tensor

    def __init__(
        self,
        width: int,
        heads: int,
        points: int,
        half_range: tuple[float, float],
        cell_m: float,
        dropout: float,
    ):
        super().__init__()
        self.heads, self.points = heads, points
        self.offsets = nn.Linear(width, heads * points * 2)
        self.weights = nn.Linear(width, heads * points)
        self.value, self.out = nn.Conv2d(width, width, 1), nn.Linear(width, width)
        self.norm, self.dropout = nn.LayerNorm(width), nn.Dropout(dropout)
        self.cell_m = cell_m
        self.register_buffer("half_range", torch.tensor(half_range), persistent=False)
        nn.init.normal_(self.offsets.weight, std=1e-3)
        with torch.no_grad():
            self.offsets.bias.copy_(_star(heads, points).reshape(-1))

    def values(self, bev: Tensor) -> Tensor:
        """The map (B, D, h, w) → what is read there, (B · heads, D / heads, h, w) float32."""
        batch, width, rows, columns = bev.shape
        value = self.value(bev).float()
        return value.reshape(batch * self.heads, width // self.heads, rows, columns)

    def forward(self, x: Tensor, place: Tensor, reference: Tensor, values: Tensor) -> Tensor:
        """Tokens (B, T, D), reference points (B, T, 2) m, ``values`` → (B, T, D)."""
        batch, count, width = x.shape
        query = x + place
        offsets = self.offsets(query).float().reshape(batch, count, self.heads, self.points, 2)
        weight = self.weights(query).float().reshape(batch, count, self.heads, self.points)
        at = (reference[:, :, None, None] + offsets * self.cell_m) / self.half_range
        at = at.transpose(1, 2).reshape(batch * self.heads, count, self.points, 2)
        read = F.grid_sample(
            values, at, mode="bilinear", padding_mode="zeros", align_corners=False
        )  # (B · heads, D / heads, T, points)
        weight = weight.softmax(dim=-1).transpose(1, 2).reshape(-1, 1, count, self.points)
        mixed = (read * weight).sum(dim=-1).reshape(batch, width, count).transpose(1, 2)
        return self.norm(x + self.dropout(self.out(mixed)).float())


def _star(heads: int, points: int) -> Tensor:
    """(heads, points, 2) first offsets in cells: each head looks its own way, ever farther."""
    angle = torch.arange(heads) * (2.0 * math.pi / heads)
    way = torch.stack([angle.cos(), angle.sin()], dim=-1)
    way = way / way.abs().amax(dim=-1, keepdim=True)
    return way[:, None] * torch.arange(1, points + 1)[:, None].float()
