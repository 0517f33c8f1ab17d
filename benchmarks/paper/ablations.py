"""The paper's ablations on simulated frames: what each part of the training brings.

    python -m benchmarks.paper.ablations --data DIR --json FILE
    python -m benchmarks.paper.tables --tables 4 --ablations FILE

Trains the same small configuration of the paper's network for as many steps each, on the same
frames in the same order: in full, without L_pose, without L_nll, without the pre-attribution, and
in full once more with other first weights and another order, to see what chance does. The default
configuration reads the warped bird's-eye picture in place of the cameras, and all variants start
from one encoder that was taught to see elements: that learns within the hours of a core.
``--config rtmap-r18-small`` reads the cameras, for machines with a GPU.

Prints, on towns that training did not see, mAP without and with a prior, existence, and the pose
from starts of 1 m / 1° (15 % of the prior missing, 15 % false), beside the rows of the paper; and
how much every variant differs from the full one on the same frames, with 95 % intervals over towns.
The paper's figures are from real logs and far longer training: the sign of a difference is what can
be compared. What was trained in DIR is not trained again; an interrupted variant goes on where its
checkpoint stood. Needs the extras ``train`` and ``simulate``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rtmap_models.config import PaperConfig, load_config
from rtmap_models.data.dataset import Frames
from rtmap_models.data.generate import generate
from rtmap_models.training.checkpoint import load_network, load_resumable
from rtmap_models.training.recipe import load_recipe
from rtmap_models.training.train import TrainOptions, train

from benchmarks.paper import ablation_figures as measured
from benchmarks.paper.ablation_encoder import train_encoder
from benchmarks.paper.printing import ablation_tables
from rtmap_cli.tables import whole_file


@dataclass(frozen=True)
class Variant:
    """What of the configuration is changed, and the seed of weights and order."""

    changes: dict[str, Any] = field(default_factory=dict)
    seed: int = 0


FULL = "full"
VARIANTS = {
    FULL: Variant(),
    "without L_pose": Variant({"use_pose_loss": False}),
    "without L_nll": Variant({"use_nll": False}),
    "without pre-attribution": Variant({"pre_attribution": False}),
    "full, another seed": Variant(seed=1),
}
TRAIN_SEED, TEST_SEED = 1, 900
TEST_PER_TOWN = 8


def minutes_of(weights: Path) -> float:
    """CPU minutes that went into weights so far."""
    ledger = weights.with_suffix(".cpu.json")
    return float(json.loads(ledger.read_text(encoding="utf-8"))) if ledger.exists() else 0.0


@contextmanager
def timed(weights: Path) -> Iterator[None]:
    """Add the CPU time of the block, its processes included, to what went into weights."""
    before = sum(os.times()[:4])
    yield
    minutes = minutes_of(weights) + (sum(os.times()[:4]) - before) / 60
    weights.with_suffix(".cpu.json").write_text(json.dumps(minutes), encoding="utf-8")


def encoder_of(base: PaperConfig, options: argparse.Namespace) -> str | None:
    """The weights that every variant starts from; None where none are asked for or cameras read."""
    path: Path = options.data / "encoder.pt"
    if base.needs_images or not options.encoder_steps:
        return None
    if not path.exists():
        recipe = load_recipe(options.config, options.set)
        with timed(path):
            train_encoder(base, recipe, options.data / "train", path, options.encoder_steps)
    return str(path)


def trained(name: str, base: PaperConfig, start: str | None, options: argparse.Namespace) -> Path:
    """The weights of a variant, trained as far as they were not yet."""
    variant = VARIANTS[name]
    config = replace(base, **variant.changes)
    path: Path = options.data / f"{name.replace(' ', '-').replace(',', '')}.pt"
    resume = path if path.exists() else None
    if resume is not None and load_resumable(path, config)["step"] >= options.steps:
        return path
    request = TrainOptions(
        data=(options.data / "train",),
        output=path,
        recipe=load_recipe(options.config, options.set),
        steps=options.steps,
        seed=variant.seed,
        init=None if resume else start,
        init_partial=True,
        resume=resume,
        quiet=True,
    )
    with timed(path):
        result = train(config, request, device=options.device, workers=options.threads)
    if result["progress"] < 1.0:
        sys.exit(f"{name}: stopped at step {result['step']}; the same command goes on")
    return path


def read(weights: Path, test: Frames, drawn: Any) -> tuple[dict[str, Any], measured.Figures]:
    """The figures of a variant as JSON has them, and with the test towns drawn anew.

    They are kept beside the weights and read again when weights or test frames are others.
    """
    path = weights.with_suffix(".figures.json")
    if path.exists() and path.stat().st_mtime_ns >= weights.stat().st_mtime_ns:
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["frames"] == len(test) and kept["rows"] == len(drawn):
            return kept["row"], {name: np.array(v) for name, v in kept["drawn"].items()}
    readings = measured.read(load_network(weights)[0], test)
    found = measured.figures(readings, drawn)
    row = {
        "figures": {n: float(found[n][0]) for n in (*measured.MAP_FIGURES, measured.EXISTENCE)},
        "poses": {
            way: [error.mean(axis=0).tolist(), np.quantile(error, 0.9, axis=0).tolist()]
            for way, error in readings.poses.items()
        },
    }
    content = {"frames": len(test), "rows": len(drawn), "row": row}
    content["drawn"] = {name: values.tolist() for name, values in found.items()}
    with whole_file(path) as part:
        part.write_text(json.dumps(content), encoding="utf-8")
    return row, found


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="rtmap-raster-small")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--steps", type=int, default=2200, help="per variant")
    parser.add_argument("--encoder-steps", type=int, default=700, help="... all start from")
    parser.add_argument("--data", type=Path, required=True, help="frames and weights are kept here")
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--test-frames", type=int, default=384)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--threads", type=int, default=1, help="processes")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, help="write the figures for paper/tables.py")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Render (once), train the variants, print."""
    options = parse(arguments)
    base = load_config(options.config)
    assert isinstance(base, PaperConfig)
    generate(base, options.data / "train", options.frames, TRAIN_SEED, options.threads, print)
    generate(
        base, options.data / "test", options.test_frames, TEST_SEED, options.threads, print,
        per_town=TEST_PER_TOWN,
    )  # fmt: skip
    test = Frames(options.data / "test", base)
    drawn = measured.resampled(measured.towns_of(test))
    start = encoder_of(base, options)
    rows: dict[str, dict[str, Any]] = {}
    full: measured.Figures | None = None
    for name in options.only:
        weights = trained(name, base, start, options)
        row, found = read(weights, test, drawn)
        full = found if name == FULL else full
        rows[name] = row | {"cpu_minutes": round(minutes_of(weights), 1)}
        if full is not None and name != FULL:
            rows[name]["against full"] = measured.differences(found, full)
        print(f"{name}: {rows[name]['figures']}", flush=True)
    made = {
        "config": options.config,
        "steps": options.steps,
        "encoder steps": 0 if start is None else options.encoder_steps,
        "encoder CPU minutes": 0.0 if start is None else round(minutes_of(Path(start)), 1),
        "batch": load_recipe(options.config, options.set).batch,
        "frames": options.frames,
        "test frames": len(test),
        "test towns": len(test.order),
    }
    result = {"made": made, "variants": rows}
    if options.json:
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")
    print("\n".join(ablation_tables(result)))


if __name__ == "__main__":
    main()
