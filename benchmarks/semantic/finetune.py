"""A vectoriser of semantic rasters taken from one sensor and place to another, before and after.

    python -m benchmarks.semantic.finetune --data DIR --tuned semantic-tiny
    python -m benchmarks.semantic.finetune --data DIR --frames 600 --steps 700

Tables 2 and 3 of the campus mapping paper (arXiv 2509.25542) on simulated domains: ``city`` (wide
streets, seven cameras, 32 rings, good masks) is where the model comes from, ``campus`` (narrow
streets, two front cameras, a VLP-16 at two frames a second, a coarse segmenter whose confusion
nobody measured) where it is taken to. Logs are made by ``simulate town``, ``simulate images`` and
``semantic-map`` over towns that no training saw, some of them on tours that come back to where they
were (loops), read by ``infer``, judged as ``evaluate map --range 60 30 --by scenario`` does, all
logs together. Without ``--tuned`` the model is fine-tuned here by ``train --init``. ``--factors``
also says what the gap is made of: the unadapted model on the city with one thing of the campus at
a time. Everything is simulated.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rtmap_models.architecture import build_network
from rtmap_models.config import SemanticConfig
from rtmap_models.data.samples import clip
from rtmap_models.data.shards import Frames
from rtmap_models.data.views import scene_at
from rtmap_models.semantic.domains import DOMAINS, LABEL_CLASSES, Domain
from rtmap_models.semantic.drives import town_rasters
from rtmap_models.semantic.frames import generate_drives
from rtmap_models.training.checkpoint import config_to_train, start_from
from rtmap_models.training.validate import detections_of, named, validate

from rtmap_cli.cli import run as rtmap
from rtmap_cli.errors import NoAnswer
from rtmap_cli.logs.semantic import CLASSES as RASTER_CLASSES
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.output import log, plain, table
from rtmap_cli.steps.evaluate.drives import read_drives
from rtmap_cli.steps.evaluate.maps.compare import Settings, compare_frames, label_frames, read_side
from rtmap_cli.steps.evaluate.maps.precision import MapScore, Scorer
from rtmap_cli.steps.infer import MapModel
from rtmap_cli.steps.simulate.sensing.ground_labels import LABELS

CLASSES = ("boundary", "divider", "ped_crossing")
"""In the paper's order."""
RANGE = (-30.0, -15.0, 30.0, 15.0)
SCENARIOS = ("straight", "intersection", "loop", "roundabout", "multi-lane")
PAPER = {  # Tab. 2: boundary, divider, crossing, mAP
    "city → city": (54.5, 50.5, 41.4, 48.8),
    "city → campus": (13.1, 13.5, 12.4, 13.0),
    "city + campus → campus": (65.9, 50.3, 54.5, 56.9),
}
PAPER_SCENARIOS = {  # Tab. 3: mAP after and before
    "straight": (60.08, 12.08),
    "intersection": (56.09, 14.40),
    "loop": (47.51, 5.82),
    "roundabout": (41.40, 5.02),
    "multi-lane": (87.89, 14.87),
}
FIRST_TOWN = 9100
FIRST_TOUR = 9200
FACTOR_TOWN = 9300
PRIOR_SEED = 9
"""Of the frames that are read with a prior: towns from 900,000 on."""


@dataclass(frozen=True)
class Made:
    """A test log with its rasters, and the map of the town it drove in."""

    log: Path
    town: Path


def call(*words: object) -> int:
    """Run a command of rtmap in this process."""
    return rtmap([str(w) for w in words])


def must(*words: object) -> None:
    """The same; stops the benchmark when the command fails."""
    if code := call(*words):
        sys.exit(f"rtmap {' '.join(map(str, words))}: exit {code}")


