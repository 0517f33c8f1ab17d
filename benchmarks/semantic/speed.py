"""How fast sweeps become a semantic raster: milliseconds of one core per sweep (time of the
process, so that a busy machine does not count), and how often slower peers are in the same run.

    python -m benchmarks.semantic.speed [--rounds 15] [--json]

Invented sweeps over a flat road with vehicles on it, invented masks; masks are decoded before. Two
cases: 48,000 points with six masks of 1936 × 1216 (360°), and a VLP-16's 28,800 points with two of
1920 × 1080. Measured is what `rtmap semantic-map` does per frame once files are decoded: ground and
obstacles parted, points projected, hidden ones left out, weighted, laid into the raster; the ego
window apart. Peers, doing the same but without the test for hidden points:

* numpy/OpenCV: cv2.projectPoints per camera on all points, a dictionary-free np.add.at into a dense
  raster of log-likelihoods;
* per point: a plain Python loop over points and cameras (on every 120th point, scaled up).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform
from rtmap_cli.logs.log import Camera
from rtmap_cli.logs.semantic import CLASSES, Window
from rtmap_cli.steps.semantic.evidence import Weighting
from rtmap_cli.steps.semantic.labels import IGNORE
from rtmap_cli.steps.semantic.observe import Sweep, semantic_points
from rtmap_cli.steps.semantic.project import View
from rtmap_cli.steps.semantic.raster import Raster

Array = NDArray[np.float64]

REACH, CELL = 40.0, 0.2
PART = 120
"""The loop over points sees every so manieth point."""


@dataclass(frozen=True)
class Case:
    """A sweep with the views of its cameras."""

    name: str
    sweep: Sweep
    views: list[View]


def camera(name: str, yaw: float, width: int, height: int, fov: float) -> Camera:
    """A level pinhole camera 1.6 m above the road, turned by ``yaw`` degrees."""
    focal = width / (2 * np.tan(np.radians(fov) / 2))
    k = np.array([[focal, 0, width / 2], [0, focal, height * 0.45], [0, 0, 1.0]])
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = (s, -c, 0), (0, 0, -1), (c, s, 0)
    pose[:3, 3] = (0.5, 0.0, 1.6)
    return Camera(name, width, height, k, pose)


def mask(rng: np.random.Generator, width: int, height: int) -> NDArray[np.uint8]:
    """Coarse patches of all classes below the horizon."""
    patches = rng.integers(0, len(CLASSES), (height // 32 + 1, width // 32 + 1))
    out = np.kron(patches, np.ones((32, 32))).astype(np.uint8)[:height, :width]
    out[: int(height * 0.45)] = IGNORE
    return np.ascontiguousarray(out)


def sweep(rng: np.random.Generator, count: int, rings: Array) -> Sweep:
    """``count`` points of a LiDAR 1.9 m above the road: ground, and what stands at 4 … 60 m."""
    turn = np.tile(np.linspace(0, 2 * np.pi, count // len(rings), endpoint=False), len(rings))
    rise = np.repeat(np.radians(rings), count // len(rings))
    wall = np.repeat(rng.uniform(4, 60, 90), 2)[(turn / (2 * np.pi) * 180).astype(int)]
    on_ground = np.where(rise < -0.005, -1.9 / np.tan(np.minimum(rise, -0.005)), np.inf)
    distance = np.minimum(on_ground, wall)
    z = np.where(on_ground < wall, 0.0, 1.9 + distance * np.tan(rise))
    xyz = np.stack([distance * np.cos(turn), distance * np.sin(turn), z], axis=-1)
    xyz += rng.normal(0, 0.02, xyz.shape)
    return Sweep(xyz.astype(np.float32), rng.uniform(0, 1, len(xyz)).astype(np.float32))


def cases() -> list[Case]:
    """The two cases."""
    rng = np.random.default_rng(0)
    six = [camera(f"c{k}", 60.0 * k, 1936, 1216, 70.0) for k in range(6)]
    two = [camera(f"f{k}", y, 1920, 1080, 75.0) for k, y in enumerate((12.0, -12.0))]
    return [
        Case(
            "48,000 points, six masks",
            sweep(rng, 48_000, np.linspace(-25, 3, 60)),
            [View(c, c.ego_SE3_camera, mask(rng, c.width, c.height)) for c in six],
        ),
        Case(
            "VLP-16 (28,800 points), two masks",
            sweep(rng, 28_800, np.arange(-15.0, 16.0, 2.0)),
            [View(c, c.ego_SE3_camera, mask(rng, c.width, c.height)) for c in two],
        ),
    ]


def ours(case: Case, raster: Raster, pose: Array, weighting: Weighting) -> int:
    """One frame of `rtmap semantic-map`; returns the number of its points."""
    points = semantic_points(case.sweep, case.views, 0.0, REACH, weighting)
    raster.add(transform(pose, points.xyz.astype(np.float64)), points.classes, points.weight)
    return len(points.xyz)


def peer(case: Case, dense: Array, pose: Array, weighting: Weighting) -> None:
    """The same with OpenCV's projection and np.add.at; nothing is left out as hidden."""
    import cv2

    xyz = case.sweep.xyz.astype(np.float64)
    classes = np.full(len(xyz), IGNORE, np.uint8)
    for view in case.views:
        inverse = invert(view.ego_SE3_camera)
        rotation, _ = cv2.Rodrigues(inverse[:3, :3])
        uv, _ = cv2.projectPoints(
            xyz, rotation, inverse[:3, 3], view.camera.intrinsics, np.zeros(5)
        )
        uv = np.round(uv[:, 0]).astype(np.int64)
        ahead = transform(inverse, xyz)[:, 2] > 0.5
        h, w = view.mask.shape
        seen = ahead & (uv >= 0).all(axis=1) & (uv[:, 0] < w) & (uv[:, 1] < h)
        classes[seen] = view.mask[uv[seen, 1], uv[seen, 0]]
    kept = (classes != IGNORE) & (np.hypot(xyz[:, 0], xyz[:, 1]) < REACH)
    logs = np.log(weighting.confusion)
    weight = 1 / (1 + (xyz[kept, :2] ** 2).sum(axis=1) / weighting.distance**2)
    ij = np.floor(transform(pose, xyz[kept])[:, :2] / CELL).astype(np.int64) + len(dense) // 2
    np.add.at(dense, (ij[:, 1], ij[:, 0]), weight[:, None] * logs.T[classes[kept]])


