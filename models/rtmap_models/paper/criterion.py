"""The losses of the paper's network.

Vertices (Eq. 3): λ1 · NLL + λ2 · Manhattan, summed over vertices and axes, averaged over elements.
The NLL, introduced there as Gaussian, is the Laplace one: ``log 2b + |error| / b``; it is the same
in metres and in units of the range but for a constant. The Manhattan distance is taken in units of
the range, as in MapTR, where λ2 = 5 comes from. Class, direction and dense losses as in MapTRv2;
its depth loss is left out, because no frame carries a depth target.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.cameras import project
from rtmap_models.config import PaperConfig
from rtmap_models.data.dataset import Batch
from rtmap_models.paper.assign import ALPHA, Assigner, jobs_of, many_jobs
from rtmap_models.paper.prediction import PaperPrediction
from rtmap_models.tiny.decoder import LayerOutput
from rtmap_models.tiny.matcher import Matches

SMOOTH = 0.01
"""Where the smooth L1 of the pose turns from square to straight: 1 cm, 0.57°."""

LINE_SAMPLES = 16
"""Points per segment of an element when it is drawn into the images."""

BEV_POSITIVE, IMAGE_POSITIVE = 4.0, 1.0
"""Weight of positives in the dense losses."""

Parts = dict[str, Tensor]


def paper_losses(prediction: PaperPrediction, batch: Batch, config: PaperConfig) -> Parts:
    """The weighted parts by name; their sum is the loss. A part of weight 0 is not computed."""
    assigner, parts = Assigner(batch, config), Parts()
    jobs = jobs_of(batch, prediction.new_count, config.pre_attribution)
    for output in prediction.layers:
        _add(parts, _layer(output, assigner(output, jobs), prediction.new_count, batch, config))
    many = many_jobs(batch, config.many_queries)
    for output in prediction.many:
        match = assigner(output, many, config.many_repeat)
        total = sum(_layer(output, match, config.many_queries, batch, config, False).values())
        _add(parts, {"many": config.many_weight * total})
    for delta in prediction.poses:
        if config.use_pose_loss and config.pose_weight:
            _add(parts, {"pose": config.pose_weight * pose_loss(delta, batch, config)})
    dense = _dense_losses(prediction, batch, config)
    return parts | {k: v for k, v in dense.items() if v is not None}


def _add(parts: Parts, more: Parts) -> None:
    for name, value in more.items():
        parts[name] = parts[name] + value if name in parts else value


def _layer(
    output: LayerOutput,
    match: Matches,
    new_count: int,
    batch: Batch,
    config: PaperConfig,
    with_prior: bool = True,
) -> Parts:
    """Class, vertex and direction losses of one layer, weighted."""
    device = output.points.device
    sample, query, truth = (torch.from_numpy(x).to(device) for x in match)
    found = output.points[sample, query]
    target = nearest_order(found.detach(), batch.truth_orders[truth])
    class_id = batch.truth_class[truth]
    if with_prior and config.pre_attribution:
        b, slot = (batch.prior_mask * batch.prior_real).nonzero(as_tuple=True)
        sample, query = torch.cat([sample, b]), torch.cat([query, slot + new_count])
        target = torch.cat([target, batch.prior_target[b, slot]])
        class_id = torch.cat([class_id, batch.prior_class[b, slot]])
    points, log_scale = output.points[sample, query], output.log_scale[sample, query]
    count = max(1, len(sample))

    logits = output.logits[..., :-1]
    wanted = torch.zeros_like(logits)
    wanted[sample, query, class_id] = 1.0
    focal = focal_loss(logits, wanted).sum(dim=-1)
    if with_prior:
        counted = torch.ones_like(focal[:, :new_count])
        focal = focal * torch.cat([counted, batch.prior_mask.to(focal.dtype)], dim=1)
    parts = {"class": config.class_weight * focal.sum() / count}

    error = (points - target).abs()
    length = 2.0 * torch.tensor(config.half_range, device=device)
    parts["points"] = config.manhattan_weight * (error / length).sum() / count
    if config.use_nll and config.nll_weight:
        parts["laplace"] = config.nll_weight * laplace_nll(error, log_scale).sum() / count
    if config.direction_weight:
        cosine = F.cosine_similarity(points.diff(dim=1), target.diff(dim=1), dim=-1, eps=1e-2)
        parts["direction"] = config.direction_weight * (1.0 - cosine).sum() / count
    return parts


def laplace_nll(error: Tensor, log_scale: Tensor) -> Tensor:
    """Eq. 3: ``log 2b + |error| / b`` per coordinate; metres, b = exp(log_scale)."""
    return math.log(2.0) + log_scale + error * torch.exp(-log_scale)


def focal_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Focal loss (γ = 2, α = 0.25) per value; ``target`` is 0 or 1."""
    plain = F.binary_cross_entropy_with_logits(logits, target, reduction="none")
    missed = (target - logits.sigmoid()).square()
    return plain * missed * torch.where(target > 0, ALPHA, 1.0 - ALPHA)


