"""What a drive could see, by cells and bearings, against the exact answer."""

import numpy as np

from rtmap_cli.maps.outlook import CELL, depths, outlook
from rtmap_cli.maps.sight import SightModel
from rtmap_cli.maps.visibility import hidden, views

RANGE = (-30.0, -15.0, 30.0, 15.0)


def _boxes(rng, count):
    place = rng.uniform(-25, 25, (count, 2))
    place = place[np.hypot(*place.T) > 6]
    size = rng.uniform([2, 1], [12, 3], (len(place), 2))
    return np.column_stack([place, rng.uniform(-np.pi, np.pi, len(place)), size])


def _drive(rng, count=30):
    pose = np.column_stack([np.arange(count) * 2.5 + 1000, np.full(count, -40.0), np.zeros(count)])
    pose[:, 2] = 0.4 + 0.02 * np.arange(count)
    return pose, [_boxes(rng, 6) for _ in range(count)]


def test_depths_hide_what_boxes_hide():
    rng = np.random.default_rng(0)
    for _ in range(20):
        boxes = _boxes(rng, 6)
        points = rng.uniform(-30, 30, (4000, 2))
        seen = outlook(np.zeros((1, 3)), (-40.0, -40.0, 40.0, 40.0), [boxes]).clear(
            np.zeros(len(points), np.int64), points, 0.0
        )
        exact = hidden(points, boxes)
        wrong = (seen < 0) != exact
        assert wrong.mean() < 0.015
        # Bearings are half a degree apart: the answers differ along the edges of shadows only.
        for p in points[wrong]:
            angle = np.arctan2(p[1], p[0]) + np.radians(np.linspace(-0.9, 0.9, 181))
            turned = np.hypot(*p) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            around = np.concatenate([turned, p * np.linspace(0.97, 1.03, 13)[:, None]])
            assert len(set(hidden(around, boxes).tolist())) == 2


def test_the_vehicle_and_what_is_far_hide_nothing():
    own = np.array([[0.5, 0.0, 0.0, 4.0, 2.0]])
    far = np.array([[60.0, 0.0, 0.0, 10.0, 10.0]])
    assert np.isinf(depths([own, far, np.zeros((0, 5))], 30.0)).all()
    wall = np.array([[-10.0, 0.0, np.pi / 2, 8.0, 1.0]])
    depth = depths([wall], 30.0)[0]
    # Straight back lies at both ends of the bearings.
    assert np.isclose(depth[[0, -1]], 9.5, atol=0.1).all() and np.isinf(depth[360])


def test_cells_are_counted_as_their_middles_are_seen():
    rng = np.random.default_rng(1)
    pose, boxes = _drive(rng)
    out = outlook(pose, RANGE, boxes)
    cells = np.unique(out.cell)
    row, column = np.divmod(cells, out.shape[1])
    middle = (np.stack([column, row], -1) + out.low + 0.5) * CELL
    for margin in (0.0, 3.0):
        exact = views(middle, pose, RANGE, boxes, margin)
        number = np.bincount(exact.point, minlength=len(cells))
        counted = out.counted(margin)[out.cells(middle)]
        assert np.abs(counted - number).mean() < 0.03 * number.mean()
        frames = out.frames(out.cells(middle[:1]), margin)
        one = out.sees(np.arange(len(pose)), np.repeat(out.cells(middle[:1]), len(pose)), margin)
        assert frames.tolist() == np.flatnonzero(one).tolist()
    assert out.counted(0.0)[out.cells(np.array([[0.0, 0.0]]))].tolist() == [0.0]


def test_views_weigh_by_distance_and_border():
    pose = np.zeros((1, 3))
    out = outlook(pose, RANGE, [np.zeros((0, 5))])
    sight = SightModel()
    weight = out.counted(3.0, sight)
    at = np.array([[1.0, 1.0], [25.0, 1.0], [1.0, 11.0], [29.0, 1.0]])
    near, far, side, outside = weight[out.cells(at)]
    assert np.isclose(near, 1.0, atol=0.02) and outside == 0
    assert np.isclose(far, float(sight.curve("distance", 25.02)) * 0.88, atol=0.03)
    assert side < near


def test_a_drive_without_occluders_or_frames_in_reach():
    out = outlook(np.zeros((2, 3)), RANGE, [np.zeros((0, 5))] * 2)
    assert out.cells(np.array([[1e6, 1e6]])).tolist() == [-1]
    assert not len(out.frames(np.array([-1]), 0.0))
