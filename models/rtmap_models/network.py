"""The whole network, top to bottom: cameras → picture → maps → hybrid queries → answer."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.backbone import PictureNet
from rtmap_models.bev import BevWarp, normalize_picture
from rtmap_models.config import TinyConfig
from rtmap_models.decoder import Decoder, LayerOutput, attention_bias
from rtmap_models.pose import PoseEstimate, PoseHead
from rtmap_models.queries import DenseProposals, PriorEncoder, ProposalHead, Queries, join


class Prediction(NamedTuple):
    """Everything that training needs; queries are the new ones first, then the prior slots."""

    layers: list[LayerOutput]
    proposals: DenseProposals
    segmentation: Tensor  # (B, C, H/2, W/2) logits
    new_count: int


class Answer(NamedTuple):
    """The outputs of the exported model (docs/model-contract.md)."""

    scores: Tensor  # (B, Q, C) in 0 … 1
    points: Tensor  # (B, Q, V, 2) metres
    sigma: Tensor  # (B, Q, V, 2) standard deviations, metres
    prior_score: Tensor  # (B, P) in 0 … 1
    pose_delta: Tensor  # (B, 3)
    pose_covariance: Tensor  # (B, 3, 3)


class RTMapNet(nn.Module):
    """Images and prior in, elements, existence and pose out.

    ``sigma_factor`` (C, 2) is measured after training: what the Laplace scale of each class (new,
    prior) must be multiplied with to be honest. So is ``score_line`` (2, C, 2): per mode (without,
    with a prior) and class the slope and offset that make the logits of new queries probabilities.
    """

    sigma_factor: Tensor
    score_line: Tensor

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.config = config
        self.warp = BevWarp(*config.half_range, *config.picture_size, config.supersample)
        self.picture_net = PictureNet(config)
        self.segment = nn.Conv2d(config.fine_width, len(config.classes), 1)
        nn.init.constant_(self.segment.bias, -2.0)
        self.propose = ProposalHead(config)
        self.encode_prior = PriorEncoder(config)
        self.decoder = Decoder(config)
        self.pose = PoseHead()
        self.register_buffer("sigma_factor", torch.ones(len(config.classes), 2))
        line = torch.tensor([1.0, 0.0]).repeat(2, len(config.classes), 1)
        # Not kept with the weights: measured anew for every export.
        self.register_buffer("score_line", line, persistent=False)

    def predict(
        self,
        picture: Tensor,
        prior_points: Tensor,
        prior_class: Tensor,
        prior_mask: Tensor,
        prior_visible: Tensor | None = None,
    ) -> Prediction:
        """From a normalised picture (B, 4, H, W) and a prior; all layers, for the losses.

        ``prior_visible`` (B,) 0 hides the prior from the new queries (default: visible).
        """
        fine, coarse = self.picture_net(picture)
        new, dense = self.propose(coarse)
        prior = self.encode_prior(prior_points, prior_class, prior_mask)
        if prior_visible is None:
            prior_visible = torch.ones_like(prior_mask[:, :1]).float().sum(1)
        count = new.points.shape[1]
        bias = attention_bias(count, prior_mask, prior_visible)
        queries: Queries = join(new, prior)
        layers = self.decoder(queries, fine, coarse, bias)
        return Prediction(layers, dense, self.segment(fine).float(), count)

    def answer(
        self, prediction: Prediction, prior_points: Tensor, prior_class: Tensor, prior_mask: Tensor
    ) -> Answer:
        """The last layer in metres and probabilities, rings closed, unused slots zero."""
        n, last = prediction.new_count, prediction.layers[-1]
        classes = len(self.config.classes)
        used = prior_mask.float()
        one_hot = F.one_hot(prior_class.clamp(0, classes - 1), classes).float()
        exists = last.logits[:, n:, classes].sigmoid() * used
        aided = (used.sum(dim=1) > 0).long()
        line = self.score_line[aided][:, None]  # (B, 1, C, 2)
        new_scores = (last.logits[:, :n, :classes] * line[..., 0] + line[..., 1]).sigmoid()
        scores = torch.cat([new_scores, one_hot * exists[..., None]], dim=1)
        best = torch.cat([new_scores.argmax(-1), prior_class.clamp(0, classes - 1)], dim=1)
        points = self._close(last.points, best)
        scale = last.log_scale.exp() * self._factor(best, n)
        estimate: PoseEstimate = self.pose(
            prior_points * used[..., None, None], points[:, n:], scale[:, n:], exists
        )
        return Answer(scores, points, laplace_sigma(scale), exists, *estimate)

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

    def forward(
        self,
        images: Tensor,
        ego_to_image: Tensor,
        prior_points: Tensor,
        prior_class: Tensor,
        prior_mask: Tensor,
    ) -> Answer:
        """The exported graph.

        ``images`` uint8 (B, N, H, W, 3); ``ego_to_image`` (B, N, 3, 4) of the frame whose road is
        z = 0; ``prior_points`` (B, P, V, 2) metres; ``prior_class`` int64 (B, P); ``prior_mask``
        (B, P), 1 = used. P must be at least 1 (an unused slot will do).
        """
        picture = normalize_picture(self.warp(images, ego_to_image))
        prior = (prior_points, prior_class, prior_mask)
        return self.answer(self.predict(picture, *prior), *prior)


def laplace_sigma(scale: Tensor) -> Tensor:
    """Standard deviation of a Laplace distribution of scale b: √2 · b, the only place."""
    return scale * 2.0**0.5
