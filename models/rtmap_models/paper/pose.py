"""The learned pose head: an auxiliary task in every decoder layer, an answer if so configured."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rtmap_models.config import PaperConfig
from rtmap_models.tiny.decoder import BLOCKED

POSE_UNIT = (1.0, 1.0, 0.02)
"""Metres, metres and radians per unit of the head: all outputs are then of one size."""


class LearnedPose(nn.Module):
    """Prior-query features added to a layer's output → shared MLP → max-pool → pose correction.

    One head serves all layers. The maximum runs over all vertices of the used prior slots; an empty
    prior gives no correction.
    """

    unit: Tensor

    def __init__(self, config: PaperConfig):
        super().__init__()
        width = config.width
        self.shared = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.out = nn.Linear(width, 3)
        self.register_buffer("unit", torch.tensor(POSE_UNIT), persistent=False)

    def forward(self, prior: Tensor, tokens: Tensor, mask: Tensor) -> Tensor:
        """Prior queries and their tokens after a layer (B, P, V, D), mask (B, P) 1 = used.

        Returns (B, 3): dx, dy in metres, dyaw in radians; true map_SE3_ego = initial · SE2(delta).
        """
        used = mask.float()
        features = self.shared(prior + tokens).float()
        blocked = ((used - 1.0) * -BLOCKED)[..., None, None]
        pooled = (features + blocked).flatten(1, 2).amax(dim=1)
        some = used.amax(dim=1, keepdim=True)
        return self.out(pooled * some).float() * self.unit * some
