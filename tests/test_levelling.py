"""How the road lies under a frame, from the heights of a prior map or of the log's own path."""

from __future__ import annotations

import numpy as np
import pytest

from rtmap_cli.geometry.cameras import fit_plane, levelled, projection
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.infer.levelling import RoadUnder

SLOPES = (0.02, -0.03)


def on_slope(xy: np.ndarray) -> np.ndarray:
    return 100.0 + xy @ SLOPES


def level_pose(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, on_slope(np.array([x, y]))
    return pose


def sloped_map(height: float | None = 0.0) -> VectorMap:
    xy = np.stack([np.linspace(-30, 30, 20), np.full(20, 4.0)], axis=-1)
    elements = []
    for k, offset in enumerate((-8.0, -4.0, 0.0)):
        line = xy + [0, offset]
        z = np.full(20, np.nan) if height is None else on_slope(line) + height
        elements.append(Element(f"d{k}", "divider", np.column_stack([line, z])))
    return VectorMap(elements, "EPSG:32632")


@pytest.mark.parametrize("shift", [0.0, 7.5])
def test_heights_of_the_prior_say_how_the_road_lies(shift: float) -> None:
    pose = level_pose(1.0, 2.0, yaw=0.7)
    plane = RoadUnder([pose], sloped_map(shift)).plane(pose)
    turned = np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]]) @ SLOPES
    assert plane[:2] == pytest.approx(turned, abs=1e-3) and plane[2] == 0


def test_the_path_says_it_without_heights() -> None:
    poses = [level_pose(x, 0.0) for x in np.arange(-30.0, 31.0, 2.0)]
    for prior in (None, sloped_map(None)):
        plane = RoadUnder(poses, prior).plane(poses[15])
        assert plane == pytest.approx([SLOPES[0], 0.0, 0.0], abs=5e-4)


def test_a_body_that_rises_leaves_the_road_where_it_was() -> None:
    """On a bend all of the path lies to one side: a rise must not turn into a slope."""
    angle = np.linspace(-1.0, 1.0, 41)
    poses = [level_pose(30 * np.sin(a), 30 - 30 * np.cos(a), a) for a in angle]
    for pose in poses:
        pose[2, 3] = 5.0
    poses[20][2, 3] += 0.04
    for prior, slopes in ((None, (0.0, 0.0)), (sloped_map(), SLOPES)):
        plane = RoadUnder(poses, prior).plane(poses[20])
        assert plane[:2] == pytest.approx(slopes, abs=3e-3)
    assert -0.04 < RoadUnder(poses).plane(poses[20])[2] < -0.02


def test_nothing_known_is_level_and_broken_heights_are_no_road() -> None:
    alone = level_pose(0.0, 0.0)
    assert (RoadUnder([alone] * 5).plane(alone) == 0).all()
    jumping = [level_pose(float(x), 0.0) for x in range(0, 30, 2)]
    for k, pose in enumerate(jumping):
        pose[2, 3] += 3.0 * k
    assert (RoadUnder(jumping).plane(jumping[7]) == 0).all()


def test_levelled_cameras_see_the_slope_at_zero() -> None:
    camera = np.eye(4)
    camera[:3, :3] = np.column_stack([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    camera[:3, 3] = 1.0, 0.2, 1.6
    matrix = projection(np.array([[200.0, 0, 112], [0, 200, 38], [0, 0, 1]]), camera)
    plane = np.array([0.02, -0.01, 0.05])
    xy = np.array([[12.0, -3.0], [25.0, 6.0]])
    seen = np.column_stack([xy, xy @ plane[:2] + plane[2], [1, 1]]) @ matrix.T
    flat = np.column_stack([xy, [0, 0], [1, 1]]) @ levelled(matrix, plane).T
    assert flat == pytest.approx(seen)


def test_fit_plane_finds_a_plane_and_asks_for_enough() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-20, 20, (60, 2))
    points = np.column_stack([xy, xy @ [0.03, -0.02] + 0.1])
    assert fit_plane(points) == pytest.approx([0.03, -0.02, 0.1])
    assert (fit_plane(points[:5]) == 0).all()
    assert (fit_plane(points[:1].repeat(30, axis=0)) == 0).all()
