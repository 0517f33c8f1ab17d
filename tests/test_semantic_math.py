"""The mathematics of semantic maps: projection, hiding, motion, evidence, raster."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from semantic_samples import ribbon_rig

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform
from rtmap_cli.logs.log import Camera, Frame
from rtmap_cli.logs.semantic import CLASSES, Window
from rtmap_cli.logs.sensor_times import ego_at
from rtmap_cli.steps.semantic.evidence import CONFUSION, Weighting
from rtmap_cli.steps.semantic.ground import split
from rtmap_cli.steps.semantic.labels import IGNORE, read_labels
from rtmap_cli.steps.semantic.project import View, label_points
from rtmap_cli.steps.semantic.raster import K, Raster
from rtmap_cli.steps.semantic.trajectory import initial_trajectory

ROAD, CROSSWALK, MARKING, CURB, SIDEWALK, TERRAIN = range(6)
NOTHING = np.zeros((0, 3), np.float32)


def frame(k: int, pose: np.ndarray, odometry: np.ndarray | None = None) -> Frame:
    return Frame(k, k * 500_000_000, pose, np.array([0.5, 0.5, 0.01]), odometry)


def drive(radius: float, step: float, n: int) -> tuple[list[Frame], np.ndarray]:
    """Frames on a circle with exact odometry, and the poses of 20 moments per step."""
    angle = np.arange((n - 1) * 20 + 1) / 20 * step / radius
    fine = se3_from_xyyaw(radius * np.sin(angle), radius * (1 - np.cos(angle)), angle)
    frames = []
    for k in range(n):
        move = None
        if k:
            m = invert(fine[20 * (k - 1)]) @ fine[20 * k]
            move = np.array([m[0, 3], m[1, 3], np.arctan2(m[1, 0], m[0, 0])])
        frames.append(frame(k, fine[20 * k], move))
    return frames, fine


@pytest.mark.parametrize("radius", [8.0, -8.0, 1e5])
def test_motion_between_frames_follows_the_circle(radius: float) -> None:
    frames, fine = drive(radius, 4.0, 4)
    for k, share in ((0, 0.1), (1, 0.5), (1, -0.25), (3, -0.3), (2, 0.95)):
        got = ego_at(frames, k, frames[k].timestamp_ns + round(share * 5e8))
        expected = invert(fine[20 * k]) @ fine[round(20 * (k + share))]
        np.testing.assert_allclose(got, expected, atol=1e-9)
    # Beyond the ends the nearest step goes on.
    beyond = ego_at(frames, 3, frames[3].timestamp_ns + 100_000_000)
    expected = invert(fine[0]) @ fine[4]
    np.testing.assert_allclose(beyond, expected, atol=1e-9)
    np.testing.assert_array_equal(ego_at(frames[:1], 0, 7), np.eye(4))


def test_rough_poses_are_smoothed_along_the_odometry() -> None:
    frames, _ = drive(200.0, 1.5, 120)
    rng = np.random.default_rng(3)
    true = np.stack([f.map_SE3_ego for f in frames])
    noisy = []
    for f in frames:
        pose = f.map_SE3_ego @ se3_from_xyyaw(*rng.normal(0, (0.6, 0.6, 0.01)))
        noisy.append(frame(f.index, pose, f.odometry))
    got, said = initial_trajectory(noisy)
    assert "smoothed" in said
    off = np.hypot(*(got - true)[:, :2, 3].T)
    rough = np.hypot(*(np.stack([f.map_SE3_ego for f in noisy]) - true)[:, :2, 3].T)
    assert off.mean() < 0.35 * rough.mean()
    # What makes lines straight: neighbours agree to centimetres.
    steps = invert(got[:-1]) @ got[1:]
    exact = invert(true[:-1]) @ true[1:]
    assert np.abs((steps - exact)[:, :2, 3]).max() < 0.05
    unknown, said = initial_trajectory([frame(k, f.map_SE3_ego) for k, f in enumerate(noisy)])
    assert said == "initial poses" and (unknown[5] == noisy[5].map_SE3_ego).all()


def camera(**terms: object) -> Camera:
    base = ribbon_rig().cameras[0]
    return Camera(base.name, 320, 200, base.intrinsics, base.ego_SE3_camera, **terms)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "terms",
    [
        {},
        {"distortion": (-0.3, 0.1, 0.0)},
        {"distortion": (0.1, 0.02, 0.0, -0.01), "model": "fisheye"},
    ],
)
def test_points_fall_on_the_pixel_that_the_camera_model_says(terms: dict[str, object]) -> None:
    cam = camera(**terms)
    rng = np.random.default_rng(1)
    mask = rng.integers(0, 6, (200, 320)).astype(np.uint8)
    points = rng.uniform((2, -6, 0), (25, 6, 0), (2000, 3)).astype(np.float32)
    local = transform(invert(cam.ego_SE3_camera), points.astype(np.float64))
    uv = cam.project(local)
    off = np.abs(uv - np.round(uv))  # single precision may tip what lies between two pixels
    sure = np.isfinite(uv).all(axis=1) & (off < 0.49).all(axis=1)
    uv = np.where(np.isfinite(uv), np.round(uv), -9).astype(int)
    inside = (uv[:, 0] >= 0) & (uv[:, 0] < 320) & (uv[:, 1] >= 0) & (uv[:, 1] < 200)
    expected = np.full(len(points), IGNORE)
    expected[inside] = mask[uv[inside, 1], uv[inside, 0]]
    got = label_points(points, NOTHING, [View(cam, cam.ego_SE3_camera, mask)])
    assert inside.sum() > 500
    np.testing.assert_array_equal(got[sure], expected[sure])


def test_coarser_masks_are_read_at_their_own_pixels() -> None:
    cam = camera()
    fine = np.random.default_rng(1).integers(0, 6, (100, 160)).astype(np.uint8)
    full = np.kron(fine, np.ones((2, 2), np.uint8))
    points = np.random.default_rng(2).uniform((2, -6, 0), (25, 6, 0), (900, 3)).astype(np.float32)
    a, b = (label_points(points, NOTHING, [View(cam, cam.ego_SE3_camera, m)]) for m in (fine, full))
    np.testing.assert_array_equal(a, b)


def test_ground_behind_an_obstacle_is_hidden_and_before_it_is_not() -> None:
    cam = camera()
    mask = np.full((200, 320), ROAD, np.uint8)
    x, y = np.meshgrid(np.arange(3.0, 25, 0.25), np.arange(-4.0, 4.1, 0.25))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1).astype(np.float32)
    # A wall 1.2 m high at x = 8, |y| < 1, in rings 0.3 m apart as a LiDAR sees it.
    wy, wz = np.meshgrid(np.arange(-1.0, 1.01, 0.04), [0.4, 0.7, 1.0, 1.2])
    wall = np.stack([np.full(wy.size, 8.0), wy.ravel(), wz.ravel()], axis=-1).astype(np.float32)
    views = [View(cam, cam.ego_SE3_camera, mask)]
    open_ = label_points(ground, NOTHING, views) == ROAD
    seen = label_points(ground, wall, views) == ROAD
    # The camera stands at (1, 0, 1.5): its shadow widens from the wall on.
    wide = np.abs(ground[:, 1]) < (ground[:, 0] - 1) / 7
    far = 1 + 7 * 1.5 / (1.5 - 1.2)  # where the ray over the wall meets the ground
    shadow = wide & (ground[:, 0] > 8.9) & (ground[:, 0] < far)
    edge = np.abs(np.abs(ground[:, 1]) - (ground[:, 0] - 1) / 7) < 0.2 + 0.02 * ground[:, 0]
    assert not (seen & shadow & ~edge).any()
    clear = open_ & ~edge & ((ground[:, 0] < 7.9) | ~wide)
    assert clear.sum() > 1000 and seen[clear].all()


def test_a_branch_overhead_hides_nothing() -> None:
    branch = np.array([[8.0, y, 4.0] for y in np.arange(-2, 2, 0.05)], np.float32)
    road = np.random.default_rng(0).uniform((2, -4, 0), (20, 4, 0), (4000, 3)).astype(np.float32)
    below, standing = split(np.concatenate([road, branch]), 0.0)
    assert below[:4000].all() and not below[4000:].any() and not standing.any()


@pytest.mark.parametrize("slope", [-0.08, 0.0, 0.1])
def test_ground_and_what_stands_on_it_are_told_apart(slope: float) -> None:
    rng = np.random.default_rng(5)
    xy = rng.uniform(-30, 30, (30_000, 2))
    car = (np.abs(xy[:, 0] - 10) < 2.2) & (np.abs(xy[:, 1] - 3) < 0.9)
    kerb = (xy[:, 1] > 6) & ~car
    z = slope * xy[:, 0] + np.where(kerb, 0.15, 0) + rng.normal(0, 0.02, len(xy))
    z[car] += rng.uniform(0.6, 1.5, int(car.sum()))
    points = np.column_stack([xy, z - 0.3]).astype(np.float32)
    ghost = np.array([[5.0, 0.0, -4.0]], np.float32)
    ground, standing = split(np.concatenate([points, ghost]), -0.3)
    assert ground[:-1][~car].mean() > 0.995 and standing[:-1][car].mean() > 0.99
    assert not ground[-1] and not standing[-1]


@given(st.lists(st.integers(0, K - 1), min_size=1, max_size=12))
def test_probabilities_are_bayes_with_the_confusion_matrix(seen: list[int]) -> None:
    counts = np.bincount(seen, minlength=K).astype(np.float32)
    posterior = np.prod(CONFUSION[:, seen], axis=1)
    expected = posterior / posterior.sum()
    got = Weighting().probabilities(counts[None])[0]
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_confusion_rows_add_up() -> None:
    np.testing.assert_allclose(CONFUSION.sum(axis=1), 1)
    assert (CONFUSION.argmax(axis=1) == np.arange(K)).all()


def test_near_points_and_bright_paint_weigh_more() -> None:
    xyz = np.zeros((202, 3), np.float32)
    xyz[:, 0] = 10.0
    xyz[100:, 0] = 30.0
    classes = np.full(202, ROAD, np.uint8)
    classes[[0, 100, 101]] = MARKING
    intensity = np.random.default_rng(0).normal(0.1, 0.02, 202).astype(np.float32)
    intensity[[0, 100, 101]] = 0.5, 0.5, 0.05
    weight = Weighting(20.0, 0.5).of(xyz, intensity, classes)
    np.testing.assert_allclose(weight[1], 1 / (1 + 0.25), rtol=1e-5)
    np.testing.assert_allclose(weight[150], 1 / (1 + 2.25), rtol=1e-5)
    np.testing.assert_allclose(weight[0], 1.5 * weight[1], rtol=1e-3)
    np.testing.assert_allclose(weight[101], 0.5 * weight[150], rtol=2e-2)
    flat = Weighting(20.0, 0.0).of(xyz, intensity, classes)
    np.testing.assert_allclose(flat[0], flat[1])


def test_one_frame_cannot_outvote_the_others() -> None:
    raster = Raster(0.2, per_frame=2.0)
    many = np.tile([[0.1, 0.1, 5.0]], (500, 1))
    raster.add(many, np.full(500, MARKING, np.uint8), np.ones(500, np.float32))
    assert raster.counts(0, 0, 1, 1)[0, 0, MARKING] == pytest.approx(2.0)
    for _ in range(8):
        raster.add(many[:1], np.array([ROAD], np.uint8), np.ones(1, np.float32))
    best = Weighting().probabilities(raster.counts(0, 0, 1, 1))[0, 0].argmax()
    assert CLASSES[best] == "road"


def test_cells_beyond_tile_borders_and_below_zero() -> None:
    raster = Raster(0.5)
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-200, 200, (4000, 3))
    classes = rng.integers(0, K, 4000).astype(np.uint8)
    raster.add(xyz, classes, np.full(4000, 0.01, np.float32))
    block = raster.counts(-500, -500, 1000, 1000)
    expected = np.zeros((1000, 1000, K))
    ij = np.floor(xyz[:, :2] / 0.5).astype(int) + 500
    np.add.at(expected, (ij[:, 1], ij[:, 0], classes), 0.01)
    np.testing.assert_allclose(block, expected, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-50, 50), st.floats(-50, 50))
def test_windows_turn_with_the_vehicle(yaw: float, x: float, y: float) -> None:
    """A straight line ahead of the vehicle is a row of its window, whatever its heading."""
    raster, window = Raster(0.2), Window(12.0, 6.0, 0.2)
    pose = se3_from_xyyaw(np.asarray(x), np.asarray(y), np.asarray(yaw))
    s = np.arange(-11, 11, 0.05)
    line = transform(pose, np.stack([s, np.full_like(s, 2.1), 0 * s], axis=-1))
    raster.add(line, np.full(len(s), MARKING, np.uint8), np.ones(len(s), np.float32))
    planes = raster.window(window, pose, Weighting())
    row, column = np.nonzero(planes[-1] > 100)
    assert abs(row.mean() - (2.1 + 6.0) / 0.2 + 0.5) < 0.6 and np.ptp(row) <= 3
    assert column.min() <= 7 and column.max() >= 112
    assert (planes[:-1].argmax(axis=0)[planes[-1] > 100] == MARKING).all()


def test_a_sweep_is_fused_in_the_time_that_a_vehicle_has() -> None:
    """Processor time of one core, so that a busy machine does not count; with a margin of two."""
    pytest.importorskip("cv2")
    from benchmarks.semantic.speed import measure

    six, vlp16 = measure(rounds=3)
    assert six["ms"] < 50 and vlp16["ms"] + vlp16["window_ms"] < 50
    assert six["opencv_ratio"] > 2 and six["loop_ratio"] > 10
    assert min(six["points_of_the_ground"], vlp16["points_of_the_ground"]) > 2_000


def test_label_lists_of_mapillary_and_cityscapes(tmp_path: Path) -> None:
    import json

    names = {
        "construction--flat--road": "road", "construction--flat--bike-lane": "road",
        "construction--flat--crosswalk-plain": "crosswalk", "marking--crosswalk-zebra": "crosswalk",
        "marking--general": "marking", "construction--barrier--curb": "curb",
        "construction--flat--curb-cut": "curb", "construction--flat--sidewalk": "sidewalk",
        "nature--terrain": "terrain", "construction--structure--building": None,
        "object--vehicle--car": None, "nature--sky": None, "sidewalk": "sidewalk",
        "traffic light": None, "construction--barrier--fence": None,
    }  # fmt: skip
    path = tmp_path / "labels.json"
    path.write_text(json.dumps({"labels": [{"name": n} for n in names]}))
    labels = read_labels(path)
    got = [None if c == IGNORE else CLASSES[c] for c in labels.classes.tolist()]
    assert got == list(names.values())
    path.write_text(json.dumps({"labels": [{"name": "marking--general", "class": "ignore"}]}))
    with pytest.raises(BadInput, match="none of its labels"):
        read_labels(path)


@pytest.mark.parametrize("name", ["config_19.json", "config_65.json"])
def test_the_mapillary_lists_are_known(rtmap_data: Path, name: str) -> None:
    path = rtmap_data / "ucsd_campus" / name
    if not path.exists():
        pytest.skip(f"{name} not found in RTMAP_DATA/ucsd_campus")
    labels = read_labels(path)
    by_name = dict(zip(labels.names, labels.classes.tolist(), strict=True))
    assert by_name["marking--general"] == MARKING and by_name["object--vehicle--car"] == IGNORE
    assert by_name["construction--flat--road"] == ROAD and by_name["nature--sky"] == IGNORE
    assert len(labels) == {"config_19.json": 19, "config_65.json": 66}[name]
