"""Hybrid queries (Eq. 2 of the paper): what the prior holds, and what is to be found.

Each query is an instance of V vertex tokens. A vertex of the prior is its XY and the one-hot class
of its element; the slots that the prior does not use are padded with zeros and are the queries for
new elements. A linear layer takes both to tokens, and the hierarchical embedding Q_hie (instance
plus vertex, as in MapTR) is added. The order of the prior's slots means nothing, so they share
one instance embedding and their number is free.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.config import PaperConfig


class HybridQueries(NamedTuple):
    """``tokens`` and ``place`` (B, Q, V, D): content and positional part; ``points`` (B, Q, V, 2)
    reference points in metres. New queries first, then the prior's slots in their order."""

    tokens: Tensor
    place: Tensor
    points: Tensor


class QueryEncoder(nn.Module):
    """Prior elements and learned embeddings → hybrid queries."""

    half_range: Tensor

    def __init__(self, config: PaperConfig):
        super().__init__()
        self.classes, self.width = len(config.classes), config.width
        self.new_queries, self.many_queries = config.new_queries, config.many_queries
        vertices, width = config.vertex_count, config.width
        self.encode = nn.Linear(2 + self.classes, width)
        self.instance = nn.Parameter(torch.randn(config.new_queries, 2 * width) * 0.5)
        self.prior_instance = nn.Parameter(torch.randn(1, 2 * width) * 0.5)
        self.vertex = nn.Parameter(torch.randn(vertices, 2 * width) * 0.5)
        if config.many_queries:
            self.many_instance = nn.Parameter(torch.randn(config.many_queries, 2 * width) * 0.5)
        self.reference = nn.Linear(width, 2)
        half = torch.tensor(config.half_range)
        self.register_buffer("half_range", half, persistent=False)

    def forward(self, points: Tensor, class_id: Tensor, mask: Tensor) -> HybridQueries:
        """(B, P, V, 2) metres, (B, P) int64, (B, P) 1 = used → queries, new ones first.

        Unused slots enter as zeros, whatever they hold.
        """
        batch = points.shape[0]
        new = self._learned(self.instance, batch)
        used = mask.float()[..., None, None]
        one_hot = F.one_hot(class_id.clamp(0, self.classes - 1), self.classes).float()
        one_hot = one_hot[:, :, None].expand(-1, -1, points.shape[2], -1)
        content = torch.cat([points / self.half_range, one_hot], dim=-1) * used
        place, tokens = (self.prior_instance[:, None] + self.vertex).chunk(2, dim=-1)
        slots = self.encode(content).float() + tokens
        return HybridQueries(
            torch.cat([new.tokens, slots], dim=1),
            torch.cat([new.place, place.expand_as(slots)], dim=1),
            torch.cat([new.points, points * used], dim=1),
        )

    def many(self, batch: int) -> HybridQueries:
        """The one-to-many queries of MapTRv2: new queries of their own, used in training only."""
        return self._learned(self.many_instance, batch)

    def _learned(self, instance: Tensor, batch: int) -> HybridQueries:
        place, tokens = (instance[:, None] + self.vertex).chunk(2, dim=-1)
        # The zero padding through the linear layer is its bias.
        tokens = tokens + self.encode.bias
        points = (self.reference(place).float().sigmoid() * 2.0 - 1.0) * self.half_range
        return HybridQueries(*(x.expand(batch, -1, -1, -1) for x in (tokens, place, points)))
