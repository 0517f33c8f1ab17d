"""One detection per frame and place, strands, what a look is worth, rates fitted to the votes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtmap_cli.geometry.rings import open_ring
from rtmap_cli.maps.assignment import assign_once, offset_sigma
from rtmap_cli.maps.existence import VoteModel, drive_log_likelihoods, fitted, log_odds_of
from rtmap_cli.maps.sight import KNOTS, Look, SightModel, measured_sight
from rtmap_cli.maps.stations import Samples, samples_of, stations_of
from rtmap_cli.steps.detect_changes.crossings import Rings, features, match

Array = NDArray[np.float64]


def _line(y: float, x0: float = 0.0, x1: float = 40.0) -> Array:
    x = np.linspace(x0, x1, 20)
    return np.stack([x, np.full_like(x, y)], axis=-1)


def _samples(*lines: Array, frames: list[int] | None = None, sigma: float = 0.2) -> Samples:
    points = np.stack(lines)
    covariance = np.tile(np.eye(2) * sigma**2, (*points.shape[:2], 1, 1))
    frame = np.array(frames if frames is not None else [0] * len(lines), np.int64)
    return samples_of(points, covariance, np.ones(len(lines)), frame)


def test_of_two_detections_of_a_frame_the_nearer_keeps_the_line() -> None:
    stations = stations_of([_line(0.0)])
    feet, taken = assign_once(stations, _samples(_line(0.2), _line(1.1)))
    assert np.allclose(feet.offset, 0.2)
    assert taken.tolist() == [True] * 39 + [False] * 39
    # In two frames both may be the same line, seen a little off.
    _, taken = assign_once(stations, _samples(_line(0.2), _line(1.1), frames=[0, 1]))
    assert taken.all()


def test_what_is_named_goes_to_its_line_and_a_doubtful_one_does_not_drive_it_out() -> None:
    stations = stations_of([_line(0.0)])
    samples = _samples(_line(0.0), _line(0.4))
    sure = np.where(samples.detection == 1, 0.95, 0.2)
    own = np.where(samples.detection == 1, 0, -1)
    _, taken = assign_once(stations, replace(samples, score=sure), own=own)
    assert taken.tolist() == [False] * 39 + [True] * 39
    # It goes there past a nearer line; out of its reach it goes to any.
    stations = stations_of([_line(0.0), _line(1.0)])
    feet, _ = assign_once(stations, _samples(_line(0.9)), own=np.zeros(39, np.int64))
    assert set(stations.line[feet.station]) == {0}
    feet, _ = assign_once(stations, _samples(_line(1.6)), own=np.zeros(39, np.int64))
    assert set(stations.line[feet.station]) == {1}
    # Where it lies far beside the line it does.
    stations = stations_of([_line(0.0)])
    samples = _samples(_line(0.0), _line(1.45))
    _, taken = assign_once(stations, replace(samples, score=sure), own=own)
    assert taken.tolist() == [True] * 39 + [False] * 39


def test_the_one_that_loses_goes_to_the_next_line() -> None:
    stations = stations_of([_line(0.0), _line(1.3)])
    samples = _samples(_line(0.1), _line(0.6))
    feet, taken = assign_once(stations, samples)
    assert taken.all()
    owner = stations.line[feet.station]
    assert set(owner[samples.detection[feet.sample] == 0]) == {0}
    assert set(owner[samples.detection[feet.sample] == 1]) == {1}


def test_lines_that_choose_first_leave_the_rest() -> None:
    stations = stations_of([_line(0.0), _line(0.6)])
    samples = _samples(_line(0.5))
    assert set(stations.line[assign_once(stations, samples)[0].station]) == {1}
    feet, _ = assign_once(stations, samples, first=stations.line == 0)
    assert set(stations.line[feet.station]) == {0}


def test_detections_one_behind_the_other_share_a_line() -> None:
    stations = stations_of([_line(0.0)])
    _, taken = assign_once(stations, _samples(_line(0.3, 0, 19), _line(-0.4, 20, 40)))
    assert taken.all()


def _island(width: float = 1.2) -> Array:
    """A closed outline 30 m long whose sides lie ``width`` apart."""
    x = np.linspace(0, 30, 31)
    there, back = np.stack([x, 0 * x], -1), np.stack([x[::-1], 0 * x + width], -1)
    return np.concatenate([there, back, there[:1]])


def test_a_chain_is_cut_where_it_folds() -> None:
    stations = stations_of([_island(), _line(9.0), _line(9.0, 40.0, 80.0)])
    strands = [set(stations.strand[stations.of_line(k)].tolist()) for k in range(3)]
    assert len(strands[0]) == 2 and strands[1] == strands[2] and len(strands[1]) == 1
    xy, strand = stations.xy[stations.of_line(0)], stations.strand[stations.of_line(0)]
    inner = (xy[:, 0] > 2) & (xy[:, 0] < 28)
    for y in (0.0, 1.2):
        assert len(set(strand[inner & (np.abs(xy[:, 1] - y) < 0.1)].tolist())) == 1


def test_a_detection_around_an_island_is_seen_on_both_sides() -> None:
    stations = stations_of([_island()])
    ring = _island(1.0) + [0.0, 0.3]
    at = np.linspace(0, len(ring) - 1, 20)
    seen = np.stack([np.interp(at, np.arange(len(ring)), ring[:, k]) for k in (0, 1)], -1)
    feet, taken = assign_once(stations, _samples(seen))
    assert taken.mean() > 0.9
    far = stations.xy[feet.station, 1] > 0.6
    assert 0.4 < far.mean() < 0.6 and np.quantile(np.abs(feet.offset), 0.95) < 0.45


def test_offsets_tell_how_far_stated_sigmas_are_off() -> None:
    rng = np.random.default_rng(0)
    stations = stations_of([_line(0.0)])
    seen = [_line(y) for y in rng.normal(0, 0.4, 60)]
    samples = _samples(*seen, frames=list(range(60)), sigma=0.2)
    assert np.median(offset_sigma(stations, samples)) == pytest.approx(0.4, rel=0.35)


def test_a_fit_finds_the_rate_of_the_votes() -> None:
    rng = np.random.default_rng(1)
    views = np.full((3, 300), 15.0)
    hits = rng.binomial(15, 0.75, views.shape).astype(float)
    hits[:, :12] = 0.0
    model = fitted(hits, views, VoteModel())
    assert model.found == pytest.approx(0.75, abs=0.05) and model.strength == 16.0
    # Without looks, or with few, nothing is learnt.
    assert fitted(hits[:, :0], views[:, :0], VoteModel()) == VoteModel()
    assert fitted(hits, np.zeros_like(views), VoteModel()) == VoteModel()


def test_a_surer_network_makes_a_miss_say_more() -> None:
    odds = []
    for found in (0.5, 0.8):
        model = VoteModel(found=found)
        odds.append(log_odds_of(drive_log_likelihoods(np.zeros(1), np.full(1, 10), model), model))
    assert odds[1] < odds[0] < 0


def test_sight_is_measured_and_better_seen_is_not_found_less() -> None:
    rng = np.random.default_rng(2)
    look = Look(rng.uniform(0, 38, 60_000), rng.uniform(0, 20, 60_000), rng.uniform(0, 18, 60_000))
    true = SightModel(distance=(1.0, 1.0, 0.9, 0.8, 0.7, 0.5, 0.4))
    found = rng.random(60_000) < 0.8 * true.weight(look)
    model = measured_sight(look, found)
    for name, knots in KNOTS.items():
        curve = np.array(getattr(model, name))
        assert np.abs(curve - getattr(true, name))[1:-1].max() < 0.1, name
        steps = np.diff(curve) * (-1 if name == "distance" else 1)
        assert (steps >= 0).all() and len(curve) == len(knots)
    nothing = Look(np.zeros(0), np.zeros(0), np.zeros(0))
    assert measured_sight(nothing, np.zeros(0, bool)) == SightModel()


def _rings(centres: list[tuple[float, float]], frames: list[int]) -> Rings:
    outline = open_ring(np.array([[-2, -4], [2, -4], [2, 4], [-2, 4], [-2, -4]], float))
    points = outline + np.array(centres)[:, None]
    n = len(points)
    return Rings(
        points, np.full(n, 0.1), np.ones(n), np.array(frames), np.zeros(n, bool), features(points)
    )


def test_one_frame_sees_a_crossing_once() -> None:
    places = _rings([(0.0, 0.0), (5.0, 0.0)], [0, 0]).points
    # The second lies nearer to the first place, which has a better detection.
    assert match(_rings([(0.2, 0.0), (2.3, 0.0)], [0, 0]), places).tolist() == [0, 1]
    assert match(_rings([(0.2, 0.0), (2.3, 0.0)], [0, 1]), places).tolist() == [0, 0]


def test_what_the_range_leaves_of_a_crossing_is_that_crossing() -> None:
    whole = open_ring(np.array([[0, 0], [20, 0], [20, 4], [0, 4], [0, 0]], float))
    seen = open_ring(np.array([[0, 2.6], [5, 2.6], [5, 6.6], [0, 6.6], [0, 2.6]], float))
    window = np.array([[[-30, -10], [5, -10], [5, 10], [-30, 10]]], float)
    ring = Rings(
        seen[None], np.full(1, 0.5), np.ones(1), np.zeros(1, int), np.zeros(1, bool),
        features(seen[None]), window,
    )  # fmt: skip
    assert match(ring, whole[None]).tolist() == [0]
    # A frame that had all of it in range would have seen more than its end.
    all_in_range = Rings(*(getattr(ring, n) for n in list(Rings.__dataclass_fields__)[:-1]))
    assert match(all_in_range, whole[None]).tolist() == [-1]
