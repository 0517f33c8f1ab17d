"""Semantic rasters in, elements out: another encoder before the decoder of the default network.

The vectoriser of the campus mapping paper (arXiv 2509.25542, sec. 3.2) after SemVecNet: its first
stage is `rtmap semantic-map`, this is the second. Focal, point-to-point and edge direction losses
are those of `rtmap_models.tiny.criterion`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtmap_cli.logs.semantic import EVIDENCE
from rtmap_models.answer import Answer
from rtmap_models.config import SemanticConfig
from rtmap_models.semantic.picture import cropped, to_picture
from rtmap_models.tiny.network import PictureElements
from rtmap_models.tiny.prediction import Prediction

if TYPE_CHECKING:
    from rtmap_models.data.dataset import Batch

FIRST_LAYER = "picture_net.down2.0.weight"

LOOKS = {
    "road": (95, 95, 95),
    "crosswalk": (160, 160, 160),
    "marking": (205, 200, 170),
    "curb": (150, 150, 148),
    "sidewalk": (165, 160, 155),
    "terrain": (85, 110, 70),
}
"""RGB that a class of the ground has in a picture of cameras, about."""

QUALITY = 150.0
"""What the quality channel of such a picture holds where the ground is well seen."""


def normalize_raster(picture: Tensor) -> Tensor:
    """(B, K, rows, columns) in 0 … 255 → 0 … 1."""
    return picture / 255.0


class SemanticNet(PictureElements):
    """Raster and prior in, elements, existence and pose out."""

    config: SemanticConfig

    def forward(
        self, raster: Tensor, prior_points: Tensor, prior_class: Tensor, prior_mask: Tensor
    ) -> Answer:
        """The exported graph: ``raster`` uint8 (B, K, rows, columns) as `rtmap semantic-map` writes
        it, the prior as in `RTMapNet`."""
        picture = cropped(to_picture(raster.float(), self.config), self.config)
        prior = (prior_points, prior_class, prior_mask)
        return self.answer(self.predict(normalize_raster(picture), *prior), *prior)

    def predict_batch(self, batch: Batch, bf16: bool = False) -> Prediction:
        """All layers on a training batch; convolutions in bfloat16 where that is asked for."""
        prior = (batch.prior_points, batch.prior_class, batch.prior_mask, batch.prior_visible)
        with torch.autocast(batch.picture.device.type, torch.bfloat16, enabled=bf16):
            return self.predict(normalize_raster(batch.picture), *prior)

    def adopt(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The weights of a network that reads colours, made to read classes.

        Its first layer sees red, green, blue (``(c - 110) / 60``), quality and place; a class
        stands for its colour (`LOOKS`), evidence for quality. Other weights stay as they are.
        """
        out = dict(state)
        first, own = state.get(FIRST_LAYER), self.state_dict()[FIRST_LAYER]
        if first is None or first.shape == own.shape or first.shape[1] != 6:
            return out
        columns = []
        for plane in self.config.planes:
            if plane == EVIDENCE:
                columns.append(first[:, 3] * (QUALITY / 128.0))
                continue
            colour = (torch.tensor(LOOKS.get(plane, (110, 110, 110))) - 110.0) / 60.0
            columns.append(torch.einsum("okij,k->oij", first[:, :3], colour))
        out[FIRST_LAYER] = torch.cat([torch.stack(columns, dim=1), first[:, 4:]], dim=1)
        return out
