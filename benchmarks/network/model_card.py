"""Every figure of a model's card: unseen towns, a real map, latency.

    python -m benchmarks.network.model_card models/rtmap_models/zoo/rtmap-tiny.onnx \\
        --av2 "$RTMAP_DATA"/av2_sensor/7fab2350-* "$RTMAP_DATA"/av2_sensor/adcf7d18-*

A log without calibration borrows the rig of the first. Real maps are drawn twice: flat, and with
their heights.

Needs the extras ``train`` and ``simulate`` (torch only because the frames come from the package
that trains). Images are rendered; the model runs in onnxruntime from images to answers.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rtmap_models.config import ModelConfig, load_config
from rtmap_models.data.samples import Pieces, Prior, PriorNoise, clip, make_prior
from scipy.stats import spearmanr

from benchmarks.network.scenes import RealMap, Shot, unseen_towns
from rtmap_cli.geometry.poses import se3_from_xyyaw, xyyaw_of
from rtmap_cli.maps.prior import on_prior
from rtmap_cli.steps.evaluate.maps.precision import Scorer
from rtmap_cli.steps.infer.duplicates import fade_duplicates
from rtmap_cli.steps.infer.model import MapModel

PRIORS: dict[str, PriorNoise | None] = {
    "without prior": None,
    "prior, 1 m / 1°": PriorNoise(1.0, 1.0, 0.0, 0.0, 0.0),
    "prior, 1 m / 1°, 15 % missing, 15 % false": PriorNoise(1.0, 1.0, 0.15, 0.15, 0.0),
    "prior, 2 m / 2°, 15 % missing, 15 % false": PriorNoise(2.0, 2.0, 0.15, 0.15, 0.0),
}


def detections(
    out: dict[str, NDArray[Any]], config: ModelConfig, floor: float = 0.02
) -> list[tuple[str, NDArray[np.float64], float]]:
    """Class, vertices and score of every query that says something, as ``rtmap infer`` reports."""
    scores, points = out["scores"][0], out["points"][0]
    best = scores.argmax(axis=1)
    count = len(scores) - len(out["prior_score"][0])
    scores = scores.copy()
    top = np.arange(count), best[:count]
    scores[top] = fade_duplicates(points[:count], best[:count], scores[top])
    answered = count + np.flatnonzero(out["prior_score"][0] >= 0.5)
    twice = on_prior(points[:count], best[:count], points[answered], best[answered])
    scores[:count][twice] = 0.0
    return [
        (config.classes[c], p.astype(np.float64), float(s[c]))
        for s, p, c in zip(scores, points, best, strict=True)
        if s[c] > floor
    ]


def run(
    model: MapModel, config: ModelConfig, shot: Shot, prior: Prior | None, looks: int = 1
) -> dict[str, Any]:
    """One frame through onnxruntime, levelled as ``rtmap infer`` does; with a prior asked ``looks``
    times, each time with the prior moved to the pose of the time before."""
    slots = max(1, len(prior.classes) if prior else 0)
    points = np.zeros((1, slots, config.vertex_count, 2), np.float32)
    class_id, mask = np.zeros((1, slots), np.int64), np.zeros((1, slots), np.float32)
    if prior is not None and len(prior.classes):
        points[0], class_id[0], mask[0] = prior.points, prior.classes, 1.0
    cameras = shot.cameras(None if prior is None else prior.delta)
    pose = np.eye(4)
    for look in range(looks):
        if look and prior is not None:
            points[0, : len(prior.points)] = _moved(prior.points, pose)
        out = model(shot.view.images[None], cameras[None], points, class_id, mask)
        pose = pose @ se3_from_xyyaw(*np.asarray(out["pose_delta"][0], np.float64))
    return out | {"pose_delta": xyyaw_of(pose)[None]}


def _moved(points: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (K, V, 2) as seen from a pose (4, 4) given in their frame."""
    moved: NDArray[np.float64] = (points - pose[:2, 3]) @ pose[:2, :2]
    return moved


def measure(
    model: MapModel,
    config: ModelConfig,
    shots: list[Shot],
    noise: PriorNoise | None,
    looks: int = 1,
) -> dict[str, Any]:
    """All figures of one set of frames with one kind of prior."""
    rng = np.random.default_rng(1)
    scorer, unchanged = (Scorer(config.classes, protocol="rtmap") for _ in range(2))
    exist: list[tuple[float, bool]] = []
    pose: list[NDArray[np.float64]] = []
    spread: list[NDArray[np.float64]] = []
    for shot in shots:
        view = shot.view
        truth = clip(view.scene, config, min_length=0.5)
        prior = None
        if noise is not None:
            prior = make_prior(view.scene, clip(view.scene, config), config, noise, rng)
        out = run(model, config, shot, prior, looks if prior else 1)
        true = _detections_of(truth.points, truth.classes, config)
        scorer.add(detections(out, config), true)
        if prior is None:
            spread.append(_errors_of_found(out, truth, config))
            continue
        unchanged.add(_detections_of(prior.points, prior.classes, config), true)
        exist += list(zip(out["prior_score"][0].tolist(), prior.real.tolist(), strict=False))
        sigma = np.sqrt(np.diag(out["pose_covariance"][0]))
        pose.append(np.stack([prior.delta, out["pose_delta"][0] - prior.delta, sigma]))
        spread.append(_errors_of_prior(out, prior))
    result: dict[str, Any] = {"map": scorer.result().as_json()} | _honesty(spread)
    result["best threshold"] = _best_threshold(scorer)
    if noise is not None:
        result["unchanged prior mAP"] = unchanged.result().mAP
        result["existence AUC"] = _auc(exist)
        result["pose"] = _pose_figures(np.array(pose))
    return result


