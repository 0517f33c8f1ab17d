"""Seconds to lift many vertices over a large cloud: `rtmap label lift`'s own steps, on one thread.

    python -m benchmarks.label.lift_speed [--vertices 100000] [--points 10000000]

The cloud is made of a wavy street grid with vehicles and bushes on and beside it; the heights are
known, so the error is printed too. Reading the tiles counts, writing the map does not.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.cloud import (
    CloudFolder,
    Trajectory,
    Voxels,
    write_info,
    write_tile,
    write_trajectory,
)
from rtmap_cli.maps.element import Element
from rtmap_cli.steps.label.lift.lift import lift

Array = NDArray[np.float64]

CRS = "EPSG:32632"
BASE = np.array([500_000.0, 5_400_000.0])
TILE = 50.0


def ground(xy: Array) -> Array:
    """Heights (n,) of the streets (m)."""
    x, y = (xy - BASE).T
    return np.asarray(8.0 * np.sin(x / 160.0) + 6.0 * np.cos(y / 120.0))


def made(folder: Path, points: int, rows: int, length: float) -> None:
    """A cloud of ``points`` along ``rows`` parallel streets 40 m apart, ``length`` m each."""
    rng = np.random.default_rng(3)
    (folder / "tiles").mkdir(parents=True)
    wide = rows * 40.0
    nx, ny = int(np.ceil(length / TILE)), int(np.ceil(wide / TILE))
    each = points // (nx * ny)
    for i in range(nx):
        for j in range(ny):
            xy = BASE + (i * TILE, j * TILE) + rng.random((each, 2)) * TILE
            z = ground(xy) + rng.normal(0, 0.02, each)
            # Boxes of vehicles and bushes hide a tenth of the ground.
            cell = np.floor(xy / 3.0).astype(np.int64)
            high = (cell[:, 0] * 7919 + cell[:, 1] * 104_729) % 10 == 0
            z[high] += rng.uniform(0.2, 1.8, int(high.sum()))
            tile = (int(BASE[0] / TILE) + i, int(BASE[1] / TILE) + j)
            one = np.ones(each)
            write_tile(
                Voxels(np.column_stack([xy, z]), 0.1 * one, one, one, 0.01 * one), folder, tile, CRS
            )
    at = np.arange(0.0, length, 2.0)
    path = [np.column_stack([at if k % 2 == 0 else at[::-1], np.full(len(at), 20.0 + 40.0 * k)])
            for k in range(rows)]  # fmt: skip
    xy = BASE + np.concatenate(path)
    z, n = ground(xy), len(xy)
    pose = se3_from_xyyaw(xy[:, 0], xy[:, 1], np.zeros(n), z)
    trajectory = Trajectory(
        np.arange(n, dtype=np.int32), np.arange(n) * 10**8, pose, np.zeros((n, 6, 6)), z,
        np.ones(n, bool), np.array(["ok"] * n, object), np.full((n, 3), np.nan),
    )  # fmt: skip
    write_trajectory(trajectory, folder, CRS)
    write_info(folder, {"crs": CRS, "voxel_m": 0.1, "tile_m": TILE})


def lines(vertices: int, rows: int, length: float) -> list[Element]:
    """Lines along the streets with so many vertices in all."""
    each = vertices // (4 * rows)
    out: list[Element] = []
    for k in range(rows):
        for side in (-6.0, -2.0, 2.0, 6.0):
            x = np.linspace(1.0, length - 1.0, each)
            xy = BASE + np.column_stack([x, np.full(each, 20.0 + 40.0 * k + side)])
            out.append(Element(f"line-{len(out)}", "divider", xy))
    return out


def main() -> None:
    """Print seconds and errors."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--vertices", type=int, default=100_000)
    parser.add_argument("--points", type=int, default=10_000_000)
    given = parser.parse_args()
    rows, length = 10, 1000.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "cloud"
        made(folder, given.points, rows, length)
        elements = lines(given.vertices, rows, length)
        clock, spent = time.perf_counter(), time.process_time()
        _, lifted = lift(elements, CloudFolder(folder))
        wall, cpu = time.perf_counter() - clock, time.process_time() - spent
    truth = ground(np.concatenate([e.xy for e in elements]))
    off = np.abs(lifted.z - truth)
    known = np.isfinite(off)
    print(
        f"{len(truth):,} vertices over {given.points:,} points: {cpu:.1f} s CPU, {wall:.1f} s; "
        f"{known.mean():.1%} lifted, error median {np.median(off[known]):.3f} m, "
        f"90 % {np.percentile(off[known], 90):.3f} m, sigma {np.nanmedian(lifted.sigma):.3f} m"
    )


if __name__ == "__main__":
    main()