def segmenter_options(domain: Domain, folder: Path) -> tuple[str | Path, ...]:
    """What ``semantic-map`` is told of a domain's segmenter: its label list and, where somebody
    measured it, its confusion matrix."""
    labels, confusion = folder / "labels.json", folder / "confusion.json"
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, str]] = []
    for k, name in enumerate(LABELS):
        known = LABEL_CLASSES.get(k)
        called = "ignore" if known is None else domain.taken_for.get(known, known)
        rows.append({"name": name, "class": called})
    labels.write_text(json.dumps({"labels": rows}), encoding="utf-8")
    if not domain.measured:
        return "--labels", labels
    matrix = {"classes": list(RASTER_CLASSES), "matrix": domain.confusion().tolist()}
    confusion.write_text(json.dumps(matrix), encoding="utf-8")
    return "--labels", labels, "--confusion", confusion


def make_logs(
    data: Path, name: str, count: int, length: float, route: str | None = None
) -> list[Made]:
    """``count`` logs of a domain, each through a town of its own; those that are there are kept.
    Without ``route`` one in four is straight, the others turn."""
    domain = DOMAINS[name]
    segmenter = segmenter_options(domain, data / name)
    made: list[Made] = []
    seed = FIRST_TOUR if route == "tour" else FIRST_TOWN
    while len(made) < count:
        seed += 1
        one = Made(data / name / f"log-{seed}", data / name / f"town-{seed}")
        there = (one.log / "semantic" / "semantic.json").exists()
        way = route or ("turning", "straight")[seed % 4 == 0]
        if there or _make(one, domain, name, seed, (way, length), segmenter):
            made.append(one)
    return made


def _make(
    one: Made,
    domain: Domain,
    name: str,
    seed: int,
    way: tuple[str, float],
    segmenter: tuple[str | Path, ...],
) -> bool:
    """One log; False when the town has no route of the kind and length ``way``."""
    size = 300 if seed % 2 else 240
    rig = ("campus", "default")[name == "city"]
    must(
        "simulate", "town", "--seed", seed, "--size", size, "--style", domain.style,
        "-o", one.town, "--overwrite",
    )  # fmt: skip
    if call(
        "simulate", "images", "--map", one.town, "--log", "town:", "--seed", seed,
        "--world-seed", seed, "--route", way[0], "--length", way[1], "--spacing", domain.spacing,
        "--rig", rig, "--lidar", domain.lidar, "--masks", "--mask-errors", domain.errors,
        "--width", domain.width, "--quality", 40, "-q", "-o", one.log, "--overwrite",
    ):  # fmt: skip
        return False
    must(
        "semantic-map", one.log, *segmenter, "-o", one.log / "semantic", "-q", "--overwrite",
    )  # fmt: skip
    return True


def judge(logs: Iterable[Made], model: str, runs: Path) -> tuple[MapScore, dict[str, MapScore]]:
    """What a model reads of all logs together, and by scenario."""
    pooled = Scorer(CLASSES, protocol="rtmap")
    labels: dict[str, list[NDArray[np.bool_]]] = {}
    for one in logs:
        out = runs / one.log.name
        must("infer", one.log, "--model", model, "-o", out, "-q", "--overwrite", "--threads", 1)
        drives = read_drives(str(one.log))
        truth = read_side(one.town, False, drives)
        compared = compare_frames(
            read_side(out, True, drives), truth, drives, Settings(classes=CLASSES, range_m=RANGE)
        )
        for name in CLASSES:
            pooled.judged[name] += compared.scorer.judged[name]
        pooled.frames += compared.scorer.frames
        for name, mask in label_frames(compared.keys, drives, truth).items():  # type: ignore[arg-type]
            labels.setdefault(name, []).append(mask)
    by = {name: pooled.result(np.concatenate(labels[name])) for name in SCENARIOS}
    return pooled.result(), by