def _best_threshold(scorer: Scorer) -> dict[str, float]:
    """The score at which F1 is highest (all classes together, 1 m), with precision and recall."""
    rankings = scorer.rankings().values()
    scores = np.concatenate([r.scores for r in rankings])
    hits = np.concatenate([r.hits[:, 1] for r in rankings])
    order = np.argsort(-scores, kind="stable")
    found = np.cumsum(hits[order])
    precision = found / np.arange(1, len(found) + 1)
    recall = found / max(1, sum(int(r.num_gt.sum()) for r in rankings))
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-9)
    k = int(f1.argmax())
    values = (scores[order][k], f1[k], precision[k], recall[k])
    return dict(zip(("score", "F1", "precision", "recall"), map(float, values), strict=True))


def _detections_of(
    points: NDArray[np.float64], classes: NDArray[np.int64], config: ModelConfig
) -> list[tuple[str, NDArray[np.float64], float]]:
    return [(config.classes[c], p, 1.0) for p, c in zip(points, classes, strict=True)]


def _errors_of_prior(out: dict[str, Any], prior: Prior) -> NDArray[np.float64]:
    """(n, 2): |error| and sigma of every coordinate of real prior slots."""
    n = out["scores"].shape[1] - out["prior_score"].shape[1]
    points, sigma = (out[k][0, n : n + len(prior.real)][prior.real] for k in ("points", "sigma"))
    return np.stack([np.abs(points - prior.target[prior.real]), sigma], axis=-1).reshape(-1, 2)


def _errors_of_found(
    out: dict[str, Any], truth: Pieces, config: ModelConfig
) -> NDArray[np.float64]:
    """(n, 2): error and sigma across the line of confident new elements near their truth."""
    parts = [np.zeros((0, 2))]
    scores = out["scores"][0]
    for p, sigma, s in zip(out["points"][0], out["sigma"][0], scores, strict=True):
        same = truth.points[truth.classes == s.argmax()]
        if s.max() < 0.4 or len(same) == 0:
            continue
        a, b = same[:, :-1], same[:, 1:]
        d = b - a
        t = ((p[:, None, None] - a) * d).sum(-1) / np.maximum((d * d).sum(-1), 1e-9)
        gap = a + np.clip(t, 0, 1)[..., None] * d - p[:, None, None]
        best = np.hypot(gap[..., 0], gap[..., 1]).min(axis=2).mean(axis=0).argmin()
        gap = gap[:, best]
        near = np.hypot(gap[..., 0], gap[..., 1]).argmin(axis=1)
        gap, along = gap[np.arange(len(p)), near], d[best][near]
        if np.hypot(gap[:, 0], gap[:, 1]).mean() > 1.5:
            continue
        unit = along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
        across = np.hypot(normal[:, 0] * sigma[:, 0], normal[:, 1] * sigma[:, 1])
        parts.append(np.stack([np.abs((gap * normal).sum(1)), across], axis=1))
    return np.concatenate(parts)


def _honesty(parts: list[NDArray[np.float64]]) -> dict[str, float]:
    """Rank correlation of sigma and error; shares within the 50 % and 90 % Laplace regions."""
    both = np.concatenate([*parts, np.zeros((0, 2))])
    if len(both) < 10:
        return {}
    error, scale = both[:, 0], both[:, 1] / np.sqrt(2)
    return {
        "mean error m": float(error.mean()),
        "sigma spearman": float(spearmanr(error, both[:, 1])[0]),
        "within 50 %": float((error < scale * np.log(2)).mean()),
        "within 90 %": float((error < scale * np.log(10)).mean()),
    }


def _auc(pairs: list[tuple[float, bool]]) -> float | None:
    score, real = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs], dtype=bool)
    if real.all() or not real.any():
        return None
    a, b = score[real][:, None], score[~real][None]
    return float(((a > b) + 0.5 * (a == b)).mean())


def _pose_figures(pose: NDArray[np.float64]) -> dict[str, list[float]]:
    """Longitudinal m, lateral m, yaw °: before, after, median after, shares within 50 % / 90 %."""
    unit = np.array([1.0, 1.0, np.degrees(1.0)])
    before, error, sigma = np.abs(pose[:, 0]), np.abs(pose[:, 1]), pose[:, 2]
    return {
        "start": (before.mean(0) * unit).tolist(),
        "mean": (error.mean(0) * unit).tolist(),
        "median": (np.median(error, axis=0) * unit).tolist(),
        "90th percentile": (np.quantile(error, 0.9, axis=0) * unit).tolist(),
        "within 50 %": (error < 0.6745 * sigma).mean(0).tolist(),
        "within 90 %": (error < 1.6449 * sigma).mean(0).tolist(),
    }


