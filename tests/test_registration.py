"""What known lines show as displaced is put back; one drive picks a place; nodes stay nodes."""

from __future__ import annotations

import numpy as np
import pytest

from rtmap_cli.maps.existence import VoteModel, joint_log_likelihoods, log_odds_of
from rtmap_cli.maps.refit import at_nodes
from rtmap_cli.maps.registration import registered
from rtmap_cli.maps.stations import samples_of, stations_of
from rtmap_cli.steps.crowdsource.lines import snap_ends

MODEL = VoteModel()


def straight(y: float, x0: float = 0.0, x1: float = 40.0) -> np.ndarray:
    return np.column_stack([np.linspace(x0, x1, 20), np.full(20, y)])


def seen(lines: list[np.ndarray], frames: int, sigma: float = 0.4) -> object:
    """Every frame sees the lines as they are."""
    points = np.concatenate([np.stack(lines)] * frames)
    n = len(points)
    covariance = np.broadcast_to(np.eye(2) * sigma**2, (n, 20, 2, 2))
    return samples_of(points, covariance, np.full(n, 0.9), np.repeat(np.arange(frames), len(lines)))


def test_what_lies_between_displaced_lines_is_put_back_with_them() -> None:
    known = stations_of([straight(0.0), straight(7.0)])
    drive = seen([straight(0.6), straight(7.6), straight(4.1)], 6)
    back = registered(drive, known)
    between = np.abs(drive.xy[:, 1] - 4.1) < 0.01
    moved = (back.xy - drive.xy)[between, 1]
    assert moved.max() < -0.25 and moved.min() > -0.6
    # Nothing tells a displacement along the lines.
    assert np.abs(back.xy - drive.xy)[:, 0].max() < 0.01


def test_far_from_known_lines_nothing_is_moved() -> None:
    known = stations_of([straight(0.0)])
    drive = seen([straight(0.6), straight(0.0, 200.0, 240.0)], 6)
    back = registered(drive, known)
    away = drive.xy[:, 0] > 150
    assert np.array_equal(back.xy[away], drive.xy[away])
    assert registered(drive, stations_of([])) is drive


def test_lines_that_are_off_both_ways_move_nothing_between_them() -> None:
    known = stations_of([straight(0.0), straight(4.0)])
    drive = seen([straight(0.5), straight(3.5)], 6)
    back = registered(drive, known)
    assert np.abs(back.xy - drive.xy).max() < 0.2


def odds(hits: list[float], views: list[float], picked: bool) -> float:
    h, v = np.array(hits)[:, None], np.array(views)[:, None]
    return float(log_odds_of(joint_log_likelihoods(h, v, MODEL, np.array([picked])), MODEL)[0])


def test_drives_that_agree_on_a_rarely_seen_place_say_more_than_one_that_picked_it() -> None:
    one = odds([5.0], [22.0], True)
    three = odds([5.0] * 3, [22.0] * 3, True)
    assert three > one + 2.0
    # A find of one drive that two others do not make is worth less than the find alone.
    assert odds([5.0, 0.0, 0.0], [22.0] * 3, True) < one
    # Drives that did not look change nothing.
    assert odds([5.0, 0.0], [22.0, 0.0], True) == pytest.approx(one)
    assert odds([0.0], [0.0], True) == 0.0


def test_lines_that_met_in_a_vertex_meet_again() -> None:
    vertices = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 0.0], [20.0, 1.0], [10.0, 0.0]])
    move = np.array([[0.1, 0.1], [0.0, 0.3], [0.0, 0.0], [0.0, 0.2], [0.0, -0.3]])
    out = at_nodes(vertices, move, np.ones(5, bool))
    assert np.array_equal(out[1], out[2]) and np.array_equal(out[1], out[4])
    assert np.array_equal(out[[0, 3]], move[[0, 3]])
    stays = at_nodes(vertices, move, np.array([True, True, False, False, True]))
    assert np.array_equal(stays[[1, 2, 4]], np.zeros((3, 2)))


def test_a_new_line_that_overlaps_the_end_it_joins_does_not_run_back_and_forth() -> None:
    old = np.column_stack([np.linspace(-10, 0, 6), np.zeros(6), np.zeros(6)])
    new = np.column_stack([np.linspace(-1.5, 20, 44), np.full(44, 0.2), np.zeros(44)])
    points = [old, new]
    snap_ends(points, [False, True], 3.0, float(np.radians(30)))
    assert np.array_equal(points[1][0, :2], old[-1, :2])
    assert (np.diff(points[1][:, 0]) >= 0).all()


def test_an_end_beside_another_one_does_not_continue_it() -> None:
    """The lane line beside it starts where this one ends: both keep their places."""
    old = np.column_stack([np.linspace(-10, 0, 6), np.zeros(6), np.zeros(6)])
    new = np.column_stack([np.linspace(0.5, 20, 40), np.full(40, 2.4), np.zeros(40)])
    points = [old, new.copy()]
    snap_ends(points, [False, True], 3.0, float(np.radians(30)))
    assert np.array_equal(points[1], new)
