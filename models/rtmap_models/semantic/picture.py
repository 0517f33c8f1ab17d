"""From a raster as it is written to the picture that the network reads."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from rtmap_models.config import SemanticConfig
from rtmap_models.data.shards import window_size


def to_picture(raster: Tensor, config: SemanticConfig) -> Tensor:
    """(B, K, rows, columns) of rasters (float, 0 … 255) → (B, K, ·, ·) with the cells of the
    network, as wide as before (bilinear)."""
    size = window_size(config)
    return F.interpolate(raster, size=size, mode="bilinear", align_corners=False)


def cropped(picture: Tensor, config: SemanticConfig) -> Tensor:
    """The range (B, K, H, W) out of the wide picture."""
    rows, columns = config.picture_size
    left, top = (round(m / config.cell_m) for m in config.margin_m)
    return picture[:, :, top : top + rows, left : left + columns]


@torch.no_grad()
def wide_picture(raster: NDArray[np.uint8], config: SemanticConfig) -> NDArray[np.uint8]:
    """(·, ·, K) what a training frame keeps of one raster (K, rows, columns)."""
    picture = to_picture(torch.from_numpy(raster.astype(np.float32))[None], config)[0]
    return picture.round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
