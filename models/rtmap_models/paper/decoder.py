"""The decoder: decoupled self-attention, deformable cross-attention, iterative refinement."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from rtmap_models.config import PaperConfig
from rtmap_models.paper.attention import DeformableAttention, SelfAttention
from rtmap_models.paper.queries import HybridQueries
from rtmap_models.tiny.decoder import LayerOutput

STEP_M = 4.0
"""Metres per unit of the refinement head, so that its weights stay near one."""

LOG_SCALE = (-4.5, 4.0)
"""Bounds of the logarithm of a Laplace scale in metres: 1 cm and 55 m."""

FREQUENCIES = 8


class LayerTokens(NamedTuple):
    """After one layer: what it says, and its tokens (B, Q, V, D)."""

    output: LayerOutput
    tokens: Tensor


class DecoderLayer(nn.Module):
    """Instances talk, the vertices of one instance talk, both read the map, all move."""

    half_range: Tensor
    frequencies: Tensor

    def __init__(self, config: PaperConfig):
        super().__init__()
        width, heads, dropout = config.width, config.heads, config.dropout
        self.where = nn.Linear(4 * FREQUENCIES, width)
        self.between = SelfAttention(width, heads, dropout)
        self.within = SelfAttention(width, heads, dropout)
        self.cross = DeformableAttention(
            width, heads, config.deform_points, config.half_range, 2 * config.cell_m, dropout
        )
        self.feed = nn.Sequential(
            nn.Linear(width, config.feedforward),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(config.feedforward, width),
            nn.Dropout(dropout),
        )
        self.norm = nn.LayerNorm(width)
        self.classify = nn.Sequential(
            nn.Linear(width, width), nn.LayerNorm(width), nn.ReLU(),
            nn.Linear(width, len(config.classes)),
        )  # fmt: skip
        self.move = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 4))
        nn.init.normal_(self.move[-1].weight, std=1e-2)
        nn.init.zeros_(self.move[-1].bias)
        # One positive in a hundred at the start (focal loss).
        nn.init.constant_(self.classify[-1].bias, -math.log(99.0))
        half = torch.tensor(config.half_range)
        self.register_buffer("half_range", half, persistent=False)
        frequencies = 2.0 ** torch.arange(FREQUENCIES) * math.pi / 2
        self.register_buffer("frequencies", frequencies, persistent=False)

    def forward(
        self,
        queries: HybridQueries,
        values: Tensor,
        bias: Tensor | None,
        prior_class: Tensor | None,
    ) -> LayerTokens:
        """``values`` of the map (`DeformableAttention.values`), ``bias`` (B, 1, Q, Q),
        ``prior_class`` one-hot (B, P, C) of the last P queries."""
        x, points = queries.tokens, queries.points
        batch, count, vertices, width = x.shape
        place = queries.place + self.where(self._position(points)).float()
        across = x.transpose(1, 2).reshape(batch * vertices, count, width)
        across_place = place.transpose(1, 2).reshape(batch * vertices, count, width)
        if bias is not None:
            bias = bias.expand(-1, vertices, -1, -1).reshape(batch * vertices, 1, count, count)
        across = self.between(across, across_place, bias)
        x = across.reshape(batch, vertices, count, width).transpose(1, 2)
        along = x.reshape(batch * count, vertices, width)
        along = self.within(along, place.reshape(batch * count, vertices, width))
        flat = along.reshape(batch, count * vertices, width)
        flat = self.cross(flat, place.flatten(1, 2), points.flatten(1, 2), values)
        flat = self.norm(flat + self.feed(flat).float())
        x = flat.reshape(batch, count, vertices, width)
        step = self.move(x).float()
        logits = self.classify(x.mean(dim=2)).float()
        output = LayerOutput(
            points + STEP_M * step[..., :2],
            step[..., 2:].clamp(*LOG_SCALE),
            torch.cat([logits, _existence(logits, prior_class)], dim=-1),
        )
        return LayerTokens(output, x)

    def _position(self, points: Tensor) -> Tensor:
        """(..., 32) sines and cosines of (..., 2) metres."""
        angle = ((points / self.half_range)[..., None] * self.frequencies).flatten(-2)
        return torch.cat([angle.sin(), angle.cos()], dim=-1)


def _existence(logits: Tensor, prior_class: Tensor | None) -> Tensor:
    """(B, Q, 1): a prior slot exists when its own class is seen (the paper separates Q_map from
    Q_fake by the class confidence); a new query when any class is."""
    best = logits.amax(dim=-1)
    if prior_class is None:
        return best[..., None]
    slots = prior_class.shape[1]
    own = (logits[:, -slots:] * prior_class).sum(dim=-1)
    return torch.cat([best[:, :-slots], own], dim=1)[..., None]


class PaperDecoder(nn.Module):
    """A stack of layers; each starts from the detached points of the one before."""

    def __init__(self, config: PaperConfig):
        super().__init__()
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(config.layers))

    def values(self, bev: Tensor) -> list[Tensor]:
        """What each layer reads on the map (B, D, h, w): made once for all queries."""
        return [layer.cross.values(bev) for layer in self.layers]

    def forward(
        self,
        queries: HybridQueries,
        values: list[Tensor],
        bias: Tensor | None,
        prior_class: Tensor | None,
    ) -> list[LayerTokens]:
        """Hybrid queries and what `values` made of the map → every layer's output, the last one
        being the answer."""
        outputs: list[LayerTokens] = []
        for layer, of_layer in zip(self.layers, values, strict=True):
            made = layer(queries, of_layer, bias, prior_class)
            outputs.append(made)
            queries = HybridQueries(made.tokens, queries.place, made.output.points.detach())
        return outputs
