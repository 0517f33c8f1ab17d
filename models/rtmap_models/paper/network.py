"""The whole network of the paper, top to bottom: encoder → hybrid queries → decoder → answer."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_models.answer import Answer, AnsweringNet, Layers
from rtmap_models.config import PaperConfig
from rtmap_models.data.dataset import Batch
from rtmap_models.paper.criterion import paper_losses
from rtmap_models.paper.decoder import LayerTokens, PaperDecoder
from rtmap_models.paper.encoders import CameraEncoder, Encoded, RasterEncoder
from rtmap_models.paper.pose import LearnedPose
from rtmap_models.paper.prediction import PaperPrediction
from rtmap_models.paper.queries import QueryEncoder
from rtmap_models.pose import PoseEstimate
from rtmap_models.tiny.decoder import attention_bias


class PaperNet(AnsweringNet):
    """Everything behind the encoder, and training; subclasses say what the graph's inputs are."""

    config: PaperConfig
    encoder: CameraEncoder | RasterEncoder

    def __init__(self, config: PaperConfig):
        super().__init__(config)
        self.encode_queries = QueryEncoder(config)
        self.decoder = PaperDecoder(config)
        self.learned_pose = LearnedPose(config)
        self.segment = nn.Conv2d(config.width, len(config.classes), 1)
        nn.init.constant_(self.segment.bias, -2.0)

    def decode(
        self,
        encoded: Encoded,
        prior_points: Tensor,
        prior_class: Tensor,
        prior_mask: Tensor,
        prior_visible: Tensor | None = None,
    ) -> PaperPrediction:
        """From a bird's-eye map and a prior; all layers, for the losses.

        ``prior_visible`` (B,) 0 hides the prior from the new queries (default: visible).
        """
        bev, config = encoded.bev, self.config
        queries = self.encode_queries(prior_points, prior_class, prior_mask)
        if prior_visible is None:
            prior_visible = torch.ones_like(prior_mask[:, :1]).float().sum(1)
        bias = attention_bias(config.new_queries, prior_mask, prior_visible)
        classes = len(config.classes)
        own = F.one_hot(prior_class.clamp(0, classes - 1), classes).float()
        values = self.decoder.values(bev)
        made: list[LayerTokens] = self.decoder(queries, values, bias, own)
        n = config.new_queries
        slots = queries.tokens[:, n:]
        poses = [self.learned_pose(slots, m.tokens[:, n:], prior_mask) for m in made]
        many: list[LayerTokens] = []
        if self.training and config.many_queries and config.many_weight:
            many = self.decoder(self.encode_queries.many(len(bev)), values, None, None)
        return PaperPrediction(
            [m.output for m in made],
            n,
            poses,
            [m.output for m in many],
            self.segment(bev).float() if self.training else None,
            encoded.image_classes,
        )

    def predict_batch(self, batch: Batch, bf16: bool = False) -> PaperPrediction:
        """The network on a training batch; convolutions and linear layers in bfloat16 if asked
        for. Coordinates stay float32."""
        device = batch.prior_points.device.type
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            encoded = self.encoder.encode(batch)
            return self.decode(
                encoded,
                batch.prior_points,
                batch.prior_class,
                batch.prior_mask,
                batch.prior_visible,
            )

    def losses(self, batch: Batch, bf16: bool = False) -> dict[str, Tensor]:
        """The weighted parts of the loss by name; their sum is the loss."""
        return paper_losses(self.predict_batch(batch, bf16), batch, self.config)

    def correction(self, prediction: Layers, estimate: PoseEstimate) -> Tensor:
        """The learned head's answer, where the configuration chooses it."""
        if self.config.pose == "least_squares":
            return estimate.delta
        assert isinstance(prediction, PaperPrediction)
        return prediction.poses[-1]


class CameraNet(PaperNet):
    """The paper's network: cameras and a prior in."""

    encoder: CameraEncoder

    def __init__(self, config: PaperConfig):
        super().__init__(config)
        self.encoder = CameraEncoder(config)

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
        prior = (prior_points, prior_class, prior_mask)
        return self.answer(self.decode(self.encoder(images, ego_to_image), *prior), *prior)


class RasterNet(PaperNet):
    """The same decoder behind a semantic raster."""

    encoder: RasterEncoder

    def __init__(self, config: PaperConfig):
        super().__init__(config)
        self.encoder = RasterEncoder(config)

    def forward(
        self, raster: Tensor, prior_points: Tensor, prior_class: Tensor, prior_mask: Tensor
    ) -> Answer:
        """``raster`` float (B, raster_channels, rows, columns) of the configuration's
        ``picture_size``, values about 0 … 1; the prior as in `CameraNet`."""
        prior = (prior_points, prior_class, prior_mask)
        return self.answer(self.decode(self.encoder(raster), *prior), *prior)


def build_paper_network(config: PaperConfig) -> PaperNet:
    """The network whose encoder the configuration names."""
    return RasterNet(config) if config.encoder == "raster" else CameraNet(config)
