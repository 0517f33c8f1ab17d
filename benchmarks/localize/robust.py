"""How well does localization bear starts that are far off, and maps and networks that are wrong?

    python -m benchmarks.localize.robust                 on the Argoverse 2 maps (RTMAP_DATA)
    python -m benchmarks.localize.robust --towns         on simulated towns

Drives and detections are simulated (presets rtmap-straight and rtmap-turning), the prior has an
error of 0.1 m. Three questions, one JSON object per line each:

far      The initial poses of a drive are 10 m and 10° off (one direction per drive) and are
         searched for with `--search 14 14`: how many frames come within 2 m and 3° of the truth,
         how many are further than four of their stated sigmas off (wrong without saying so)?
lost     The same, 10 m off and with any heading.
spoilt   The prior gets outdated elements, 30 % of its number, moved copies of real ones beside
         them; the network false new ones, 20 % of its detections: half anywhere in range, half
         beside real ones, with the scores of the presets' false elements. By which factor do
         errors grow?
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.places import Place, av2_places, town_places
from rtmap_cli.geometry.poses import se3_from_xyyaw, wrap_angle, xyyaw_of
from rtmap_cli.logs.run import Observations, Poses, Run
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.localize.localize import localize
from rtmap_cli.steps.localize.relocate import Reach
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import PRESETS
from rtmap_cli.steps.simulate.worlds.degrade import degrade_map

Array = NDArray[np.float64]

KINDS = ("straight", "turning")
SPACING, RATE = 2.5, 2.0
PRIOR_SIGMA = 0.1
FAR_M, FAR_DEG, MORE = 10.0, 10.0, 4.0
"""How far off the start is, and how much further is searched (m, degrees)."""
FOUND_M, FOUND_DEG, SIGMAS = 2.0, 3.0, 4.0
OUTDATED, FALSE = 0.3, 0.2
BESIDE_M = (1.5, 6.0)


@dataclass(frozen=True)
class Case:
    """A simulated drive on a map."""

    place: Place
    run: Run
    prior: VectorMap
    true: Array
    rng: np.random.Generator


def cases(places: list[Place], kind: str, drives: int, seed: int) -> Iterator[Case]:
    """Every drive of every place."""
    for number, place in enumerate(places, start=1):
        prior = degrade_map(place.world, PRIOR_SIGMA, seed)
        for n in range(drives):
            key = DriveKey(0, seed, n)
            drive = place.drive(kind, key, SPACING, RATE)
            run = place.observe(drive, kind, key)
            yield Case(place, run, prior, drive.pose, np.random.default_rng([seed, number, n]))


def errors(poses: Poses, true: Array) -> Array:
    """(T, 3) lateral, longitudinal (m) and yaw (°) errors in the true ego frame."""
    at, truth = xyyaw_of(poses.pose), xyyaw_of(true)
    d, c, s = at - truth, np.cos(truth[:, 2]), np.sin(truth[:, 2])
    lateral, along = -s * d[:, 0] + c * d[:, 1], c * d[:, 0] + s * d[:, 1]
    return np.column_stack([lateral, along, np.degrees(wrap_angle(d[:, 2]))])


def displaced(run: Run, rng: np.random.Generator, turn: float) -> Run:
    """The run with initial poses ``FAR_M`` and ``turn`` (rad) off, the same for all frames."""
    way = rng.uniform(0.0, 2.0 * np.pi)
    at = xyyaw_of(run.frames.initial) + [FAR_M * np.cos(way), FAR_M * np.sin(way), turn]
    pose = se3_from_xyyaw(at[:, 0], at[:, 1], wrap_angle(at[:, 2]), run.frames.initial[:, 2, 3])
    return replace(run, frames=replace(run.frames, initial=pose))


def found(case: Case, turn: float, degrees: float, smooth: bool) -> dict[str, int]:
    """Counts of frames: all, found, further off than they say."""
    run = displaced(case.run, case.rng, turn)
    reach = Reach(FAR_M + MORE, np.radians(degrees))
    poses = localize(run, case.prior, smooth=smooth, search=reach)
    e = np.abs(errors(poses, case.true))
    off = np.hypot(e[:, 0], e[:, 1])
    good = (off < FOUND_M) & (e[:, 2] < FOUND_DEG)
    sigma = np.sqrt(np.linalg.eigvalsh(poses.covariance[:, :2, :2])[:, 1])
    return {
        "frames": len(e),
        "found": int(good.sum()),
        "wrong and sure of it": int((~good & (off > SIGMAS * sigma)).sum()),
    }


def outdated(prior: VectorMap, rng: np.random.Generator) -> VectorMap:
    """The prior with ``OUTDATED`` more elements that are not in the world."""
    real = list(prior)
    out = list(real)
    for k in rng.permutation(len(real))[: round(OUTDATED * len(real))]:
        points = real[k].points.copy()
        d = np.diff(points[:, :2], axis=0)[len(points) // 2 - 1]
        normal = np.array([-d[1], d[0]]) / max(float(np.hypot(*d)), 1e-9)
        points[:, :2] += normal * rng.uniform(*BESIDE_M) * rng.choice([-1, 1])
        out.append(replace(real[k], element_id=f"outdated-{k}", points=points))
    return VectorMap(out, prior.crs)


def with_false(run: Run, kind: str, rng: np.random.Generator) -> Run:
    """The run with ``FALSE`` more detections, of things that are not there."""
    o = run.observations
    pick = np.sort(rng.choice(len(o), round(FALSE * len(o)), replace=False))
    points = o.points[pick].astype(np.float64)
    centre = points.mean(axis=1)
    anywhere = rng.uniform([-30.0, -15.0], [30.0, 15.0], (len(pick), 2)) - centre
    side = rng.uniform(*BESIDE_M, len(pick)) * rng.choice([-1, 1], len(pick))
    beside = np.column_stack([np.zeros(len(pick)), side])
    move = np.where((rng.random(len(pick)) < 0.5)[:, None], anywhere, beside)
    mean, sd = PRESETS[f"rtmap-{kind}"].false_score
    score = 1.0 / (1.0 + np.exp(-rng.normal(mean, sd, len(pick))))
    more = _rows(o, pick) | {
        "points": (points + move[:, None]).astype(o.points.dtype),
        "score": score.astype(o.score.dtype),
    }
    every = {name: np.concatenate([getattr(o, name), value]) for name, value in more.items()}
    return replace(run, observations=replace(o, **every))


def _rows(o: Observations, rows: NDArray[np.int64]) -> dict[str, Any]:
    columns = {f.name: getattr(o, f.name) for f in fields(o)}
    return {k: v[rows] for k, v in columns.items() if isinstance(v, np.ndarray)}


def spoilt(case: Case, kind: str, smooth: bool) -> tuple[Array, Array]:
    """Absolute errors (T, 3) with the prior and detections as they are, and spoilt."""
    plain = localize(case.run, case.prior, smooth=smooth)
    run, prior = with_false(case.run, kind, case.rng), outdated(case.prior, case.rng)
    worse = localize(run, prior, smooth=smooth)
    return np.abs(errors(plain, case.true)), np.abs(errors(worse, case.true))


def measure(places: list[Place], kind: str, smooth: bool, a: argparse.Namespace) -> None:
    """Print the answers to the three questions."""
    told: dict[str, dict[str, int]] = {}
    parts = []
    for case in cases(places, kind, a.drives, a.seed):
        sign = float(case.rng.choice([-1, 1]))
        turns = {
            "far": (sign * np.radians(FAR_DEG), FAR_DEG + MORE),
            "lost": (case.rng.uniform(-np.pi, np.pi), 180.0),
        }
        for name, (turn, degrees) in turns.items():
            for what, count in found(case, turn, degrees, smooth).items():
                told.setdefault(name, {}).setdefault(what, 0)
                told[name][what] += count
        parts.append(spoilt(case, kind, smooth))
    row = {"kind": kind, "smooth": smooth}
    for name, counts in told.items():
        share = round(counts["found"] / counts["frames"], 4)
        print(json.dumps({"question": name, **row, **counts, "share found": share}), flush=True)
    plain, worse = (np.concatenate(p).mean(axis=0) for p in zip(*parts, strict=True))
    axes = ("lateral m", "longitudinal m", "yaw deg")
    print(json.dumps({
        "question": "spoilt", **row,
        "as it is": dict(zip(axes, plain.round(3).tolist(), strict=True)),
        "spoilt": dict(zip(axes, worse.round(3).tolist(), strict=True)),
        "growth": dict(zip(axes, (worse / plain - 1.0).round(3).tolist(), strict=True)),
    }), flush=True)  # fmt: skip


def parser_of(description: str) -> argparse.ArgumentParser:
    """The options that say where and how often to drive."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, default=os.environ.get("RTMAP_DATA"))
    parser.add_argument("--towns", action="store_true", help="simulated towns, not real maps")
    parser.add_argument("--drives", type=int, default=3, help="per map and kind")
    parser.add_argument("--seed", type=int, default=1)
    return parser


def places_of(a: argparse.Namespace) -> list[Place]:
    """The places that the options name; SystemExit when there are none."""
    if a.data is None and not a.towns:
        sys.exit("sample data folder not found, set RTMAP_DATA or pass --towns")
    return town_places() if a.towns else av2_places(Path(a.data))


def main() -> None:
    """Parse the command line."""
    parser = parser_of(__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    a = parser.parse_args()
    places = places_of(a)
    for kind in a.kinds:
        for smooth in (False, True):
            measure(places, kind, smooth, a)


if __name__ == "__main__":
    main()