def nearest_order(points: Tensor, orders: Tensor) -> Tensor:
    """The order (M, V, 2) of each truth element (M, K, V, 2) nearest to the points (M, V, 2)."""
    best = (orders - points[:, None]).abs().sum(dim=(2, 3)).argmin(dim=1)
    return orders[torch.arange(len(orders), device=orders.device), best]


def pose_loss(delta: Tensor, batch: Batch, config: PaperConfig) -> Tensor:
    """Smooth L1 of (B, 3), metres weighted by ``translation_weight`` against radians; samples
    without a prior do not count."""
    has_prior = batch.prior_mask.amax(dim=1)
    plain = F.smooth_l1_loss(delta, batch.delta, reduction="none", beta=SMOOTH)
    per_sample = config.translation_weight * plain[:, :2].sum(dim=1) + plain[:, 2]
    return (per_sample * has_prior).sum() / has_prior.sum().clamp(min=1.0)


def _dense_losses(
    prediction: PaperPrediction, batch: Batch, config: PaperConfig
) -> dict[str, Tensor | None]:
    """Segmentation of the bird's-eye map and of the images."""
    bev = image = None
    if config.bev_segmentation_weight and prediction.segmentation is not None:
        target = batch.segmentation.float()
        plain = _binary(prediction.segmentation, target, BEV_POSITIVE).mean()
        bev = config.bev_segmentation_weight * plain
    if config.image_segmentation_weight and prediction.image_classes is not None:
        assert batch.ego_to_image is not None
        target = image_target(batch, prediction.image_classes, config)
        plain = _binary(prediction.image_classes, target, IMAGE_POSITIVE)
        present = (batch.ego_to_image.abs().amax(dim=(2, 3)) > 0).float()
        mean = plain.mean(dim=(2, 3, 4))
        total = (mean * present).sum() / present.sum().clamp(min=1.0)
        image = config.image_segmentation_weight * total
    return {"segmentation": bev, "image_segmentation": image}


def _binary(logits: Tensor, target: Tensor, positive: float) -> Tensor:
    weight = torch.tensor(positive, device=logits.device)
    return F.binary_cross_entropy_with_logits(logits, target, pos_weight=weight, reduction="none")


def image_target(batch: Batch, like: Tensor, config: PaperConfig) -> Tensor:
    """0 / 1 like ``like`` (B, N, C, h, w): the elements' outlines on the plane z = 0, projected.

    What stands in between is not known and hides nothing, as in MapTRv2.
    """
    assert batch.ego_to_image is not None
    target = torch.zeros_like(like)
    rows, columns = like.shape[3:]
    (height, width), stride = config.image_size, config.image_stride
    step = torch.linspace(0, 1, LINE_SAMPLES, device=like.device)[:, None]
    for b in range(len(like)):
        first, last = int(batch.truth_start[b]), int(batch.truth_start[b + 1])
        lines = batch.truth_orders[first:last, 0]
        dense = lines[:, :-1, None] + (lines[:, 1:] - lines[:, :-1])[:, :, None] * step
        ground = F.pad(dense.reshape(-1, 2), (0, 1)).t()  # (3, K)
        class_id = batch.truth_class[first:last].repeat_interleave((lines.shape[1] - 1) * len(step))
        u, v, depth = (x[0] for x in project(ground, batch.ego_to_image[b : b + 1]))
        seen = (depth > 0.5) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        camera, point = seen.nonzero(as_tuple=True)
        row = (v[camera, point] / stride).round().long().clamp(max=rows - 1)
        column = (u[camera, point] / stride).round().long().clamp(max=columns - 1)
        target[b, camera, class_id[point], row, column] = 1.0
    return target
