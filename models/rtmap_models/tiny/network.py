"""The whole network, top to bottom: cameras → picture → maps → hybrid queries → answer.

What follows the picture is shared by all networks of this kind (`PictureElements`): one decoder,
whatever made the picture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from rtmap_cli.errors import BadInput
from rtmap_models.answer import Answer, AnsweringNet
from rtmap_models.bev import BevWarp, normalize_picture
from rtmap_models.config import TinyConfig
from rtmap_models.tiny.backbone import PictureNet
from rtmap_models.tiny.criterion import LossWeights, compute_losses
from rtmap_models.tiny.decoder import Decoder, attention_bias
from rtmap_models.tiny.image_branch import ImageBranch
from rtmap_models.tiny.prediction import Prediction
from rtmap_models.tiny.queries import (
    FieldHead,
    PriorEncoder,
    ProposalHead,
    Queries,
    join,
)

if TYPE_CHECKING:
    from rtmap_models.data.dataset import Batch


class PictureElements(AnsweringNet):
    """From a normalised picture and a prior to elements, existence and pose."""

    config: TinyConfig

    def __init__(self, config: TinyConfig):
        super().__init__(config)
        self.picture_net = PictureNet(config)
        self.segment = nn.Conv2d(config.fine_width, len(config.classes), 1)
        nn.init.constant_(self.segment.bias, -2.0)
        self.field = FieldHead(config)
        self.propose = ProposalHead(config)
        self.encode_prior = PriorEncoder(config)
        self.decoder = Decoder(config)

    def predict(
        self,
        picture: Tensor,
        prior_points: Tensor,
        prior_class: Tensor,
        prior_mask: Tensor,
        prior_visible: Tensor | None = None,
        lifted: Tensor | None = None,
    ) -> Prediction:
        """From a normalised picture (B, K, H, W) and a prior; all layers, for the losses.

        ``prior_visible`` (B,) 0 hides the prior from the new queries (default: visible). ``lifted``
        is what an image branch adds to the coarse map.
        """
        fine, coarse = self.picture_net(picture, lifted)
        new, dense = self.propose(coarse)
        prior = self.encode_prior(prior_points, prior_class, prior_mask)
        if prior_visible is None:
            prior_visible = torch.ones_like(prior_mask[:, :1]).float().sum(1)
        count = new.points.shape[1]
        bias = attention_bias(count, prior_mask, prior_visible)
        queries: Queries = join(new, prior)
        drawn, field = self.segment(fine).float(), self.field(fine)
        # Elements must not bend the field: it learns from its own loss.
        looked = torch.cat([drawn[:, :, None], field], dim=2).detach().flatten(1, 2)
        layers = self.decoder(queries, fine, coarse, looked, bias)
        return Prediction(layers, dense, drawn, field, count)

    def losses(self, batch: Batch, bf16: bool = False) -> dict[str, Tensor]:
        """The weighted parts of the loss by name; their sum is the loss."""
        return compute_losses(self.predict_batch(batch, bf16), batch, LossWeights())

    def predict_batch(self, batch: Batch, bf16: bool = False) -> Prediction:
        """All layers on a training batch; convolutions in bfloat16 where that is asked for."""
        raise NotImplementedError


class RTMapNet(PictureElements):
    """Images and prior in, elements, existence and pose out."""

    def __init__(self, config: TinyConfig):
        super().__init__(config)
        self.image_branch = ImageBranch(config) if config.needs_images else None
        self.warp = BevWarp(*config.half_range, *config.picture_size, config.supersample)

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
        lifted = None
        if self.image_branch is not None:
            ego_to_image, lifted = self.image_branch(images, ego_to_image)
        picture = normalize_picture(self.warp(images, ego_to_image))
        prior = (prior_points, prior_class, prior_mask)
        return self.answer(self.predict(picture, *prior, lifted=lifted), *prior)

    def predict_batch(self, batch: Batch, bf16: bool = False) -> Prediction:
        """All layers on a training batch; convolutions in bfloat16 where that is asked for."""
        prior = (batch.prior_points, batch.prior_class, batch.prior_mask, batch.prior_visible)
        with torch.autocast(batch.picture.device.type, torch.bfloat16, enabled=bf16):
            if self.image_branch is None:
                return self.predict(normalize_picture(batch.picture), *prior)
            if batch.images is None or batch.ego_to_image is None or batch.plane is None:
                raise BadInput("frames", "they hold no camera images", "make them anew")
            looked, tilts = self.image_branch.learn(batch.images, batch.ego_to_image, batch.plane)
            picture = self._warped(batch.images, looked.ego_to_image)
            return self.predict(picture, *prior, looked.coarse)._replace(tilts=tilts)

    @torch.no_grad()
    def _warped(self, images: Tensor, ego_to_image: Tensor) -> Tensor:
        """The normalised picture, as from disk: in whole numbers."""
        return normalize_picture(self.warp(images, ego_to_image).round())
