"""What each part of the training recipe brings: one change at a time on a small budget.

    rtmap train -o w.pt --config benchmarks/recipe.toml --frames 3000 --data frames --seed 1
    rtmap train -o w.pt --config benchmarks/recipe.toml --frames 240 --data held-out --seed 90
    python -m benchmarks.network.recipe --data frames --held-out held-out --steps 250

Every variant starts fresh (or from ``--init``), sees the same frames in the same order and is
judged after the learning rate has fallen to zero, by the same held-out frames. One variant is the
recipe as it is with other first weights and another order: what chance does. Prints a table in
Markdown. So few steps show what makes learning faster, not what a long run ends with. Takes
variants · steps / (steps per second). ``recipe.toml`` is the default network on pictures of coarser
cells; the frames of ``paper/ablations.py`` serve it too.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
from pathlib import Path

FIGURES = ("mAP", "mAP prior", "mAP unchanged prior", "AUC existence")

ANOTHER = "as shipped, another seed"
VARIANTS: dict[str, list[str]] = {
    "as shipped": [],
    ANOTHER: [],
    "learning rate halved": ["rate=6e-4"],
    "learning rate doubled": ["rate=2.4e-3"],
    "no averaged weights": ["average=0.0"],
    "prior never hidden": ["augmentation.hidden=0.0"],
    "nothing varied": [
        "augmentation.still=1.0", "augmentation.mirror=false",
        "augmentation.contrast=0.0", "augmentation.brightness=0.0", "augmentation.tint=0.0",
    ],
}  # fmt: skip


def train(folder: Path, name: str, options: argparse.Namespace) -> tuple[dict[str, str], float]:
    """One run; returns its last figures on held-out frames and its CPU minutes."""
    weights, seed = folder / "weights.pt", options.seed + (name == ANOTHER)
    call = [sys.executable, "-m", "rtmap_cli", "train", "-o", str(weights), "-q", "--overwrite"]
    call += ["--config", options.config, "--data", str(options.data)]
    call += ["--validate", str(options.held_out), "--validate-frames", str(options.frames)]
    call += ["--validate-every", str(options.steps), "--steps", str(options.steps)]
    call += ["--threads", str(options.threads), "--seed", str(seed)]
    call += ["--init", str(options.init)] if options.init else []
    for setting in VARIANTS[name]:
        call += ["--set", setting]
    before = sum(os.times()[2:4])
    subprocess.run(call, check=True)
    minutes = (sum(os.times()[2:4]) - before) / 60
    with weights.with_suffix(".csv").open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row.get("mAP")]
    return rows[-1], minutes


def main() -> None:
    """Train the variants one after the other and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--held-out", type=Path, required=True)
    parser.add_argument("--config", default=str(Path(__file__).with_name("recipe.toml")))
    parser.add_argument("--init", help="weights or model to start from")
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--frames", type=int, default=120, help="held-out frames to look at")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    options = parser.parse_args()
    print(
        "| variant | "
        + " | ".join(FIGURES)
        + " | CPU minutes |\n|---|"
        + "---|" * (len(FIGURES) + 1),
        flush=True,
    )
    for name in options.only:
        with tempfile.TemporaryDirectory() as folder:
            figures, minutes = train(Path(folder), name, options)
        values = " | ".join(f"{float(figures[key]):.3f}" for key in FIGURES)
        print(f"| {name} | {values} | {minutes:.1f} |", flush=True)


if __name__ == "__main__":
    main()
