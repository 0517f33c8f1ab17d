"""Slopes: towns on hills, vehicles that stand on them, images that show them."""

from __future__ import annotations

import numpy as np
import pytest

from rtmap_cli.geometry.cameras import projection
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform, xyyaw_of
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.simulate.images.render import render_cameras
from rtmap_cli.steps.simulate.images.rig import default_rig
from rtmap_cli.steps.simulate.towns.town import make_town
from rtmap_cli.steps.simulate.worlds.heights import Ground, ground_of, stand_on
from rtmap_cli.steps.simulate.worlds.world import World, world_from_map

E, N = 500_000.0, 5_400_000.0


def plane(climb: float, lean: float) -> Ground:
    """Heights climb · x + lean · y around the origin of the town."""
    x, y = np.meshgrid(np.arange(-100, 101, 4.0), np.arange(-100, 101, 4.0))
    z = (climb * x + lean * y).astype(np.float32)
    return Ground(np.array([E - 100, N - 100]), 4.0, z, 50.0)


def hill(x: np.ndarray) -> np.ndarray:
    """A dip and a rise along x, up to 7 %."""
    return 100.0 + 1.2 * np.sin(x / 17.0)


def wavy_road() -> World:
    """120 m of road along x over the hill, with a line on its middle."""
    x = np.arange(-60.0, 61.0, 2.0)

    def line(xs: np.ndarray, y: float) -> np.ndarray:
        return np.column_stack([xs + E, np.full(len(xs), y + N), hill(xs)])

    ring = np.concatenate([line(x, -8.0), line(x[::-1], 8.0), line(x[:1], -8.0)])
    elements = [
        Element("b", "boundary", ring),
        Element("d", "divider", line(x, 0.0), attributes={"mark": "SOLID_WHITE"}),
    ]
    world = world_from_map(VectorMap(elements, "EPSG:32632"), seed=1)
    world.objects = world.objects[:0]
    return world


@pytest.mark.parametrize("yaw", [0.0, 1.0, np.pi])
def test_a_vehicle_stands_on_four_wheels(yaw):
    ground = plane(0.06, -0.03)
    flat = se3_from_xyyaw(np.array(E + 10.0), np.array(N - 20.0), np.array(yaw))
    pose = stand_on(ground, flat)
    assert np.allclose(xyyaw_of(pose), xyyaw_of(flat))
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    normal = np.array([-0.06, 0.03, 1.0]) / np.linalg.norm([-0.06, 0.03, 1.0])
    assert np.allclose(pose[:3, 2], normal, atol=1e-6)
    for wheel in ([2.8, 0.8, 0.0], [0.0, -0.8, 0.0]):
        p = transform(pose, np.array([wheel]))[0]
        assert p[2] == pytest.approx(float(ground.at(p[:2])), abs=0.01)


def test_the_ground_goes_through_the_map():
    world = wavy_road()
    assert world.ground is not None
    for element in world.vector_map:
        assert np.abs(world.ground.at(element.xy) - element.points[:, 2]).max() < 0.1
    level = [Element("b", "boundary", np.array([[0, 0, 5.0], [9, 0, 5], [9, 9, 5], [0, 0, 5]]))]
    assert ground_of(VectorMap(level, "EPSG:32632")) is None


def test_paint_on_a_hill_appears_where_projection_says():
    from tests.test_simulate_render import plain_style

    world = wavy_road()
    pose = stand_on(world.ground, se3_from_xyyaw(np.array(E - 20.0), np.array(N - 2.0), 0.03))
    camera = default_rig(512, 336).cameras[0]
    image = render_cameras(world, pose, [camera], plain_style())[0]
    x = np.arange(-12.0, 11.0, 1.0)

    def colours(heights: np.ndarray, aside: float) -> np.ndarray:
        points = np.column_stack([x + E, np.full(len(x), N + aside), heights])
        ego = transform(invert(pose), points)
        uvw = np.column_stack([ego, np.ones(len(x))])
        uvw = uvw @ projection(camera.intrinsics, camera.ego_SE3_camera).T
        u, v = np.round(uvw[:, :2] / uvw[:, 2:]).astype(int).T
        return image[v, u, 0].astype(float)

    truth, beside = colours(hill(x), 0.0), colours(hill(x), 0.7)
    assert np.median(truth) > 90
    assert (truth - beside).min() > 5, "every point of the line is painted"
    assert beside.max() < 65
    flat = colours(np.full(len(x), hill(x[:1])[0]), 0.0)
    assert np.median(flat) < 65, "a flat road would show it elsewhere"


def test_most_towns_lie_on_gentle_hills():
    grounds = [ground_of(make_town(seed, 150).vector_map) for seed in range(8)]
    assert 4 <= sum(g is not None for g in grounds) < 8
    for seed, ground in enumerate(grounds):
        lanes = np.concatenate(make_town(seed, 150).lanes)
        if ground is None:
            continue
        steps = np.diff(lanes, axis=0)
        run = np.hypot(*steps.T)
        near = (run > 0.5) & (run < 2.01)
        grade = np.abs(np.diff(ground.at(lanes)))[near] / run[near]
        assert np.percentile(grade, 99) < 0.12
        assert grade.max() < 0.3
