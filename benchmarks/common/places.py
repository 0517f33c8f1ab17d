"""Where the paper's benchmarks drive, and the figures that they share.

Places are the maps of three Argoverse 2 logs (RTMAP_DATA) or, without them, simulated towns.
Drives and observations are simulated in both.
"""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.cli import run as rtmap
from rtmap_cli.formats.av2.vector_map import read_av2_archive, vector_map_of
from rtmap_cli.logs.run import OUTDATED, Run
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import CLASSES, VectorMap
from rtmap_cli.steps.evaluate.maps.precision import MapScore, Scorer
from rtmap_cli.steps.evaluate.poses import PoseScore, pool_poses
from rtmap_cli.steps.simulate.driving.drive import linked
from rtmap_cli.steps.simulate.driving.drives import Drive, drive_over_route, with_traffic
from rtmap_cli.steps.simulate.driving.routes import Lane, corridor, find_routes, lanes_of_av2
from rtmap_cli.steps.simulate.perceiving.observations import observe
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import PRESETS, Preset
from rtmap_cli.steps.simulate.towns.town import make_town

Array = NDArray[np.float64]

LOGS = ("7fab2350", "adcf7d18", "3bffdcff")
TOWNS = (700, 701, 702)
BASELINE = {  # RTMap, Table 1, MapTRv2 rows: crossing, divider, boundary
    "straight": (31.7, 42.0, 37.3),
    "turning": (28.2, 31.6, 18.3),
}
ROUTE_LENGTH = 180.0


class Place:
    """A map with its lanes: where to drive, what is true, an index for crops."""

    def __init__(self, name: str, world: VectorMap, lanes: Sequence[Lane]) -> None:
        self.name, self.world, self.lanes = name, world, lanes
        self.index = MapIndex(world, join=True)
        self.classes = CLASSES

    @lru_cache  # noqa: B019 - a few places live as long as the process
    def corridor(self, kind: str, world_seed: int) -> list[Array]:
        """The routes of one world."""
        return corridor(find_routes(self.lanes, kind, ROUTE_LENGTH), world_seed)

    def drive(self, kind: str, key: DriveKey, spacing: float, rate: float) -> Drive:
        """A drive over a route of the world's corridor, a frame every ``spacing`` metres."""
        routes = self.corridor(kind, key.world_seed)
        route = routes[(key.seed + key.traversal) % len(routes)]
        return drive_over_route(self.name, self.world.crs, route, spacing, rate, 0.0, key)

    def observe(
        self,
        drive: Drive,
        kind: str | Preset,
        key: DriveKey,
        prior: VectorMap | None = None,
        world: VectorMap | None = None,
    ) -> Run:
        """What a network would report along a drive through the place (or a changed ``world``).

        ``kind`` is a preset or names one of the two of the paper.
        """
        preset = kind if isinstance(kind, Preset) else PRESETS[f"rtmap-{kind}"]
        name = f"{self.name}-w{key.world_seed}-s{key.seed}-t{key.traversal}"
        seen = with_traffic(drive, preset, key)
        return observe(world or self.world, seen, preset, key, name, prior)[0]


def av2_places(data: Path) -> list[Place]:
    """The three Argoverse 2 maps under ``data``; SystemExit when they are not there."""
    found = [sorted((data / "av2_sensor").glob(f"{name}-*")) for name in LOGS]
    if not all(found):
        sys.exit("sample data folder not found, set RTMAP_DATA")
    out = []
    for folders in found:
        archive = read_av2_archive(folders[0])
        out.append(Place(folders[0].name[:8], vector_map_of(archive), lanes_of_av2(archive)))
    return out


def town_places(seeds: Sequence[int] = TOWNS) -> list[Place]:
    """Simulated towns."""
    towns = [(seed, make_town(seed)) for seed in seeds]
    return [Place(f"town-{seed}", t.vector_map, linked(t.lanes)) for seed, t in towns]


def add_frames(
    scorer: Scorer, run: Run, poses: Array, index: MapIndex, rows: Iterable[int] | None = None
) -> None:
    """Score frames of a run (default: all) against the world cropped at the true poses."""
    o = run.observations
    for row in range(len(poses)) if rows is None else rows:
        pose = poses[row]
        found = np.flatnonzero((o.frame == row) & (o.state != OUTDATED))
        pred = [(str(o.class_name[k]), o.points[k], float(o.score[k])) for k in found]
        scorer.add(pred, [(e.class_name, e.points, 1.0) for e in index.crop(pose)])


def shared_frames(paths: Sequence[Array], near: float = 10.0) -> list[NDArray[np.bool_]]:
    """Per drive, which frames lie within ``near`` metres of the path of every drive."""
    trees = [cKDTree(path[:, :2, 3]) for path in paths]
    return [
        np.all([tree.query(path[:, :2, 3])[0] <= near for tree in trees], axis=0) for path in paths
    ]


def command(*arguments: object) -> str:
    """Run one rtmap command and return its stdout; what it says on failure ends the benchmark."""
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = rtmap([str(a) for a in arguments])
    if code not in (0, 4):
        sys.exit(f"rtmap {' '.join(map(str, arguments))}: exit {code}\n{said.getvalue()}")
    return out.getvalue()


def percent(score: MapScore) -> dict[str, float]:
    """AP by class and mAP in %."""
    values = {name: c.mean for name, c in score.classes.items()} | {"mAP": score.mAP}
    return {name: 100 * v for name, v in values.items()}


def pose_summary(parts: Sequence[PoseScore]) -> dict[str, float]:
    """Mean and 90th percentile errors over all frames, and how honest their covariances are."""
    result = pool_poses(list(parts)).as_json()
    names, frames = ("lateral_m", "longitudinal_m", "yaw_deg"), result["all_frames"]
    out = {f"{k}_{what}": round(frames[k][what], 3) for k in names for what in ("mean", "p90")}
    out["answered"] = result["share_answered"]
    inside = (result.get("consistency") or {}).get("inside", {})
    return out | {f"in_{k}": round(v["all"], 3) for k, v in inside.items()}


def mean_of(rows: Sequence[Any]) -> Any:
    """Mean of equally built nested dicts of numbers; None where no row has a number."""
    if isinstance(rows[0], dict):
        return {k: mean_of([r[k] for r in rows]) for k in rows[0]}
    known = [r for r in rows if r is not None]
    return float(np.mean(known)) if known else None
