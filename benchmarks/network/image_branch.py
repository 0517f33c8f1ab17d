"""What the image-feature branch brings: tilt and mAP with and without it, from the same start.

    python -m benchmarks.network.image_branch --data DIR --frames 1200 --steps 300

Renders frames of procedural towns with their images (once), trains `rtmap-tiny` and
`rtmap-tiny-images` from the same weights, on the same frames in the same order, for the same
number of steps, and looks at towns that training did not see: levelled but for what levelling
leaves, and with cameras that lean by more against the road. Prints Markdown: root mean square of
the slopes of the road along / across, before and after the correction (thousandths; 17.5 are one
degree), and mAP without a prior. ``--variants`` also takes the branch apart. Needs the extras
``train`` and ``simulate``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rtmap_models.architecture import build_network
from rtmap_models.cameras import levelled
from rtmap_models.config import TinyConfig, load_config
from rtmap_models.data.dataset import Batch, Frames, collate, make_sample
from rtmap_models.data.generate import generate
from rtmap_models.data.samples import clip
from rtmap_models.training.checkpoint import load_network, start_from
from rtmap_models.training.recipe import load_recipe
from rtmap_models.training.train import TrainOptions, train

from rtmap_cli.steps.evaluate.maps.precision import Scorer

IMAGES = "rtmap-tiny-images"
VARIANTS: dict[str, dict[str, Any] | None] = {
    "start": None,
    "without": {"image_width": 0, "image_heights_m": (), "tilt_sigma": 0.0},
    "with": {},
    "features only": {"tilt_sigma": 0.0},
    "tilt only": {"image_heights_m": ()},
}
TRAIN_SEED, TEST_SEED = 70, 950
BATCH = 8
FLOOR = 0.02
"""Queries below this score are not looked at."""

Array = NDArray[np.float64]


def batches(frames: Frames, limit: int, lean: float) -> Iterator[tuple[Batch, list[Any]]]:
    """Evenly chosen frames without a prior, their cameras leaning by slopes of ``lean`` (σ) more;
    the pictures are warped from them."""
    config, rng = frames.config, np.random.default_rng(3)
    warp = build_network(config).warp
    chosen = np.unique(np.linspace(0, len(frames) - 1, limit).round().astype(int)).tolist()
    for start in range(0, len(chosen), BATCH):
        some = chosen[start : start + BATCH]
        samples = [make_sample(frames[k], config, rng, prior="none", train=False) for k in some]
        batch = collate(samples, config)
        assert batch.images is not None and batch.ego_to_image is not None
        assert batch.plane is not None
        more = torch.from_numpy(rng.normal(0.0, lean, (len(samples), 2))).float()
        cameras = levelled(batch.ego_to_image, more)
        plane = torch.cat([batch.plane[:, :2] - more, batch.plane[:, 2:]], dim=1)
        picture = warp(batch.images, cameras)
        yield replace(batch, picture=picture, ego_to_image=cameras, plane=plane), samples


@torch.no_grad()
def measure(network: Any, frames: Frames, limit: int, lean: float) -> tuple[Array, Array, float]:
    """Slopes (n, 2) of the road before and after the correction, and mAP without a prior."""
    config: TinyConfig = frames.config  # type: ignore[assignment]
    scorer, before, after = Scorer(config.classes, protocol="rtmap"), [], []
    for batch, samples in batches(frames, limit, lean):
        prediction = network.predict_batch(batch)
        assert batch.plane is not None
        slopes = batch.plane[:, :2]
        guess = torch.zeros_like(slopes)
        if prediction.tilts is not None:
            guess = prediction.tilts.slopes[0]
        before.append(slopes.numpy())
        after.append((slopes - guess).numpy())
        prior = (batch.prior_points, batch.prior_class, batch.prior_mask)
        answer = network.answer(prediction, *prior)
        for b, sample in enumerate(samples):
            scores, points = answer.scores[b].numpy(), answer.points[b].double().numpy()
            found = [
                (config.classes[s.argmax()], p, float(s.max()))
                for s, p in zip(scores, points, strict=True)
                if s.max() > FLOOR
            ]
            truth = clip(sample.scene, config, min_length=0.5)
            true = [
                (config.classes[c], p, 1.0)
                for p, c in zip(truth.points, truth.classes, strict=True)
            ]
            scorer.add(found, true)
    known = ~np.isnan(np.concatenate(before)).any(axis=1)
    return np.concatenate(before)[known], np.concatenate(after)[known], scorer.result().mAP


def row(name: str, network: Any, frames: Frames, limit: int, leans: tuple[float, ...]) -> str:
    """One line of the table: along / across before, after and mAP, for every lean."""
    cells = [name]
    for lean in leans:
        before, after, score = measure(network, frames, limit, lean)
        for slopes in (before, after):
            along, across = 1e3 * np.sqrt((slopes**2).mean(axis=0))
            cells.append(f"{along:.1f} / {across:.1f}")
        cells.append(f"{score:.3f}")
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Render (once), train the variants one after the other, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="frames and weights are kept here")
    parser.add_argument("--frames", type=int, default=1200)
    parser.add_argument("--test-frames", type=int, default=160)
    parser.add_argument("--init", default="rtmap-tiny", help="weights to start from")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rate", type=float, default=5e-4)
    parser.add_argument("--threads", type=int, default=1, help="processes")
    parser.add_argument("--lean", type=float, nargs="+", default=[0.0, 0.015], help="slopes, σ")
    parser.add_argument(
        "--variants", nargs="+", choices=list(VARIANTS), default=["start", "without", "with"]
    )
    a = parser.parse_args()
    base = load_config(IMAGES)
    assert isinstance(base, TinyConfig)
    generate(base, a.data / "train", a.frames, TRAIN_SEED, a.threads, print, per_town=12)
    generate(base, a.data / "test", a.test_frames, TEST_SEED, a.threads, print, per_town=8)
    test, leans = Frames(a.data / "test", base), tuple(a.lean)
    head = [f"{what}, leaning {n:g}" for n in leans for what in ("slopes", "left", "mAP")]
    print("| | " + " | ".join(head) + " |\n|---|" + "---|" * len(head), flush=True)
    settings = [f"rate={a.rate}", f"warmup={max(1, a.steps // 8)}", "average=0.99"]
    for name in a.variants:
        change, path = VARIANTS[name], a.data / f"{name.replace(' ', '-')}.pt"
        if change is None:
            network = build_network(base).eval()
            start_from(network, a.init, partial=True)
            print(row(name, network, test, a.test_frames, leans), flush=True)
            continue
        options = TrainOptions(
            data=(a.data / "train",),
            output=path,
            recipe=load_recipe(IMAGES, settings),
            steps=a.steps,
            init=a.init,
            init_partial=True,
            log_every=20,
            quiet=True,
        )
        train(replace(base, **change), options, workers=a.threads)
        network, _ = load_network(path)
        print(row(name, network, test, a.test_frames, leans), flush=True)


if __name__ == "__main__":
    main()
