"""What the paper's network says about a batch, for the losses and the measurements."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from rtmap_models.tiny.decoder import LayerOutput


class PaperPrediction(NamedTuple):
    """Every layer's output; queries are the new ones first, then the prior slots.

    ``poses`` (B, 3) per layer; the rest is there in training only: ``many`` the layers' outputs
    for the one-to-many queries, ``segmentation`` (B, C, rows, columns) logits of the bird's-eye
    map, ``image_classes`` (B, N, C, h, w) logits of the images.
    """

    layers: list[LayerOutput]
    new_count: int
    poses: list[Tensor]
    many: list[LayerOutput]
    segmentation: Tensor | None
    image_classes: Tensor | None
