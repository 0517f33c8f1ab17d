"""From the last layer of any decoder to the outputs of the exported graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.config import ModelConfig
from rtmap_models.pose import PoseEstimate, PoseHead
from rtmap_models.tiny.decoder import LayerOutput

if TYPE_CHECKING:
    from rtmap_models.data.dataset import Batch


class Answer(NamedTuple):
    """The outputs of the exported model (docs/model-contract.md)."""

    scores: Tensor  # (B, Q, C) in 0 … 1
    points: Tensor  # (B, Q, V, 2) metres
    sigma: Tensor  # (B, Q, V, 2) standard deviations, metres
    prior_score: Tensor  # (B, P) in 0 … 1
    pose_delta: Tensor  # (B, 3)
    pose_covariance: Tensor  # (B, 3, 3)


class Layers(Protocol):
    """What an answer is made of; queries are the new ones first, then the prior slots."""

    @property
    def layers(self) -> list[LayerOutput]:
        """Every layer's output."""

    @property
    def new_count(self) -> int:
        """How many queries are new ones."""


class AnsweringNet(nn.Module):
    """What all networks share: honest scales and scores, closed rings, the pose.

    ``sigma_factor`` (C, 2) is measured after training: what the Laplace scale of each class (new,
    prior) must be multiplied with to be honest. So is ``score_fit`` (2, C, 4): per mode (without,
    with a prior) and class what makes the `hints` of a new query the logit of a probability.
    """

    sigma_factor: Tensor
    score_fit: Tensor

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.pose = PoseHead()
        self.register_buffer("sigma_factor", torch.ones(len(config.classes), 2))
        fit = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(2, len(config.classes), 1)
        # Not kept with the weights: measured anew for every export.
        self.register_buffer("score_fit", fit, persistent=False)

    def predict_batch(self, batch: Batch, bf16: bool = False) -> Layers:
        """All layers on a training batch; convolutions in bfloat16 where that is asked for."""
        raise NotImplementedError

    def losses(self, batch: Batch, bf16: bool = False) -> dict[str, Tensor]:
        """The weighted parts of the loss by name; their sum is the loss."""
        raise NotImplementedError

    def answer(
        self, prediction: Layers, prior_points: Tensor, prior_class: Tensor, prior_mask: Tensor
    ) -> Answer:
        """The last layer in metres and probabilities, rings closed, unused slots zero."""
        n, last = prediction.new_count, prediction.layers[-1]
        classes = len(self.config.classes)
        used = prior_mask.float()
        one_hot = F.one_hot(prior_class.clamp(0, classes - 1), classes).float()
        exists = last.logits[:, n:, classes].sigmoid() * used
        aided = (used.sum(dim=1) > 0).long()
        fit = self.score_fit[aided][:, None]  # (B, 1, C, 4)
        new_scores = (hints(last, n, classes) * fit).sum(dim=-1).sigmoid()
        scores = torch.cat([new_scores, one_hot * exists[..., None]], dim=1)
        best = torch.cat([new_scores.argmax(-1), prior_class.clamp(0, classes - 1)], dim=1)
        points = self._close(last.points, best)
        scale = last.log_scale.exp() * self._factor(best, n)
        estimate: PoseEstimate = self.pose(
            prior_points * used[..., None, None], points[:, n:], scale[:, n:], exists
        )
        delta = self.correction(prediction, estimate)
        return Answer(scores, points, laplace_sigma(scale), exists, delta, estimate.covariance)

    def correction(self, prediction: Layers, estimate: PoseEstimate) -> Tensor:
        """(B, 3) the pose that is answered with; its covariance is always the least squares'."""
        return estimate.delta

    def _close(self, points: Tensor, class_id: Tensor) -> Tensor:
        ring = torch.zeros_like(class_id, dtype=torch.bool)
        for k in self.config.ring_ids:
            ring = ring | (class_id == k)
        last = torch.where(ring[..., None, None], points[:, :, :1], points[:, :, -1:])
        return torch.cat([points[:, :, :-1], last], dim=2)

    def _factor(self, class_id: Tensor, new_count: int) -> Tensor:
        factor = self.sigma_factor[class_id]  # (B, Q, 2): new, prior
        new, prior = factor[:, :new_count, 0], factor[:, new_count:, 1]
        return torch.cat([new, prior], dim=1)[..., None, None]


def hints(last: LayerOutput, new_count: int, classes: int) -> Tensor:
    """(B, n, C, 4): what tells whether a new query is right: its logit of each class, how sharply
    it is placed (minus the mean log of its scales), the log of 1 m and its length, and one.

    A network is often sure where a line lies before it dares to say that there is one.
    """
    logits = last.logits[:, :new_count, :classes]
    sharp = -last.log_scale[:, :new_count].mean(dim=(2, 3))
    step = last.points[:, :new_count, 1:] - last.points[:, :new_count, :-1]
    size = step.square().sum(dim=-1).clamp(min=1e-8).sqrt().sum(dim=-1)
    beside = torch.stack([sharp, (1.0 + size).log(), torch.ones_like(sharp)], dim=-1)
    beside = beside[:, :, None].expand(-1, -1, classes, -1)
    return torch.cat([logits[..., None], beside], dim=-1)


def laplace_sigma(scale: Tensor) -> Tensor:
    """Standard deviation of a Laplace distribution of scale b: √2 · b, the only place."""
    return scale * 2.0**0.5