def loop(case: Case, dense: Array, pose: Array, weighting: Weighting) -> None:
    """Every `PART`-th point by a plain loop."""
    logs = np.log(weighting.confusion)
    inverses = [invert(v.ego_SE3_camera) for v in case.views]
    for point in case.sweep.xyz[::PART].astype(np.float64):
        if np.hypot(point[0], point[1]) > REACH:
            continue
        for view, inverse in zip(case.views, inverses, strict=True):
            local = inverse[:3, :3] @ point + inverse[:3, 3]
            if local[2] < 0.5:
                continue
            uv = view.camera.intrinsics @ (local / local[2])
            column, row = round(float(uv[0])), round(float(uv[1]))
            h, w = view.mask.shape
            if not (0 <= row < h and 0 <= column < w) or view.mask[row, column] == IGNORE:
                continue
            weight = 1 / (1 + (point[:2] @ point[:2]) / weighting.distance**2)
            x, y = (pose[:2, :3] @ point + pose[:2, 3]) / CELL + len(dense) // 2
            dense[int(y), int(x)] += weight * logs[:, view.mask[row, column]]
            break


def timed(work: Callable[[Array], object], rounds: int) -> float:
    """Median milliseconds of one core for ``work`` along a road; the first is not counted."""
    taken = []
    for k in range(rounds + 1):
        pose = se3_from_xyyaw(np.float64(1.5 * k), np.float64(0.3), np.float64(0.02 * k))  # type: ignore[arg-type]
        start = time.process_time()
        work(pose)
        taken.append((time.process_time() - start) * 1e3)
    return float(np.median(taken[1:]))


def measure(rounds: int) -> list[dict[str, Any]]:
    """One row per case."""
    weighting, window = Weighting(), Window(36.0, 18.0, CELL)
    out = []
    for case in cases():
        raster = Raster(CELL)
        dense = np.zeros((1024, 1024, len(CLASSES)))

        def one(pose: Array, case: Case = case, raster: Raster = raster) -> int:
            return ours(case, raster, pose, weighting)

        def cut(pose: Array, raster: Raster = raster) -> object:
            return raster.window(window, pose, weighting)

        def with_cv2(pose: Array, case: Case = case, dense: Array = dense) -> None:
            peer(case, dense, pose, weighting)

        def by_loop(pose: Array, case: Case = case, dense: Array = dense) -> None:
            loop(case, dense, pose, weighting)

        ms, cv2_ms = timed(one, rounds), timed(with_cv2, rounds)
        out.append(
            {
                "case": case.name,
                "points_of_the_ground": one(np.eye(4)),
                "ms": ms,
                "window_ms": timed(cut, rounds),
                "opencv_ms": cv2_ms,
                "opencv_ratio": cv2_ms / ms,
                "loop_ms": PART * (loop_ms := timed(by_loop, 2)),
                "loop_ratio": PART * loop_ms / ms,
            }
        )
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = measure(arguments.rounds)
    if arguments.json:
        print(json.dumps(rows))
        return
    for row in rows:
        print(
            f"{row['case']}: {row['ms']:.1f} ms a sweep ({1000 / row['ms']:.0f} Hz), "
            f"window {row['window_ms']:.1f} ms; OpenCV and np.add.at {row['opencv_ms']:.1f} ms "
            f"({row['opencv_ratio']:.1f} ×), loop {row['loop_ms']:.0f} ms "
            f"({row['loop_ratio']:.0f} ×)"
        )


if __name__ == "__main__":
    main()
