"""The paper's ablations on simulated frames: what each part of the training brings.

    python benchmarks/paper_ablations.py --steps 2000 --data DIR

Trains the same small configuration of the paper's network four times for as many steps, on the same
frames in the same order: in full, without L_pose, without L_nll, without the pre-attribution.
Prints, on towns that training did not see, mAP, existence and the pose from starts of 1 m / 1°
(15 % of the prior missing, 15 % false), beside the rows of the paper. The paper's figures are from
real logs and far longer training: the order of the rows is what can be compared, and with one seed
only where they are far apart. What was trained in DIR is not trained again; an interrupted variant
goes on where its checkpoint stood. Needs the extras ``train`` and ``simulate``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rtmap_models.config import PaperConfig, load_config
from rtmap_models.data.dataset import Frames, collate, make_sample
from rtmap_models.data.generate import generate
from rtmap_models.training.checkpoint import load_network
from rtmap_models.training.recipe import load_recipe
from rtmap_models.training.train import TrainOptions, train
from rtmap_models.training.validate import CHANGED, validate

VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "without L_pose": {"use_pose_loss": False},
    "without L_nll": {"use_nll": False},
    "without pre-attribution": {"pre_attribution": False},
}

PAPER = """\
Paper, Tab. 4 (nuScenes; optimised pose; mean / 90 %: lateral m, longitudinal m, yaw °)
  full               .121/.257   .586/1.429   .368/.799
  without L_pose     .118/.242   .609/1.507   .376/.841   (its row "+ L_pts")
  without L_nll      .122/.261   .590/1.436   .371/.800   (its row "+ L_pose")
  without both       .122/.254   .618/1.510   .390/.840   (its base)
  regressed pose     .142/.306   .589/1.447   .521/1.091  (T_E; ours: "learned head")
Paper, Tab. 3 (TbV)
  all of Q_prior     .163/.318   .686/1.616   .332/.766
  only Q_map         .125/.256   .633/1.530   .317/.713
The paper has no row without pre-attribution."""

Array = NDArray[np.float64]
BATCH = 8


@torch.no_grad()
def pose_errors(network: Any, frames: Frames, limit: int) -> dict[str, Array]:
    """(n, 3) absolute errors of dx, dy (m) and dyaw (°) by the way the pose is found."""
    rng = np.random.default_rng(2)
    errors: dict[str, list[Array]] = {}
    for start in range(0, min(limit, len(frames)), BATCH):
        chosen = range(start, min(start + BATCH, limit, len(frames)))
        samples = [
            make_sample(frames[k], network.config, rng, CHANGED, "seen", train=False)
            for k in chosen
        ]
        batch = collate(samples, network.config)
        prediction = network.predict_batch(batch)
        prior = (batch.prior_points, batch.prior_class, batch.prior_mask)
        answer = network.answer(prediction, *prior)
        n = prediction.new_count
        points, scale = answer.points[:, n:], answer.sigma[:, n:]
        kept = (answer.prior_score >= 0.5).float()
        found = {
            "start": torch.zeros_like(batch.delta),
            "all of Q_prior": network.pose(prior[0], points, scale, batch.prior_mask).delta,
            "only Q_map": network.pose(prior[0], points, scale, kept).delta,
        }
        if network.config.use_pose_loss:
            found["learned head"] = prediction.poses[-1]
        for name, delta in found.items():
            off = (delta - batch.delta).abs().double().numpy() * [1.0, 1.0, np.degrees(1.0)]
            errors.setdefault(name, []).append(off)
    return {name: np.concatenate(parts) for name, parts in errors.items()}


def report(name: str, network: Any, frames: Frames, limit: int) -> dict[str, Any]:
    """Print the figures of one variant; mean and 90th percentile errors by way of the pose."""
    values = validate(network, frames, limit)
    shown = ("mAP", "mAP prior", "mAP unchanged prior", "AUC existence")
    print(f"{name}: " + ", ".join(f"{k} {values[k]:.3f}" for k in shown))
    out = {}
    for way, error in pose_errors(network, frames, limit).items():
        mean, high = error.mean(axis=0), np.quantile(error, 0.9, axis=0)
        cells = [f"{mean[k]:.3f}/{high[k]:.3f}" for k in (1, 0, 2)]
        print(f"  {way:<16} {'   '.join(cells)}", flush=True)
        out[way] = [mean.tolist(), high.tolist()]
    return out


def main() -> None:
    """Render (once), train four times, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="rtmap-r18-small")
    parser.add_argument("--steps", type=int, default=2000, help="per variant")
    parser.add_argument("--data", type=Path, required=True, help="frames and weights are kept here")
    parser.add_argument("--frames", type=int, default=4000)
    parser.add_argument("--test-frames", type=int, default=192)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--threads", type=int, default=1, help="processes")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, help="write the pose errors for paper_tables.py")
    a = parser.parse_args()
    base = load_config(a.config)
    assert isinstance(base, PaperConfig)
    generate(base, a.data / "train", a.frames, 1, a.threads, print)
    generate(base, a.data / "test", a.test_frames, 900, a.threads, print)
    test = Frames(a.data / "test", base)
    errors = {}
    for name in a.only:
        config = replace(base, **VARIANTS[name])
        path = a.data / f"{name.replace(' ', '-')}.pt"
        options = TrainOptions(
            data=(a.data / "train",),
            output=path,
            recipe=load_recipe(a.config),
            steps=a.steps,
            resume=path if path.exists() else None,
            quiet=True,
        )
        train(config, options, device=a.device, workers=a.threads)
        network, _ = load_network(path)
        errors[name] = report(name, network, test, a.test_frames)
    if a.json:
        a.json.write_text(json.dumps(errors, indent=1), encoding="utf-8")
    print("Columns of poses: lateral m, longitudinal m, yaw °; mean / 90 %.\n" + PAPER)


if __name__ == "__main__":
    main()
