"""What was in view and not hidden: range, occluders, fields of view."""

from __future__ import annotations

import numpy as np

from rtmap_cli.maps.visibility import hidden, in_sectors, views

RANGE = (-36.0, -18.0, 36.0, 18.0)


def test_a_box_hides_what_stands_behind_it_and_itself_but_nothing_before_it() -> None:
    box = np.array([[10.0, 0.0, 0.0, 4.0, 2.0]])
    points = np.array([[5.0, 0.0], [10.0, 0.0], [20.0, 0.0], [20.0, 6.0], [-20.0, 0.0]])
    assert hidden(points, box).tolist() == [False, True, True, False, False]


def test_a_turned_box_hides_another_sector() -> None:
    along, across = (np.array([[10.0, 0.0, yaw, 8.0, 0.5]]) for yaw in (0.0, np.pi / 2))
    point = np.array([[20.0, 5.0]])
    assert not hidden(point, along)[0]
    assert hidden(point, across)[0]


def test_the_box_of_the_vehicle_itself_hides_nothing() -> None:
    box = np.array([[0.5, 0.0, 0.0, 4.6, 1.9]])
    assert not hidden(np.array([[20.0, 3.0], [-5.0, 0.1]]), box).any()


def test_hidden_agrees_with_sampling_the_line_of_sight() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-30, 30, (200, 2))
    boxes = np.column_stack(
        [rng.uniform(-20, 20, (6, 2)), rng.uniform(-3, 3, 6), rng.uniform(3, 8, 6), np.full(6, 2.0)]
    )
    t = np.linspace(0, 1, 4000)[:, None, None]
    path = t * points
    expected = np.zeros(len(points), bool)
    for x, y, yaw, length, width in boxes:
        d = path - [x, y]
        u = np.cos(yaw) * d[..., 0] + np.sin(yaw) * d[..., 1]
        v = -np.sin(yaw) * d[..., 0] + np.cos(yaw) * d[..., 1]
        inside = (np.abs(u) <= length / 2) & (np.abs(v) <= width / 2)
        if not inside[0].any():
            expected |= inside.any(axis=0)
    # Grazing lines of sight may fall between two samples.
    assert (hidden(points, boxes) == expected).mean() > 0.99


def test_views_respect_range_heading_margin_and_occluders() -> None:
    points = np.array([[30.0, 0.0], [0.0, 30.0], [0.0, 15.0], [35.0, 0.0]])
    east, north = [0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]
    pose = np.array([east, north])
    seen = views(points, pose, RANGE)
    assert list(zip(seen.frame, seen.point, strict=True)) == [
        (0, 0),
        (0, 2),
        (0, 3),
        (1, 1),
        (1, 2),
    ]
    assert np.allclose(seen.distance, [30, 15, 35, 30, 15])
    near = views(points, pose, RANGE, margin=3.0)
    assert list(zip(near.frame, near.point, strict=True)) == [(0, 0), (0, 2), (1, 1), (1, 2)]
    wall = [np.array([[10.0, 0.0, 0.0, 1.0, 6.0]]), np.zeros((0, 5))]
    seen = views(points, pose, RANGE, wall)
    assert list(zip(seen.frame, seen.point, strict=True)) == [(0, 2), (1, 1), (1, 2)]


def test_fields_of_view_wrap_around_the_back() -> None:
    points = np.array([[10.0, 0.0], [-10.0, 0.1], [-10.0, -0.1], [0.0, 10.0]])
    back = [(np.pi, np.radians(30))]
    assert in_sectors(points, back).tolist() == [False, True, True, False]
    seen = views(points, np.zeros((1, 3)), RANGE, sectors=back)
    assert seen.point.tolist() == [1, 2]


def test_nothing_to_see_is_no_error() -> None:
    assert not len(views(np.zeros((0, 2)), np.zeros((1, 3)), RANGE))
    assert not len(views(np.array([[500.0, 0.0]]), np.zeros((2, 3)), RANGE))
