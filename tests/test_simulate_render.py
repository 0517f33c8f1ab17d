"""The renderer: things appear where projection says, and the same seed gives the same picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtmap_cli.geometry.cameras import projection
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform
from rtmap_cli.logs.log import Camera, Occluder
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.simulate.images.render import render_cameras
from rtmap_cli.steps.simulate.images.rig import default_rig, jitter_rig, scale_camera
from rtmap_cli.steps.simulate.images.style import Style, make_style
from rtmap_cli.steps.simulate.worlds.world import World, world_from_map

E, N = 500_000.0, 5_400_000.0


def plain_style() -> Style:
    """Grey ground, white paint, no weather, no noise, no motion of the body."""
    dark = (50.0, 50.0, 50.0)
    return replace(
        make_style(np.random.default_rng(0)),
        asphalt=dark, verge=(50.0, 120.0, 50.0), sidewalk=(50.0, 120.0, 50.0), curb=dark,
        white=(250.0,) * 3, yellow=(250.0, 250.0, 0.0), grain=0.0, visibility=1e6,
        gain=(1.0, 1.0, 1.0), gamma=1.0, blur=0.0, noise=0.0, exposure=0.0,
        pitch=0.0, roll=0.0, heave=0.0,
    )  # fmt: skip


def square(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]) + (E, N)


def road(*extra: Element) -> World:
    """Asphalt 120 × 16 m along x with one solid line on its middle; no objects beside it."""
    line = np.array([[-60.0, 0.0], [60.0, 0.0]]) + (E, N)
    elements = [
        Element("b", "boundary", square(-60, -8, 60, 8)),
        Element("d", "divider", line, attributes={"mark": "SOLID_WHITE"}),
        *extra,
    ]
    world = world_from_map(VectorMap(elements, "EPSG:32632"), seed=1)
    world.objects = world.objects[:0]
    return world


POSE = se3_from_xyyaw(np.array(E - 20.0), np.array(N - 2.0), np.array(0.03))


def seen(image: np.ndarray, camera: Camera, points: np.ndarray) -> np.ndarray:
    """(n, 3) colours at map points (n, 2) on the road, NaN outside the image."""
    ego = transform(invert(POSE), points)
    uvw = np.column_stack([ego, np.zeros(len(ego)), np.ones(len(ego))])
    uvw = uvw @ projection(camera.intrinsics, camera.ego_SE3_camera).T
    u, v = np.round(uvw[:, :2] / uvw[:, 2:]).astype(int).T
    out = np.full((len(points), 3), np.nan)
    ok = (uvw[:, 2] > 0.5) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    out[ok] = image[v[ok], u[ok]]
    return out


@pytest.mark.parametrize("width", [224, 512])
def test_paint_appears_where_projection_says(width):
    rig = jitter_rig(default_rig(width, round(0.6 * width)), np.random.default_rng(2))
    images = render_cameras(road(), POSE, rig.cameras, plain_style(), (), np.random.default_rng(0))
    line = np.stack([np.arange(-16.0, -6.0, 0.5), np.zeros(20)], axis=-1) + (E, N)
    on = seen(images[0], rig.cameras[0], line)
    beside = seen(images[0], rig.cameras[0], line + (0.0, 0.5))
    assert np.nanmean(on[:, 0]) > 95
    assert np.nanmean(beside[:, 0]) < 60
    grass = seen(images[0], rig.cameras[0], line + (15.0, 10.0))
    assert np.nanmean(grass[:, 1] - grass[:, 0]) > 50


def test_a_line_is_centred_to_a_fraction_of_a_pixel():
    """The centre of gravity of a line across a row lies on its projection."""
    camera = default_rig(512, 336).cameras[0]
    image = render_cameras(road(), POSE, [camera], plain_style(), (), np.random.default_rng(0))[0]
    errors = []
    for x in np.arange(-15.0, -8.0, 0.5):
        ego = transform(invert(POSE), np.array([[E + x, N]]))
        p = np.array([*ego[0], 0.0, 1.0])
        u, v, w = projection(camera.intrinsics, camera.ego_SE3_camera) @ p
        u, v = u / w, v / w
        if not (10 < u < 500 and 150 < v < 335):
            continue
        k = camera.intrinsics
        row = round(v)
        # The row's own centre: follow the line's slope in the image from v to the row.
        ahead = transform(invert(POSE), np.array([[E + x + 0.1, N]]))
        u2, v2, w2 = projection(k, camera.ego_SE3_camera) @ np.array([*ahead[0], 0.0, 1.0])
        u += (u2 / w2 - u) / (v2 / w2 - v) * (row - v)
        columns = np.arange(round(u) - 12, round(u) + 13)
        weight = np.clip(image[row, columns, 0].astype(float) - 60, 0, None)
        errors.append((columns * weight).sum() / weight.sum() - u)
    assert len(errors) > 5
    assert abs(np.median(errors)) < 0.6, "one pixel of the ground raster is about 3 px here"


def test_road_height_in_the_ego_frame_does_not_matter():
    world, style = road(), plain_style()
    a = render_cameras(world, POSE, default_rig(160, 96).cameras, style)
    rig = default_rig(160, 96, ground_z=-0.32)
    b = render_cameras(world, POSE, rig.cameras, style, ground_z=-0.32)
    assert np.array_equal(np.stack(a), np.stack(b))


def test_distortion_moves_pixels_as_the_model_says():
    camera = default_rig(256, 192).cameras[0]
    bent = replace(camera, distortion=(-0.25, 0.05, 0.0))
    straight, image = (
        render_cameras(road(), POSE, [c], plain_style(), (), np.random.default_rng(0))[0]
        for c in (camera, bent)
    )
    k = camera.intrinsics
    xy = np.array([0.25, 0.32])
    r = float(xy @ xy)
    uv = k[:2, :2] @ (xy * (1 - 0.25 * r + 0.05 * r * r)) + k[:2, 2]
    plain = k[:2, :2] @ xy + k[:2, 2]
    assert np.hypot(*(uv - plain)) > 3
    a = straight[round(plain[1]), round(plain[0])].astype(int)
    b = image[round(uv[1]), round(uv[0])].astype(int)
    assert np.abs(a - b).max() < 25


def test_same_seed_same_bytes_and_wear_is_of_the_place():
    style = make_style(np.random.default_rng(3))
    rig = default_rig(160, 96)
    a = render_cameras(road(), POSE, rig.cameras, style, (), np.random.default_rng(5))
    b = render_cameras(road(), POSE, rig.cameras, style, (), np.random.default_rng(5))
    assert np.array_equal(np.stack(a), np.stack(b))
    c = render_cameras(road(), POSE, rig.cameras, style, (), np.random.default_rng(6))
    assert not np.array_equal(np.stack(a), np.stack(c))
    # The ground itself does not hang on the drive: same tiles whatever the style.
    one, two = road(), road()
    render_cameras(one, POSE, rig.cameras, style)
    render_cameras(two, POSE, rig.cameras, plain_style())
    assert all(np.array_equal(one.tiles[k], two.tiles[k]) for k in one.tiles)


def test_a_vehicle_hides_the_road():
    camera = default_rig(256, 160).cameras[0]
    style = plain_style()
    free = render_cameras(road(), POSE, [camera], style)[0]
    box = Occluder(12.0, 0.0, 0.0, 4.6, 1.9, 1.6)
    hidden = render_cameras(road(), POSE, [camera], style, [box])[0]
    k = camera.intrinsics
    u, v = round(k[0, 2]), round(k[1, 2] + k[1, 1] * 0.9 / 9)
    assert np.abs(hidden[v, u].astype(int) - free[v, u].astype(int)).max() > 8
    assert np.array_equal(hidden[:, :20], free[:, :20])


def test_a_deleted_curb_leaves_the_road():
    before = VectorMap([Element("b", "boundary", square(-60, -8, 60, 8))], "EPSG:32632")
    ring = square(-60, -8, 60, 8)
    opened = np.concatenate([[[E + 5, N - 8]], ring[1:4], ring[:1], [[E - 15, N - 8]]])
    after = VectorMap([Element("b#a", "boundary", opened)], "EPSG:32632")
    for world in (world_from_map(after, surface_map=before), world_from_map(after)):
        assert world.surface.area == pytest.approx(120 * 16, rel=1e-6)
        assert len(world.soft) == 1
        world.objects = world.objects[:0]
        image = render_cameras(world, POSE, default_rig(224, 160).cameras[2:3], plain_style())[0]
        gap = seen(image, default_rig(224, 160).cameras[2], np.array([[E - 12.0, N - 9.0]]))
        assert gap[0, 1] - gap[0, 0] < 25, "the ground beside the gap is paved"


def test_scaled_cameras_keep_their_view():
    camera = default_rig(512, 336).cameras[1]
    small = scale_camera(camera, 128)
    assert (small.width, small.height) == (128, 84)
    ray = np.linalg.inv(camera.intrinsics) @ [511.5, 335.5, 1]
    edge = small.intrinsics @ ray
    assert np.allclose(edge[:2], [127.5, 83.5])
