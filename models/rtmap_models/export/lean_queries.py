"""The proposals in few operations: shapes are worked out for the chosen cells only."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.tiny.queries import OFFSET_SCALE, DenseProposals, ProposalHead, Queries


def propose(self: ProposalHead, coarse: Tensor) -> tuple[Queries, DenseProposals | None]:
    """As `ProposalHead.forward`, without the proposals of all cells."""
    batch, cells = coarse.shape[0], coarse.shape[2] * coarse.shape[3]
    stem = self.stem(coarse)
    heat = self.heat(stem)
    peak = torch.where(F.max_pool2d(heat, 3, 1, 1) > heat, heat - 8.0, heat).flatten(1)
    index = peak.topk(self.count, dim=1).indices  # (B, Q)
    class_id = index // cells
    cell = index - class_id * cells
    feature = stem.flatten(2)
    feature = feature.gather(2, cell[:, None].expand(-1, feature.shape[1], -1))  # (B, width, Q)
    offset = self.shape(feature[..., None]) * OFFSET_SCALE
    offset = offset.reshape(batch, self.classes, 2 * self.vertices, self.count)
    one_hot = F.one_hot(class_id, self.classes).float()
    offset = (offset * one_hot.transpose(1, 2)[:, :, None]).sum(dim=1).transpose(1, 2)
    points = offset.reshape(batch, self.count, self.vertices, 2)
    points = points + self.centres.reshape(-1, 2)[cell][:, :, None]
    features = self.embed(torch.cat([feature.transpose(1, 2), one_hot], dim=-1))
    return Queries(features, points, class_id), None