def latency(path: Path, config: ModelConfig, shot: Shot) -> dict[str, dict[str, float]]:
    """Milliseconds per frame, one frame at a time, by threads."""
    scene, noise = shot.view.scene, PriorNoise(1.0, 1.0, 0.0, 0.0, 0.0)
    prior = make_prior(scene, clip(scene, config), config, noise, np.random.default_rng(0))
    out = {}
    for threads in (1, 2):
        model, times = MapModel(str(path), threads), []
        for _ in range(40):
            start = time.perf_counter()
            run(model, config, shot, prior)
            times.append((time.perf_counter() - start) * 1e3)
        ms = np.array(times[5:])
        out[f"{threads} threads"] = {
            "median ms": float(np.median(ms)),
            "90th percentile ms": float(np.quantile(ms, 0.9)),
        }
    return out


def tables(report: dict[str, Any]) -> Iterator[str]:
    """The report as tables for people."""
    for name, part in report.items():
        if not isinstance(part, dict) or "frames" not in part:
            continue
        found = {k: v for k, v in part.items() if isinstance(v, dict)}
        yield f"\n### {name} ({part['frames']} frames)\n"
        head = "prior | mAP | crossing | divider | boundary | AUC | error | 50 % / 90 % | Spearman"
        yield f"| {head} |"
        yield "|---" * 9 + "|"
        for prior, r in found.items():
            classes = [
                f"{np.mean(list(c['ap'].values())):.3f}" for c in r["map"]["classes"].values()
            ]
            unchanged = f" ({r['unchanged prior mAP']:.3f})" if "pose" in r else ""
            auc = f"{r['existence AUC']:.3f}" if r.get("existence AUC") else "–"
            held = f"{r['within 50 %']:.0%} / {r['within 90 %']:.0%}"
            row = [prior, f"{r['map']['mAP']:.3f}{unchanged}", *classes, auc]
            row += [f"{r['mean error m']:.2f} m", held, f"{r['sigma spearman']:.2f}"]
            yield "| " + " | ".join(row) + " |"
        if not any("pose" in r for r in found.values()):
            continue
        yield "\n| pose, from | mean | median | 90th percentile | 50 % / 90 % hold (x; y; yaw) |"
        yield "|---" * 5 + "|"
        for prior, r in found.items():
            if "pose" not in r:
                continue
            pose = r["pose"]
            three = [
                "{:.2f} m, {:.2f} m, {:.2f}°".format(*pose[k])
                for k in ("start", "mean", "median", "90th percentile")
            ]
            held = "; ".join(
                f"{a:.0%} / {b:.0%}"
                for a, b in zip(pose["within 50 %"], pose["within 90 %"], strict=True)
            )
            yield (
                f"| {three[0]} ({prior.removeprefix('prior, ')}) | "
                + " | ".join([*three[1:], held])
                + " |"
            )
    for threads, r in report.get("latency", {}).items():
        yield f"\n{threads}: {r['median ms']:.0f} ms ({r['90th percentile ms']:.0f} ms)"


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--config", default="rtmap-tiny")
    parser.add_argument("--towns", type=int, default=40)
    parser.add_argument("--frames", type=int, default=6, help="per town")
    parser.add_argument("--av2", type=Path, nargs="+", default=[], help="logs with real maps")
    parser.add_argument("--markdown", action="store_true", help="tables instead of JSON")
    parser.add_argument("--no-level", action="store_true", help="cameras as calibrated")
    parser.add_argument("--priors", choices=("none", "all"), default="all")
    parser.add_argument("--looks", type=int, default=1, help="as in rtmap infer")
    parser.add_argument("--av2-frames", type=int, default=32, help="per log and kind of place")
    a = parser.parse_args()
    config, model = load_config(a.config), MapModel(str(a.model))
    sets = {"unseen towns": list(unseen_towns(config, a.towns, a.frames))}
    for ground in ("flat", "hills") if a.av2 else ():
        worlds = [RealMap(config, folder, a.av2[0], ground == "flat") for folder in a.av2]
        for kind in ("drive", "random_places"):
            shots = [shot for w in worlds for shot in getattr(w, kind)(a.av2_frames)]
            sets[f"{kind.replace('_', ' ')} over real maps, {ground}"] = shots
    report: dict[str, Any] = {"model": model.info.name, "sha256": model.info.sha256}
    if a.no_level:
        sets = {name: [replace(s, level=False) for s in shots] for name, shots in sets.items()}
    for name, views in sets.items():
        report[name] = {"frames": len(views)}
        for prior, noise in PRIORS.items():
            if noise is not None and a.priors == "none":
                continue
            report[name][prior] = measure(model, config, views, noise, a.looks)
    report["latency"] = latency(a.model, config, sets["unseen towns"][0])
    if a.markdown:
        print("\n".join(tables(report)))
    else:
        print(json.dumps(report, indent=1, default=float, ensure_ascii=False))


if __name__ == "__main__":
    main()