def fine_tune(data: Path, source: str, frames: int, steps: int) -> str:
    """``train --init`` on simulated frames of the campus; the exported model."""
    model, weights = data / "tuned.onnx", data / "tuned.pt"
    if not model.exists():
        must(
            "train", "-o", weights, "--init", source, "--data", data / "frames", "--frames", frames,
            "--domain", "campus", "--seed", 2, "--steps", steps, "--rate", 1e-3,
            "--set", "warmup=20", "--set", "average=0.97", "--threads", 1, "--overwrite",
        )  # fmt: skip
        must("export-model", weights, "-o", model)
    return str(model)


def factors() -> dict[str, Domain]:
    """The city with one thing of the campus at a time."""
    city, campus = DOMAINS["city"], DOMAINS["campus"]
    return {
        "city": city,
        "streets of the campus": replace(city, style=campus.style, hills=campus.hills),
        "two front cameras": replace(city, rig=campus.rig),
        "VLP-16, a frame every 4 m": replace(city, lidar=campus.lidar, spacing=campus.spacing),
        "the campus's segmenter, measured": replace(
            city, errors=campus.errors, taken_for=campus.taken_for
        ),
        "the campus's segmenter": replace(
            city, errors=campus.errors, taken_for=campus.taken_for, measured=campus.measured
        ),
        "campus, segmenter measured": replace(campus, measured=True),
        "campus": campus,
    }


def on_domain(model: MapModel, config: SemanticConfig, domain: Domain, towns: int) -> MapScore:
    """A model on rasters of so many towns of a domain, without going through logs."""
    scorer, seed = Scorer(CLASSES, protocol="rtmap"), FACTOR_TOWN
    empty = np.zeros((1, 1, config.vertex_count, 2), np.float32), np.zeros((1, 1), np.int64)
    while towns:
        seed += 1
        try:
            vector_map, frames = town_rasters(config, domain, seed, 3)
        except NoAnswer:
            continue
        towns -= 1
        index = MapIndex(vector_map, join=True)
        for seen in frames:
            out = model(seen.raster[None], *empty, np.zeros((1, 1), np.float32))
            scores, points = (out[k][0].astype(np.float64) for k in ("scores", "points"))
            pieces = clip(scene_at(index, seen.map_SE3_ego, config), config, min_length=0.5)
            truth = named(pieces.points, pieces.classes, config)
            scorer.add(detections_of(scores, points, config), truth)
    return scorer.result()


def with_prior(models: Iterable[str], data: Path, frames: int) -> list[list[str]]:
    """Rows of what models make of a wrong prior (`validate`), on rasters of other campus towns."""
    rows = []
    for model in models:
        config = config_to_train(None, model)
        assert isinstance(config, SemanticConfig)
        generate_drives(config, "campus", data / "prior-frames", frames, PRIOR_SEED, 1, log)
        network = build_network(config)
        start_from(network, model)
        found = validate(network, Frames(data / "prior-frames", config), frames)
        rows.append([Path(model).stem, str(frames), *(f"{found[k]:.3f}" for k in PRIOR_HEAD)])
    return rows


PRIOR_HEAD = ("mAP", "mAP prior", "mAP unchanged prior", "AUC existence")


def row(name: str, score: MapScore, paper: tuple[float, ...] | None = None) -> list[str]:
    """A row of Tab. 2: AP by class and mAP in per cent."""
    values = [*(score.classes[c].mean for c in CLASSES), score.mAP]
    beside = " / ".join(f"{v:.1f}" for v in paper) if paper else ""
    return [name, str(score.frames), *(f"{100 * v:.1f}" for v in values), beside]


HEAD = ("training → test", "frames", *(f"AP {c}" for c in CLASSES), "mAP", "paper (the same four)")


def show(head: Iterable[str], rows: list[list[str]], markdown: bool) -> None:
    """Print a table."""
    if markdown:
        cells = [list(head), ["---"] * len(list(head)), *rows]
        print("\n".join("| " + " | ".join(line) + " |" for line in cells))
    else:
        print("\n".join(table(list(head), rows)))
    print()


