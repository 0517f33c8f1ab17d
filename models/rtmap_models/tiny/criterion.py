"""The losses: class, existence, points (Manhattan and Laplace), direction, dense helpers.

Eq. 3 of the paper is the Laplace negative log-likelihood ``log b + |error| / b`` (up to a
constant), per coordinate, b the scale in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.data.dataset import Batch
from rtmap_models.tiny.decoder import LayerOutput
from rtmap_models.tiny.image_branch import Tilts
from rtmap_models.tiny.matcher import Matcher
from rtmap_models.tiny.prediction import Prediction
from rtmap_models.tiny.queries import DenseProposals

TILT_UNIT = 0.01
"""Slopes of the road that are off by more are punished in proportion, below in squares."""


@dataclass(frozen=True)
class LossWeights:
    """What each part counts."""

    score: float = 2.0
    existence: float = 0.7
    points: float = 1.0
    laplace: float = 0.3
    direction: float = 0.5
    segmentation: float = 3.0
    field: float = 1.0
    heat: float = 0.5
    proposal: float = 1.0
    tilt: float = 1.0


def compute_losses(prediction: Prediction, batch: Batch, weights: LossWeights) -> dict[str, Tensor]:
    """The weighted parts; their sum is the loss."""
    matcher = Matcher(batch)
    parts: dict[str, Tensor] = {}
    for output in prediction.layers:
        for name, value in _layer_losses(output, prediction.new_count, batch, matcher).items():
            value = getattr(weights, name) * value
            parts[name] = parts[name] + value if name in parts else value
    parts["segmentation"] = weights.segmentation * _segmentation(prediction.segmentation, batch)
    parts["field"] = weights.field * _field(prediction.field, batch)
    heat, shape = _proposals(prediction.proposals, batch)
    parts["heat"], parts["proposal"] = weights.heat * heat, weights.proposal * shape
    if prediction.tilts is not None:
        parts["tilt"] = weights.tilt * tilt_loss(prediction.tilts)
    return parts


def _layer_losses(
    output: LayerOutput, new_count: int, batch: Batch, matcher: Matcher
) -> dict[str, Tensor]:
    match = matcher(output, new_count)
    sample, query, truth = (torch.from_numpy(x) for x in match)
    found = output.points[sample, query]
    target = _nearest_order(found.detach(), batch.truth_orders[truth])
    real = (batch.prior_mask * batch.prior_real) > 0
    n = new_count
    points = torch.cat([found, output.points[:, n:][real]])
    target = torch.cat([target, batch.prior_target[real]])
    log_scale = torch.cat([output.log_scale[sample, query], output.log_scale[:, n:][real]])
    error = (points - target).abs()

    classes = output.logits.shape[-1] - 1
    wanted = torch.zeros_like(output.logits[:, :n, :classes])
    # A query is worth its precision: scores rank elements by how well they are placed.
    close = error[: len(sample)].detach().mean(dim=(1, 2))
    wanted[sample, query, batch.truth_class[truth]] = 0.4 + 0.6 * torch.exp(-close)
    count = max(1, len(batch.truth_class))
    losses = {"score": _quality_focal(output.logits[:, :n, :classes], wanted).sum() / count}
    used = batch.prior_mask > 0
    losses["existence"] = _mean(
        F.binary_cross_entropy_with_logits(
            output.logits[:, n:, classes], batch.prior_real, reduction="none"
        )[used]
    )
    losses["points"] = point_loss(error)
    nll = error.clamp(max=20.0) * torch.exp(-log_scale) + log_scale
    losses["laplace"] = _mean(nll)
    cosine = F.cosine_similarity(
        points[:, 1:] - points[:, :-1], target[:, 1:] - target[:, :-1], dim=-1, eps=1e-2
    )
    losses["direction"] = _mean(1 - cosine)
    return losses


def point_loss(error: Tensor) -> Tensor:
    """Manhattan distance: steep near zero, never flat. ``error`` (M, V, 2) ≥ 0, metres."""
    return _mean(4.0 * torch.log1p(error / 2.0) + 0.5 * error)


def tilt_loss(tilts: Tilts) -> Tensor:
    """Smooth L1 of the slopes in units of `TILT_UNIT`, where the road is known."""
    known = ~tilts.true.isnan()
    error = torch.where(known, tilts.slopes - tilts.true, torch.zeros_like(tilts.true))
    return F.smooth_l1_loss(error / TILT_UNIT, torch.zeros_like(error), reduction="sum") / (
        known.sum().clamp(min=1)
    )


def _mean(values: Tensor) -> Tensor:
    return values.sum() / max(1, values.numel())


def _nearest_order(points: Tensor, orders: Tensor) -> Tensor:
    """The order (M, V, 2) of each truth element (M, K, V, 2) nearest to the points (M, V, 2)."""
    best = (orders - points[:, None]).abs().sum(dim=(2, 3)).argmin(dim=1)
    return orders[torch.arange(len(orders)), best]


def _quality_focal(logits: Tensor, target: Tensor) -> Tensor:
    """Focal loss towards soft targets (γ = 2; positives weigh 0.5, negatives 0.75)."""
    plain = F.binary_cross_entropy_with_logits(logits, target, reduction="none")
    weight = torch.where(target > 0, 0.5, 0.75)
    return plain * (target - logits.sigmoid()).square() * weight


def _segmentation(logits: Tensor, batch: Batch) -> Tensor:
    target = batch.segmentation.float()
    pos_weight = torch.tensor(2.0)
    plain = F.binary_cross_entropy_with_logits(logits, target, pos_weight=pos_weight)
    p = logits.sigmoid()
    both, either = (p * target).sum(dim=(0, 2, 3)), (p + target).sum(dim=(0, 2, 3))
    dice = (1 - (2 * both + 1) / (either + 1)).mean()
    return plain + dice / 3.0


def _field(field: Tensor, batch: Batch) -> Tensor:
    known = ~batch.field.isnan()
    error = torch.where(known, field - batch.field, torch.zeros_like(field)).abs()
    return error.sum() / known.sum().clamp(min=1) * 2


def _proposals(dense: DenseProposals, batch: Batch) -> tuple[Tensor, Tensor]:
    """Heat map (focal, as for centre points) and shapes at the cells near the middles."""
    p = dense.heat.sigmoid().clamp(1e-4, 1 - 1e-4)
    middle = batch.heat > 0.95
    hit = -p.log() * (1 - p).square()
    miss = -(1 - p).log() * p.square() * (1 - batch.heat).pow(4)
    heat = torch.where(middle, hit, miss).sum() / max(1, len(batch.truth_class))
    sample, class_id, row, column, truth = batch.cells.unbind(1)
    points = dense.points[sample, class_id, row, column]
    target = _nearest_order(points.detach(), batch.truth_orders[truth])
    return heat, point_loss((points - target).abs())
