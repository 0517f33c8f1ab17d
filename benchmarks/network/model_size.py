"""Parameters and floating-point operations of every configuration, per frame.

    python -m benchmarks.network.model_size --cameras 7 --priors 20

Operations are those of the exported graph for one frame (2 per multiply-add, as
``torch.utils.flop_counter`` counts convolutions, matrix products and attention; sampling and
element-wise work are not in it). With ``--device`` the frames per second of torch in evaluation
mode are printed too, one frame at a time.
"""

from __future__ import annotations

import argparse
import time

import torch
from rtmap_models.architecture import build_network
from rtmap_models.config import CONFIGS, load_config
from rtmap_models.export.example import example_inputs
from torch.utils.flop_counter import FlopCounterMode


@torch.no_grad()
def measure(name: str, cameras: int, priors: int, device: str | None) -> dict[str, float]:
    """Millions of parameters, billions of operations, and frames per second on a device."""
    network = build_network(load_config(name)).eval()
    inputs = example_inputs(network.config, 1, cameras, priors)
    with FlopCounterMode(display=False) as counter:
        network(*inputs)
    out = {
        "parameters_M": sum(p.numel() for p in network.parameters()) / 1e6,
        "GFLOP": counter.get_total_flops() / 1e9,
    }
    if device is not None:
        network, inputs = network.to(device), tuple(x.to(device) for x in inputs)
        times = []
        for _ in range(30):
            start = time.perf_counter()
            float(network(*inputs).points.sum())  # waits for the device
            times.append(time.perf_counter() - start)
        out["frames_per_s"] = 1.0 / sorted(times[5:])[len(times[5:]) // 2]
    return out


def main() -> None:
    """One line per configuration."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", nargs="*", default=sorted(p.stem for p in CONFIGS.glob("*.toml")))
    parser.add_argument("--cameras", type=int, default=7)
    parser.add_argument("--priors", type=int, default=20)
    parser.add_argument("--device", help="also time torch on this device")
    a = parser.parse_args()
    for name in a.config:
        values = measure(name, a.cameras, a.priors, a.device)
        print(f"{name}: " + ", ".join(f"{k} {v:.2f}" for k, v in values.items()), flush=True)


if __name__ == "__main__":
    main()