def scenario_rows(before: dict[str, MapScore], after: dict[str, MapScore]) -> list[list[str]]:
    """Tab. 3: each scenario, fine-tuned and (starred, as in the paper) unadapted."""
    rows = []
    for name in SCENARIOS:
        for mark, score, told in zip(
            ("", " *"), (after[name], before[name]), PAPER_SCENARIOS[name], strict=True
        ):
            if not score.frames:
                rows.append([name + mark, "0", *["–"] * 4, f"{told:.1f}"])
                continue
            values = [
                f"{100 * score.classes[c].mean:.1f}" if score.classes[c].num_gt else "–"
                for c in CLASSES
            ]
            rows.append(
                [name + mark, str(score.frames), *values, f"{100 * score.mAP:.1f}", f"{told:.1f}"]
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of logs and runs, kept")
    parser.add_argument("--source", default="semantic-tiny-city", help="the unadapted model")
    parser.add_argument("--tuned", help="a model that is fine-tuned already")
    parser.add_argument("--frames", type=int, default=600, help="of the campus, to fine-tune on")
    parser.add_argument("--steps", type=int, default=700, help="of fine-tuning")
    parser.add_argument("--logs", type=int, default=6, help="test logs of the campus")
    parser.add_argument("--city-logs", type=int, default=1, help="test logs of the city")
    parser.add_argument("--length", type=float, default=160.0, help="of a test drive, m")
    parser.add_argument("--tours", type=int, default=2, help="test logs that come back")
    parser.add_argument("--tour-length", type=float, default=600.0, help="of such a drive, m")
    parser.add_argument("--factors", type=int, default=0, metavar="TOWNS", help="also the factors")
    parser.add_argument("--prior-frames", type=int, default=0, help="also read with a prior")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--json", type=Path, help="write the figures")
    a = parser.parse_args()
    torch.set_num_threads(1)
    tuned = a.tuned or fine_tune(a.data, a.source, a.frames, a.steps)
    logs = make_logs(a.data, "campus", a.logs, a.length)
    logs += make_logs(a.data, "campus", a.tours, a.tour_length, "tour")
    before, by_before = judge(logs, a.source, a.data / "runs-before")
    after, by_after = judge(logs, tuned, a.data / "runs-after")
    scores = {"city → campus": before, "city + campus → campus": after}
    if a.city_logs:
        own = make_logs(a.data, "city", a.city_logs, a.length)
        scores = {
            "city → city": judge(own, a.source, a.data / "runs-city")[0],
            "city + campus → city": judge(own, tuned, a.data / "runs-city-after")[0],
            **scores,
        }
    print(f"simulated, range 60 × 30 m, Chamfer 0.5 / 1.0 / 1.5 m; {len(logs)} campus towns\n")
    show(HEAD, [row(name, s, PAPER.get(name)) for name, s in scores.items()], a.markdown)
    head = ("scenario (* unadapted)", *HEAD[1:-1], "paper")
    show(head, scenario_rows(by_before, by_after), a.markdown)
    figures: dict[str, Any] = {name: s.as_json() for name, s in scores.items()}
    figures |= {f"{n}, before": s.as_json() for n, s in by_before.items()}
    figures |= {f"{n}, after": s.as_json() for n, s in by_after.items()}
    if a.prior_frames:
        rows = with_prior((a.source, tuned), a.data, a.prior_frames)
        show(("model", "frames", *PRIOR_HEAD), rows, a.markdown)
        figures["prior"] = rows
    if a.factors:
        config = config_to_train(None, a.source)
        assert isinstance(config, SemanticConfig)
        model = MapModel(a.source, 1)
        found = {n: on_domain(model, config, d, a.factors) for n, d in factors().items()}
        show(("unadapted on", *HEAD[1:-1], ""), [row(n, s) for n, s in found.items()], a.markdown)
        figures["factors"] = {name: s.as_json() for name, s in found.items()}
    if a.json:
        a.json.write_text(json.dumps(plain(figures), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
