"""A straight street seen by simple drives: known answers for change detection and fusion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample
from rtmap_cli.geometry.poses import se3_from_xyyaw, transform
from rtmap_cli.logs.run import MATCHED, NEW, OUTDATED, Observations, Poses, Run, RunFrames, run_info
from rtmap_cli.logs.run_files import OCCLUDERS, write_run
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.visibility import hidden

Array = NDArray[np.float64]

CRS = "EPSG:32617"
ORIGIN = np.array([588000.0, 4480000.0])
RANGE = (-36.0, -18.0, 36.0, 18.0)
V = 20


def line(name: str, class_name: str, y: float, x0: float = -20.0, x1: float = 120.0) -> Element:
    """A line along the street, a vertex every 5 m."""
    x = np.linspace(x0, x1, int((x1 - x0) / 5) + 1)
    return Element(name, class_name, ORIGIN + np.stack([x, np.full_like(x, y)], axis=-1))


def crossing(name: str, x: float, width: float = 4.0, half: float = 6.0) -> Element:
    """A crossing over the whole street."""
    corners = [(x, -half), (x + width, -half), (x + width, half), (x, half), (x, -half)]
    return Element(name, "ped_crossing", ORIGIN + np.array(corners))


def street(*more: Element, without: Sequence[str] = ()) -> VectorMap:
    """Two boundaries, two dividers 3.5 m apart and two crossings."""
    elements = [
        line("left", "boundary", 7.0),
        line("right", "boundary", -7.0),
        line("middle", "divider", 0.0),
        line("lane", "divider", 3.5),
        crossing("west", 20.0),
        crossing("east", 80.0),
    ]
    return VectorMap([e for e in [*elements, *more] if e.element_id not in without], CRS)


def shifted(vector_map: VectorMap, dx: float, dy: float, sigma: float = 0.3) -> VectorMap:
    """The same map displaced, with stated sigmas."""
    out = []
    for e in vector_map:
        covariance = np.tile([sigma**2, 0, sigma**2, np.nan], (len(e.points), 1))
        out.append(e.with_points(e.points + [dx, dy, 0.0], covariance))
    return VectorMap(out, vector_map.crs)


def drive(
    world: VectorMap,
    run_id: str,
    seed: int = 0,
    noise: float = 0.1,
    prior: VectorMap | None = None,
    boxes: Array | None = None,
    localized: bool = True,
    y: float = -2.0,
    span: tuple[float, float] = (0.0, 100.0),
    crs: str = CRS,
    found: float = 0.85,
) -> Run:
    """One drive along the street: each visible element is found in ``found`` of the frames.

    ``boxes`` (k, 5) map-frame boxes relative to ORIGIN hide what stands behind them. With a
    ``prior`` what is in it comes as an answer to a prior query (matched or outdated) instead.
    """
    asked = set() if prior is None else {e.element_id for e in prior}
    rng = np.random.default_rng(seed)
    x = np.arange(span[0], span[1], 2.5)
    pose = se3_from_xyyaw(ORIGIN[0] + x, np.full(len(x), ORIGIN[1] + y), np.zeros(len(x)))
    drift = rng.normal(0, noise / 2, 2)
    rows: list[dict[str, object]] = []
    occluders: list[list[float]] = []
    for f in range(len(x)):
        local_boxes = np.zeros((0, 5)) if boxes is None else boxes.copy()
        if len(local_boxes):
            local_boxes[:, :2] += ORIGIN - pose[f, :2, 3]
            occluders += [[f, *b, 1.6, 0.0] for b in local_boxes.tolist()]
        seen = MapIndex(world).crop(pose[f], RANGE, min_length=4.0)
        names = {e.source.element_id: e for e in seen}
        for e in seen:
            middle = resample(e.points[:, :2], V)
            if hidden(middle, local_boxes).mean() > 0.3 or rng.random() > found:
                continue
            if e.source.element_id in asked:
                continue
            points = middle + rng.normal(0, noise, (V, 2)) * 0.7 + drift
            if e.class_name == "ped_crossing":
                points[-1] = points[0]
            rows.append(_row(f, e.class_name, points, noise, rng.uniform(0.6, 0.9)))
        if prior is not None:
            rows += _answers(f, prior, pose[f], set(names), local_boxes)
    return _run(run_id, pose, rows, occluders, localized, noise, crs)


def _row(f: int, name: str, points: Array, noise: float, score: float) -> dict[str, object]:
    return {
        "frame": f,
        "class_name": name,
        "points": points,
        "sigma": np.full((V, 2), noise),
        "score": score,
        "state": NEW,
        "existence": np.nan,
        "element_id": None,
        "prior": np.full((V, 2), np.nan),
    }


def _answers(
    f: int, prior: VectorMap, pose: Array, real: set[str], boxes: Array
) -> list[dict[str, object]]:
    """What a network with prior queries says about the elements of the prior in range."""
    out = []
    for e in MapIndex(prior).crop(pose, RANGE, min_length=4.0):
        local = resample(e.points[:, :2], V)
        if hidden(local, boxes).mean() > 0.3:
            continue
        exists = e.source.element_id in real
        row = _row(f, e.class_name, local, 0.2, 0.95 if exists else 0.05)
        row |= {
            "state": MATCHED if exists else OUTDATED,
            "existence": 0.95 if exists else 0.05,
            "element_id": e.source.element_id,
            "prior": transform(pose, local),
        }
        out.append(row)
    return out


def _run(
    run_id: str,
    pose: Array,
    rows: list[dict[str, object]],
    occluders: list[list[float]],
    localized: bool,
    noise: float,
    crs: str,
) -> Run:
    n = len(pose)
    start = 1_767_600_000_000_000_000 + sum(map(ord, run_id)) * 10**12
    times = start + np.arange(n, dtype=np.int64) * 500_000_000
    frames = RunFrames(
        np.arange(n, dtype=np.int32),
        times,
        pose,
        np.tile([0.5, 0.5, 0.01], (n, 1)),
        *(np.full((n, 3), np.nan) for _ in range(3)),
        np.full((n, 3, 3), np.nan),
        np.zeros(n, np.int32),
    )

    def column(name: str, dtype: object) -> NDArray:
        return np.array([r[name] for r in rows], dtype=dtype)

    observations = Observations(
        column("frame", np.int32),
        np.arange(len(rows), dtype=np.int32),
        column("state", np.int8),
        column("class_name", object),
        column("score", np.float32),
        column("existence", np.float32),
        column("element_id", object),
        np.stack([r["points"] for r in rows]).astype(np.float32),
        np.stack([r["sigma"] for r in rows]).astype(np.float32),
        np.stack([r["prior"] for r in rows]).astype(np.float64),
    )
    poses = None
    if localized:
        covariance = np.tile(np.diag([noise**2 / 4] * 2 + [0, 0, 0, 1e-6]), (n, 1, 1))
        poses = Poses(
            np.arange(n, dtype=np.int32),
            times,
            "test",
            pose,
            covariance,
            np.full((n, 3), np.nan),
            np.full((n, 3), np.nan),
            np.zeros(n, np.int32),
            np.zeros(n),
            np.array(["ok"] * n, object),
        )
    info = run_info(
        run_id,
        crs,
        ["ped_crossing", "divider", "boundary"],
        {"x": [RANGE[0], RANGE[2]], "y": [RANGE[1], RANGE[3]]},
        model_sha256="ab" * 32,
    )
    table = None
    if occluders:
        rows_array = np.array(occluders)
        names = OCCLUDERS.columns.names
        columns = {n: rows_array[:, k].astype(np.float32) for k, n in enumerate(names) if k}
        table = pa.table({"frame": rows_array[:, 0].astype(np.int32)} | columns)
    return Run(info, frames, observations, table, poses)


def save(run: Run, folder: Path) -> Path:
    """Write a run into a new folder."""
    folder.mkdir(parents=True)
    write_run(run, folder)
    return folder


def offset_across(element: Element, y: float) -> Array:
    """(n,) distances of the vertices from the line at ``y`` of the street."""
    return np.abs(element.xy[:, 1] - ORIGIN[1] - y)
