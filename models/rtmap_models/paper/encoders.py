"""What stands in front of the decoder: any module that turns a batch into a bird's-eye map.

An encoder has ``encode(batch)`` → `Encoded`, for training, and a ``forward`` of plain tensors →
`Encoded`, for the exported graph. Two are here: calibrated cameras, and a semantic raster.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rtmap_cli.errors import BadInput
from rtmap_models.cameras import camera_features
from rtmap_models.config import PaperConfig
from rtmap_models.data.dataset import Batch
from rtmap_models.paper.lift import CameraLift
from rtmap_models.paper.resnet import ResNet, normalize_images
from rtmap_models.tiny.backbone import Residual, conv_block


class Encoded(NamedTuple):
    """``bev`` (B, width, rows, columns); ``image_classes`` (B, N, C, H / stride, W / stride)
    logits of what the images show, where an encoder reads images (training only)."""

    bev: Tensor
    image_classes: Tensor | None


class BevNet(nn.Module):
    """Residual blocks at half resolution between two convolutions: context for every cell."""

    def __init__(self, width: int, blocks: int):
        super().__init__()
        self.first = conv_block(width, width)
        self.down = Residual(width, width, 2)
        self.blocks = nn.Sequential(*(Residual(width, width) for _ in range(blocks)))
        self.last = conv_block(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, width, rows, columns), even numbers both → the same shape."""
        x = self.first(x)
        coarse = self.blocks(self.down(x))
        return self.last(x + F.interpolate(coarse, scale_factor=2.0, mode="nearest"))


class CameraEncoder(nn.Module):
    """ResNet, a pyramid neck with one output, the lift, the bird's-eye net."""

    def __init__(self, config: PaperConfig):
        super().__init__()
        width = config.image_width
        self.backbone = ResNet(config.backbone, config.backbone_norm, config.backbone_width)
        inputs = self.backbone.widths[-config.stages :]
        self.sides = nn.ModuleList(nn.Conv2d(n, width, 1) for n in inputs)
        self.mix = conv_block(width, width)
        self.classify = nn.Conv2d(width, len(config.classes), 1)
        nn.init.constant_(self.classify.bias, -2.0)
        self.lift = CameraLift(config)
        self.bev = BevNet(config.width, config.bev_blocks)

    def encode(self, batch: Batch) -> Encoded:
        """From a training batch; absent cameras do not reach the batch's statistics."""
        if batch.images is None or batch.ego_to_image is None:
            raise BadInput("frames", "they hold no camera images", "make them for this --config")
        return self(batch.images, batch.ego_to_image)

    def forward(self, images: Tensor, ego_to_image: Tensor) -> Encoded:
        """``images`` uint8 (B, N, H, W, 3), ``ego_to_image`` (B, N, 3, 4)."""
        features = camera_features(self._image_features, images, ego_to_image, self.training)
        return self._lifted(features, ego_to_image)

    def _image_features(self, images: Tensor) -> Tensor:
        """uint8 (M, H, W, 3) → (M, image_width, H / stride, W / stride)."""
        x = normalize_images(images).contiguous(memory_format=torch.channels_last)
        maps = self.backbone(x)[-len(self.sides) :]
        sides = [side(m) for side, m in zip(self.sides, maps, strict=True)]
        joined = sides[-1]
        for finer in reversed(sides[:-1]):
            joined = finer + F.interpolate(joined, scale_factor=2.0, mode="nearest")
        return self.mix(joined)

    def _lifted(self, features: Tensor, ego_to_image: Tensor) -> Encoded:
        shown = None
        if self.training:
            flat = self.classify(features.flatten(0, 1)).float()
            shown = flat.reshape(*features.shape[:2], *flat.shape[1:])
        return Encoded(self.bev(self.lift(features, ego_to_image)), shown)


class RasterEncoder(nn.Module):
    """A semantic raster of the surroundings takes the cameras' place: plain convolutions.

    Channels mean what the user trains them with: a probability or a one-hot value per semantic
    class, say. In a training batch the raster is its ``picture``, values 0 … 255.
    """

    def __init__(self, config: PaperConfig):
        super().__init__()
        self.stem = nn.Sequential(
            conv_block(config.raster_channels, config.width, 3, 2),
            Residual(config.width, config.width),
        )
        rows, columns = config.bev_size
        self.row = nn.Parameter(torch.randn(config.width, rows, 1) * 0.1)
        self.column = nn.Parameter(torch.randn(config.width, 1, columns) * 0.1)
        self.bev = BevNet(config.width, config.bev_blocks)

    def encode(self, batch: Batch) -> Encoded:
        """From the pictures of a training batch."""
        return self(batch.picture / 255.0)

    def forward(self, raster: Tensor) -> Encoded:
        """``raster`` float (B, raster_channels, 2 · rows, 2 · columns): rows go with +y, columns
        with +x, cells of ``cell_m``, values about 0 … 1."""
        features = self.stem(raster)
        # One sum of the features' own type: bfloat16 stays what it is, and goes back once.
        place = (self.row + self.column).to(features.dtype)
        return Encoded(self.bev(features + place), None)
