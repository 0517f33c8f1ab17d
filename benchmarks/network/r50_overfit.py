"""Does the paper's network hang together at its real size? Eight frames by heart, then its export.

    python -m benchmarks.network.r50_overfit --folder DIR --device cuda
    MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=16000000000 MALLOC_TOP_PAD_=67108864 \\
        python -m benchmarks.network.r50_overfit --folder DIR \\
        --images 96x160 --batch 2 --many-every 5 --bf16

Renders eight frames of a simulated town, learns them, prints loss and mAP on them with and without
a prior, writes the ONNX file and prints its parity with torch. What is only there against learning
by heart is off: dropout and weight decay. On a CPU everything but the backbone's pictures stays as
configured: ``--images`` makes these smaller, ``--batch`` takes fewer frames per step, and
``--many-every`` runs the one-to-many queries, most of the decoder's work, in every n-th step. The
variables of the second command keep freed memory for the next step. An interrupted run goes on
from the last checkpoint in DIR. Needs the extras ``train`` and ``simulate``.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rtmap_models.architecture import build_network
from rtmap_models.config import PaperConfig, load_config
from rtmap_models.data.dataset import Batch, Frames, collate, make_sample
from rtmap_models.data.generate import generate
from rtmap_models.data.samples import PriorNoise
from rtmap_models.export.onnx_file import export_onnx
from rtmap_models.training.validate import validate

FRAMES = 8
NOISE = PriorNoise(1.0, 1.0, 0.15, 0.15, 0.0)
KINDS = ("hidden", "hidden", "seen")
"""How often the new queries see the prior: a hidden one makes them find everything."""

WARMUP = 20
SETTLED = 0.7
"""From here on batch statistics stand still: what is measured in the end is what was trained."""


def batch_at(step: int, frames: Frames, size: int) -> Batch:
    """The frames of a step, in a new order each round, each with a new prior."""
    per_round = FRAMES // size
    order = np.random.default_rng([1, step // per_round]).permutation(FRAMES)
    first = step % per_round * size
    rng = np.random.default_rng([2, step])
    kinds = [KINDS[rng.integers(len(KINDS))] for _ in range(size)]
    chosen = order[first : first + size]
    samples = [
        make_sample(frames[int(k)], frames.config, rng, NOISE, kind, train=False)
        for k, kind in zip(chosen, kinds, strict=True)
    ]
    return collate(samples, frames.config)


def stand_still(network: torch.nn.Module) -> None:
    """Batch normalisation keeps its statistics from here on."""
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.eval()


def fit(network: Any, frames: Frames, a: argparse.Namespace) -> None:
    """Learn the frames, from the last checkpoint if there is one."""
    path, config = a.folder / "checkpoint.pt", network.config
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=a.rate, weight_decay=0.0, betas=(0.9, 0.98), fused=True
    )
    first = 0
    if path.exists():
        saved = torch.load(path, weights_only=True, map_location=a.device)
        network.load_state_dict(saved["network"])
        optimizer.load_state_dict(saved["optimizer"])
        first = int(saved["step"])
    sums: dict[str, list[float]] = {}
    for step in range(first, a.steps):
        network.train()
        if step >= SETTLED * a.steps:
            stand_still(network)
        network.config = config if step % a.many_every == 0 else replace(config, many_weight=0.0)
        rate = a.rate * min(1.0, (step + 1) / WARMUP)
        rate *= 0.5 * (1 + math.cos(math.pi * step / a.steps))
        for group in optimizer.param_groups:
            group["lr"] = rate
        parts = network.losses(batch_at(step, frames, a.batch).to(a.device), bf16=a.bf16)
        optimizer.zero_grad()
        torch.stack(list(parts.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), a.clip)
        optimizer.step()
        for name, value in parts.items():
            sums.setdefault(name, []).append(float(value.detach()))
        if (step + 1) % a.log_every == 0 or step + 1 == a.steps:
            means = {name: float(np.mean(values)) for name, values in sums.items()}
            sums = {}
            named = " ".join(f"{name} {value:.3f}" for name, value in means.items())
            said = f"step {step + 1} loss {sum(means.values()):.2f}: {named}"
            print(f"{said} | {time.process_time():.0f} s of CPU", flush=True)
        if (step + 1) % a.save_every == 0 or step + 1 == a.steps:
            save(path, network, optimizer, step + 1)
    network.config = config


def save(path: Path, network: Any, optimizer: torch.optim.Optimizer, step: int) -> None:
    """Write the checkpoint whole or not at all."""
    content = {
        "network": network.state_dict(), "optimizer": optimizer.state_dict(), "step": step,
    }  # fmt: skip
    torch.save(content, path.with_suffix(".part"))
    path.with_suffix(".part").replace(path)


def export(network: Any, path: Path) -> None:
    """Write the ONNX file and print its parity."""
    report = export_onnx(network, path, {})
    size = "×".join(map(str, network.config.image_size))
    print(f"export, images of {size}: {path.stat().st_size / 1e6:.0f} MB")
    for row in report.rows:
        worst = ", ".join(f"{k} {v:.1e}" for k, v in row.differences.items())
        print(f"parity {row.provider} {row.size}: {worst}", flush=True)


def main() -> None:
    """Fit, measure, export: at the size of the images learnt from, and at the configured one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="rtmap-r50")
    parser.add_argument("--folder", type=Path, required=True, help="frames, checkpoint, model")
    parser.add_argument("--images", help="HxW instead of the configured size, multiples of 32")
    parser.add_argument("--batch", type=int, default=FRAMES, choices=(1, 2, 4, 8), help="frames")
    parser.add_argument("--many-every", type=int, default=1)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rate", type=float, default=6e-4)
    parser.add_argument("--clip", type=float, default=35.0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--bf16", action="store_true")
    parser.add_argument("--seed", type=int, default=7, help="of the town")
    parser.add_argument("--log-every", type=int, default=8)
    parser.add_argument("--save-every", type=int, default=40)
    a = parser.parse_args()
    torch.manual_seed(0)
    full = load_config(a.config)
    assert isinstance(full, PaperConfig)
    height, width = map(int, a.images.split("x")) if a.images else full.image_size
    config = replace(full, image_size=(height, width), dropout=0.0)
    a.folder.mkdir(parents=True, exist_ok=True)
    generate(config, a.folder / "frames", FRAMES, a.seed, 1, print)
    frames = Frames(a.folder / "frames", config)
    network = build_network(config).to(a.device, memory_format=torch.channels_last)
    fit(network, frames, a)
    network = network.cpu().eval()
    for name, value in validate(network, frames, FRAMES).items():
        print(f"{name}: {value:.3f}", flush=True)
    export(network, a.folder / "model.onnx")
    if config.image_size != full.image_size:
        large = build_network(full).eval()
        large.load_state_dict(network.state_dict())
        export(large, a.folder / "model-full.onnx")


if __name__ == "__main__":
    main()
