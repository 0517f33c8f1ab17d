"""A raster encoder that sees elements before a decoder is taught: what all ablations start from.

What the decoder reads would otherwise be noise for most of a small budget. As a backbone that
somebody brings, it is trained once, on the picture alone, and every variant starts from it: without
a prior, a query or any of the losses that the ablations take away.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from rtmap_models.config import PaperConfig
from rtmap_models.data.dataset import Batch, Frames, collate, make_sample
from rtmap_models.paper.network import build_paper_network
from rtmap_models.training.checkpoint import save_checkpoint
from rtmap_models.training.recipe import Recipe
from rtmap_models.training.trainer import learning_rate
from torch import Tensor, nn
from torch.nn import functional as F

BATCH = 8
POSITIVE = 4.0
"""Weight of cells with an element in the segmentation."""


def train_encoder(
    config: PaperConfig, recipe: Recipe, data: Path, output: Path, steps: int, log_every: int = 100
) -> None:
    """Teach the encoder of a network where elements are: their cells by class, and the way to the
    nearest one in metres. Writes encoder and segmentation head as ``--init-partial`` takes them."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    network = build_paper_network(config).to(memory_format=torch.channels_last).train()
    way = nn.Conv2d(config.width, 2 * len(config.classes), 1)
    parts = nn.ModuleList([network.encoder, network.segment, way])
    optimizer = torch.optim.AdamW(
        parts.parameters(), lr=recipe.rate, weight_decay=recipe.decay, betas=(0.9, 0.98)
    )
    frames, rng = Frames(data, config), np.random.default_rng(0)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(recipe, step, step / steps)
        chosen = rng.integers(len(frames), size=BATCH)
        how = recipe.augmentation
        samples = [
            make_sample(frames[int(k)], config, rng, prior="none", augmentation=how) for k in chosen
        ]
        batch = collate(samples, config)
        with torch.autocast("cpu", torch.bfloat16, enabled=recipe.precision == "bf16"):
            bev = network.encoder.encode(batch).bev
            logits, offsets = network.segment(bev).float(), way(bev).float()
        cells, metres = dense_losses(logits, offsets, batch)
        optimizer.zero_grad(set_to_none=True)
        (cells + metres).backward()
        nn.utils.clip_grad_norm_(parts.parameters(), recipe.clip)
        optimizer.step()
        if (step + 1) % log_every == 0:
            print(f"encoder, step {step + 1}: cells {cells:.3f}, metres {metres:.3f}", flush=True)
    kept = {
        name: value
        for name, value in network.state_dict().items()
        if name.startswith(("encoder.", "segment."))
    }
    save_checkpoint(output, config, {"average": kept, "footprint": frames.footprint().as_json()})


def dense_losses(logits: Tensor, offsets: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Cross-entropy of (B, C, h, w) cells, and the mean error (m) of (B, 2 C, h, w) offsets near
    the elements of each class."""
    cells = F.binary_cross_entropy_with_logits(
        logits, batch.segmentation.float(), pos_weight=torch.tensor(POSITIVE)
    )
    target = batch.field.flatten(1, 2)
    known = ~target.isnan()
    metres = ((offsets - target.nan_to_num()).abs() * known).sum() / known.sum().clamp(min=1)
    return cells, metres
