"""What the default network hands to its losses."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from rtmap_models.tiny.decoder import LayerOutput
from rtmap_models.tiny.image_branch import Tilts
from rtmap_models.tiny.queries import DenseProposals


class Prediction(NamedTuple):
    """Everything that training needs; queries are the new ones first, then the prior slots."""

    layers: list[LayerOutput]
    proposals: DenseProposals
    segmentation: Tensor  # (B, C, H/2, W/2) logits
    field: Tensor  # (B, C, 2, H/2, W/2) metres to the nearest element of the class
    new_count: int
    tilts: Tilts | None = None  # with a tilt head, for its loss
