"""Small worlds with known answers for the tests of localization."""

from __future__ import annotations

import numpy as np

from rtmap_cli.geometry.polylines import resample
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, wrap_angle, xyyaw_of
from rtmap_cli.logs.run import MATCHED, NEW, Observations, Run, RunFrames, run_info
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import CLASSES, Element, VectorMap
from rtmap_cli.steps.localize.seeing.residuals import gram_sum

CRS = "EPSG:32632"
CENTRE = np.array([500_000.0, 5_300_000.0])
RANGE = {"x": [-36.0, 36.0], "y": [-18.0, 18.0]}


def _element(name: str, class_name: str, xy: np.ndarray, sigma: float) -> Element:
    points = np.column_stack([np.asarray(xy, float) + CENTRE, np.zeros(len(xy))])
    covariance = np.tile([sigma**2, 0.0, sigma**2, np.nan], (len(points), 1))
    return Element(name, class_name, points, covariance)


def town(sigma: float = 0.02) -> VectorMap:
    """A road that bends by 90 degrees (radius 60 m) with two dividers, kerbs and two crossings."""
    angle = np.linspace(-np.pi / 2, 0.0, 60)
    bend = np.stack([60.0 * np.cos(angle), 60.0 + 60.0 * np.sin(angle)], -1)
    outward = np.stack([np.cos(angle), np.sin(angle)], -1)
    before = np.stack([np.linspace(-80.0, -2.0, 40), np.zeros(40)], -1)
    middle, side = (
        np.concatenate([before, bend]),
        np.concatenate([np.tile([0, -1], (40, 1)), outward]),
    )
    lines = {"divider": (-1.9, 1.6), "boundary": (-5.4, 5.1)}
    elements = [
        _element(f"{name}-{k}", name, middle + offset * side, sigma)
        for name, offsets in lines.items()
        for k, offset in enumerate(offsets)
    ]
    for k, x in enumerate((-50.0, -12.0)):
        ring = np.array([[x, -5], [x + 4, -5], [x + 4, 5], [x, 5], [x, -5]], float)
        elements.append(_element(f"crossing-{k}", "ped_crossing", ring, sigma))
    return VectorMap(elements, CRS)


def straight_road(offsets: tuple[float, ...] = (-5.0, 0.0, 4.5)) -> VectorMap:
    """Endless parallel lines: nothing tells where along the road a vehicle stands."""
    x = np.linspace(-300.0, 300.0, 61)
    lines = [np.stack([x, np.full(61, y)], -1) for y in offsets]
    return VectorMap([_element(f"line-{k}", "divider", p, 0.02) for k, p in enumerate(lines)], CRS)


def drive(count: int = 12, bend: bool = True) -> np.ndarray:
    """(count, 4, 4) true poses every 5 m, into the bend, or straight ahead."""
    s = np.arange(count) * 5.0
    turn = np.maximum(s - 40.0, 0.0) / 60.0 if bend else np.zeros(count)
    x = np.minimum(s, 40.0) - 40.0 + 60.0 * np.sin(turn) if bend else s - 40.0
    y = 60.0 * (1.0 - np.cos(turn))
    return se3_from_xyyaw(x + CENTRE[0], y + CENTRE[1], turn, 3.0)


def observed(
    world: VectorMap, truth: np.ndarray, sigma: float = 0.02, matched: bool = False
) -> Observations:
    """What a perfect detector sees; ``matched`` adds the element that each detection is."""
    index = MapIndex(world)
    rows = [(t, e) for t, pose in enumerate(truth) for e in index.crop(pose) if len(e.points) > 1]
    n = len(rows)
    points = np.array([resample(e.points[:, :2], 20) for _, e in rows]).reshape(n, 20, 2)
    frame = np.array([t for t, _ in rows], np.int32)
    return Observations(
        frame=frame,
        query=np.arange(n, dtype=np.int32),
        state=np.full(n, MATCHED if matched else NEW, np.int8),
        class_name=np.array([e.class_name for _, e in rows], object),
        score=np.full(n, 0.9, np.float32),
        existence=np.full(n, 0.95 if matched else np.nan, np.float32),
        element_id=np.array([e.source.element_id if matched else None for _, e in rows], object),
        points=points.astype(np.float32),
        sigma=np.full((n, 20, 2), sigma, np.float32),
        prior_points=np.full((n, 20, 2), np.nan),
    )


def run_of(
    truth: np.ndarray,
    observations: Observations,
    start_error: tuple[float, float, float] = (0.5, -0.4, 0.02),
    noise: float = 0.0,
    seed: int = 0,
) -> Run:
    """A run that starts ``start_error`` (m, m, rad, map axes) off, with exact odometry."""
    rng = np.random.default_rng(seed)
    n = len(truth)
    planar = xyyaw_of(truth) + np.array(start_error)
    planar += noise * rng.normal(size=(n, 3)) * [1.0, 1.0, 0.02]
    initial = se3_from_xyyaw(planar[:, 0], planar[:, 1], wrap_angle(planar[:, 2]), truth[:, 2, 3])
    odometry = np.full((n, 3), np.nan)
    odometry[1:] = xyyaw_of(invert(truth[:-1]) @ truth[1:])
    frames = RunFrames(
        frame=np.arange(n, dtype=np.int32),
        timestamp_ns=np.arange(n, dtype=np.int64) * 500_000_000,
        initial=initial,
        sigma=np.tile([1.0, 1.0, 0.03], (n, 1)),
        odometry=odometry,
        odometry_sigma=np.where(np.isfinite(odometry), [0.05, 0.05, 0.004], np.nan),
        end_to_end=np.full((n, 3), np.nan),
        end_to_end_covariance=np.full((n, 3, 3), np.nan),
        camera_count=np.zeros(n, np.int32),
    )
    info = run_info("scene", CRS, list(CLASSES), RANGE)
    return Run(info, frames, observations)


def error_of(pose: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(T, 3) longitudinal, lateral (m) and yaw (rad) errors."""
    return xyyaw_of(invert(truth) @ pose)


def gram(columns: np.ndarray, weight: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Xᵀ C⁻¹ X (E, q, q) of every element by itself."""
    parts = zip(columns[:, None], weight[:, None], shared[:, None], strict=True)
    return np.stack([gram_sum(*part) for part in parts])
