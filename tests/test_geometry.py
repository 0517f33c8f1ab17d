"""Poses, polylines, cameras: round trips and known answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry import polylines, poses
from rtmap_cli.geometry.cameras import fit_camera, horizon_row, projection
from rtmap_cli.logs.log import Camera
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.prior import prior_slots
from rtmap_cli.steps.infer.images import FittedCamera

finite = st.floats(-1e3, 1e3)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.dot(q, q) > 1e-2))
def test_quaternions_round_trip(values: list[float]) -> None:
    q = np.array(values) / np.linalg.norm(values)
    matrix = poses.se3_from_quaternion(q, np.zeros(3))
    expected = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(matrix[:3, :3], expected, atol=1e-12)
    back = poses.quaternion_from_se3(matrix)
    np.testing.assert_allclose(abs(back @ q), 1.0, atol=1e-12)


@given(finite, finite, st.floats(-10, 10))
def test_inverse_and_planar_transform_agree_with_the_matrix(x: float, y: float, yaw: float) -> None:
    pose = poses.se3_from_xyyaw(x, y, yaw)
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    three = poses.transform(pose, np.column_stack([points, [0.0, 4.0]]))
    np.testing.assert_allclose(poses.transform(pose, points), three[:, :2], atol=1e-9)
    back = poses.transform(poses.invert(pose), three)
    np.testing.assert_allclose(back[:, :2], points, atol=1e-9)


def test_unknown_heights_stay_unknown() -> None:
    pose = poses.se3_from_xyyaw(10.0, 20.0, 0.3, 5.0)
    out = poses.transform(pose, np.array([[1.0, 0.0, np.nan], [1.0, 0.0, 2.0]]))
    assert np.isnan(out[0, 2]) and out[1, 2] == pytest.approx(7.0)
    np.testing.assert_allclose(out[0, :2], out[1, :2])


def test_unknown_heights_far_from_the_origin_of_the_map() -> None:
    """A vehicle that leans, in UTM: places without a height are where those on its road are."""
    lean = Rotation.from_euler("ZYX", [40.0, 3.0, -2.0], degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = lean, (500_010.0, 5_400_020.0, 250.0)
    road = np.array([[30.0, -12.0, 0.0], [-5.0, 7.0, 0.0]])
    there = poses.transform(pose, road)
    unknown = np.array([1.0, 1.0, np.nan])
    back = poses.transform(poses.invert(pose), there * unknown)
    np.testing.assert_allclose(back[:, :2], road[:, :2], atol=1e-6)
    np.testing.assert_allclose(poses.transform(pose, road * unknown)[:, :2], there[:, :2])


def test_interpolation_keeps_nanoseconds() -> None:
    start = 1_767_600_000_000_000_000
    times = np.array([start, start + 1000], np.int64)
    track = poses.se3_from_xyyaw(np.array([0.0, 1.0]), np.zeros(2), np.array([3.1, -3.1]))
    at = poses.interpolate(times, track, np.array([start + 250], np.int64))
    assert at[0, 0, 3] == pytest.approx(0.25)
    # The short way over ±π.
    assert abs(poses.wrap_angle(poses.yaw_of(at)[0] - 3.1)) < 0.03


@settings(max_examples=50)
@given(st.lists(st.tuples(finite, finite), min_size=2, max_size=8, unique=True))
def test_clipping_loses_nothing_inside_and_keeps_nothing_outside(
    vertices: list[tuple[float, float]],
) -> None:
    import shapely

    line = np.array(vertices)
    box = (-200.0, -150.0, 250.0, 300.0)
    pieces = polylines.clip_to_box(line, box)
    expected = shapely.clip_by_rect(shapely.linestrings(line), *box).length
    assert sum(map(polylines.length, pieces)) == pytest.approx(expected, abs=1e-5)
    for piece in pieces:
        assert (piece >= np.array(box[:2]) - 1e-6).all()
        assert (piece <= np.array(box[2:]) + 1e-6).all()


def test_a_ring_that_starts_inside_is_not_cut_at_its_start() -> None:
    ring = np.array([[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]], float)
    (piece,) = polylines.clip_to_box(ring, (-5, -5, 5, 15))
    assert polylines.length(piece) == pytest.approx(20.0)


def test_joining_makes_rings_and_leaves_forks() -> None:
    square = np.array([[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]], float)
    (ring,) = polylines.join_lines([square[:3], square[:1:-1]])
    assert polylines.is_ring(ring) and polylines.length(ring) == pytest.approx(40.0)
    fork = [
        np.array([[0.0, 0], [1, 0]]),
        np.array([[1.0, 0], [2, 1]]),
        np.array([[1.0, 0], [2, -1]]),
    ]
    assert len(polylines.join_lines(fork)) == 3


def _camera(width: int = 400, height: int = 300, distortion: tuple = (0.0, 0.0, 0.0)) -> Camera:
    pose = np.eye(4)
    # Looking 20° to the left and 5° down from 1.6 m.
    forward = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    pose[:3, :3] = Rotation.from_euler("ZY", [20, 5], degrees=True).as_matrix() @ forward
    pose[:3, 3] = [1.5, 0.2, 1.6]
    intrinsics = np.array([[320, 0, 199.5], [0, 320, 149.5], [0, 0, 1.0]])
    return Camera("front", width, height, intrinsics, pose, distortion)


def test_fitting_puts_the_horizon_on_its_row_and_moves_projections_along() -> None:
    camera = _camera()
    size = (96, 160)
    warp, fitted = fit_camera(
        camera.intrinsics, camera.ego_SE3_camera, (camera.height, camera.width), size, 0.3
    )
    assert horizon_row(fitted, camera.ego_SE3_camera) == pytest.approx(0.3 * 96)
    point = np.array([20.0, 6.0, 0.0, 1.0])
    before = projection(camera.intrinsics, camera.ego_SE3_camera) @ point
    after = projection(fitted, camera.ego_SE3_camera) @ point
    np.testing.assert_allclose((warp @ (before / before[2]))[:2], (after / after[2])[:2], atol=1e-9)
    # A point on the ground infinitely far away lies on the horizon.
    far = projection(fitted, camera.ego_SE3_camera) @ np.array([1e7, 3.64e6, 0.0, 1.0])
    assert far[1] / far[2] == pytest.approx(0.3 * 96, abs=0.01)


def _chart(path: Path, camera: Camera) -> None:
    """An image whose red and green tell the pixel (x, y)."""
    from PIL import Image

    x = np.linspace(0, 255, camera.width)[None].repeat(camera.height, 0)
    y = np.linspace(0, 255, camera.height)[:, None].repeat(camera.width, 1)
    chart = np.stack([x, y, np.full_like(x, 128)], -1).astype(np.uint8)
    Image.fromarray(chart).save(path, quality=98, subsampling=0)


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0), (-0.2, 0.05, 0.0)])
def test_fitted_images_show_what_the_projection_says(
    tmp_path: Path, distortion: tuple[float, float, float]
) -> None:
    camera = _camera(distortion=distortion)
    _chart(tmp_path / "a.jpg", camera)
    fitted = FittedCamera(camera, (96, 160), 0.35, ground_z=-0.3)
    image = fitted.load(tmp_path / "a.jpg").astype(float)
    for ground in ([12.0, 4.0], [20.0, 9.0], [9.0, 2.5]):
        # The road lies at z = -0.3 of the ego frame and at 0 of the network's frame.
        u, v, w = fitted.ego_to_image @ np.array([*ground, 0.0, 1.0])
        ray = np.linalg.inv(camera.ego_SE3_camera) @ np.array([*ground, -0.3, 1.0])
        x, y = ray[:2] / ray[2]
        r2 = x * x + y * y
        factor = 1 + r2 * (distortion[0] + r2 * distortion[1])
        pixel = camera.intrinsics @ np.array([x * factor, y * factor, 1.0])
        expected = pixel[:2] / [camera.width - 1, camera.height - 1] * 255
        seen = image[round(v / w), round(u / w)]
        np.testing.assert_allclose(seen[:2], expected, atol=4.0)


def test_a_truncated_or_wrongly_sized_image_is_named(tmp_path: Path) -> None:
    camera = _camera()
    path = tmp_path / "a.jpg"
    _chart(path, camera)
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(BadInput, match=r"a\.jpg"):
        FittedCamera(camera, (96, 160), 0.3, 0.0).load(path)
    _chart(path, _camera(200, 150))
    with pytest.raises(BadInput, match="200×150"):
        FittedCamera(camera, (96, 160), 0.3, 0.0).load(path)


def test_crops_and_prior_slots() -> None:
    ring = np.array([[30, -3], [40, -3], [40, 3], [30, 3], [30, -3]], float)
    line = np.array([[-100, 1.8], [100, 1.8]], float)
    far = np.array([[500, 0], [600, 0]], float)
    vector_map = VectorMap(
        [Element("c", "ped_crossing", ring), Element("d", "divider", line),
         Element("f", "divider", far)], "EPSG:32632",
    )  # fmt: skip
    pose = poses.se3_from_xyyaw(5.0, 0.0, 0.0)
    local = MapIndex(vector_map).crop(pose)
    assert [e.source.element_id for e in local] == ["c", "d"]
    crossing, divider = (e.points for e in local)
    assert polylines.is_ring(crossing) and crossing[:, 0].max() == pytest.approx(35.0)
    assert polylines.length(divider) == pytest.approx(72.0)
    slots = prior_slots(local, pose, ["divider", "ped_crossing"], 20, max_slots=1)
    # The divider passes 1.8 m beside the vehicle, the crossing is farther away.
    assert slots.element_ids == ["d"] and slots.dropped == 1 and slots.class_index[0] == 0
    np.testing.assert_allclose(slots.map_points[0, :, 1], 1.8)
