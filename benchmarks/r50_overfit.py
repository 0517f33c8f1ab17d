"""Does the paper's network hang together at its real size? Eight frames by heart, then its export.

    python benchmarks/r50_overfit.py --steps 300 --device cuda

Renders eight frames of simulated towns, trains on that one batch, prints loss and mAP on it with
and without a prior, writes the ONNX file and prints its parity with torch. A step of the full
configuration takes minutes on a CPU: there use few steps or ``--config rtmap-r18-small``. Needs the
extras ``train`` and ``simulate``.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from rtmap_models.architecture import build_network
from rtmap_models.config import load_config
from rtmap_models.data.dataset import Frames, collate, make_sample
from rtmap_models.data.generate import generate
from rtmap_models.data.samples import PriorNoise
from rtmap_models.export.onnx_file import export_onnx
from rtmap_models.training.validate import validate

FRAMES = 8
NOISE = PriorNoise(1.0, 1.0, 0.15, 0.15, 0.0)
PRIORS = ("none", "seen", "hidden", "seen")
"""The kinds of prior of the samples, in turn."""


def fit(network: torch.nn.Module, frames: Frames, a: argparse.Namespace) -> float:
    """Train on all frames at once; every step draws another prior. Returns seconds per step."""
    device = torch.device(a.device)
    optimizer = torch.optim.AdamW(network.parameters(), lr=a.rate, weight_decay=0.01)
    rng, start = np.random.default_rng(0), time.perf_counter()
    for step in range(a.steps):
        samples = [
            make_sample(frames[k], network.config, rng, NOISE, PRIORS[k % 4], train=False)
            for k in range(FRAMES)
        ]
        batch = collate(samples, network.config).to(device)
        rate = a.rate * min(1.0, (step + 1) / 20) * 0.5 * (1 + math.cos(math.pi * step / a.steps))
        for group in optimizer.param_groups:
            group["lr"] = rate
        parts = network.losses(batch, bf16=a.bf16)
        loss = torch.stack(list(parts.values())).sum()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 35.0)
        optimizer.step()
        if step % max(1, a.steps // 20) == 0 or step == a.steps - 1:
            named = " ".join(f"{k} {float(v.detach()):.3f}" for k, v in parts.items())
            print(f"step {step} loss {float(loss.detach()):.2f}: {named}", flush=True)
    return (time.perf_counter() - start) / a.steps


def main() -> None:
    """Fit, measure, export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="rtmap-r50")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rate", type=float, default=6e-4)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--bf16", action="store_true")
    parser.add_argument("--output", type=Path, help="keep the ONNX file here")
    a = parser.parse_args()
    torch.manual_seed(0)
    config = load_config(a.config)
    network = build_network(config).to(a.device).train()
    with tempfile.TemporaryDirectory() as folder:
        generate(config, Path(folder) / "frames", FRAMES, 7, 1, print)
        frames = Frames(Path(folder) / "frames", config)
        seconds = fit(network, frames, a)
        print(f"{seconds:.2f} s per step of {FRAMES} frames on {a.device}")
        network = network.cpu()
        for name, value in validate(network, frames).items():
            print(f"{name}: {value:.3f}")
        report = export_onnx(network, a.output or Path(folder) / "model.onnx", {})
        for row in report.rows:
            worst = ", ".join(f"{k} {v:.1e}" for k, v in row.differences.items())
            print(f"parity {row.provider} {row.size}: {worst}")


if __name__ == "__main__":
    main()
