"""Log-odds, stretches, assignment and ridges: small cases with known answers."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rtmap_cli.geometry.rings import open_ring
from rtmap_cli.maps.existence import (
    VoteModel,
    drive_log_likelihoods,
    log_odds_of,
    logit,
    probability,
    runs_of,
    stretches,
)
from rtmap_cli.maps.stations import assign, chains_of, loose_stretches, samples_of, stations_of
from rtmap_cli.steps.detect_changes.crossings import Rings, features, match, new_rings
from rtmap_cli.steps.detect_changes.ridges import join_collinear, ridge_points, trace

MODEL = VoteModel()


def _odds(*drives: tuple[float, float]) -> float:
    votes = sum(drive_log_likelihoods(np.array(h), np.array(n), MODEL) for h, n in drives)
    return float(log_odds_of(votes, MODEL))


def test_never_looked_is_no_evidence() -> None:
    assert abs(_odds((0.0, 0.0))) < 1e-12


def test_misses_speak_against_and_hits_for_and_drives_add_up() -> None:
    silent, loud = (0.0, 10.0), (6.0, 10.0)
    assert _odds(silent) < 0 < _odds(loud)
    assert _odds(silent, silent) < _odds(silent)
    assert _odds(loud, loud) > _odds(loud)


def test_frames_of_one_drive_saturate() -> None:
    assert _odds((0.0, 1000.0)) == _odds((0.0, MODEL.most_views))
    # Two drives of ten frames say more than one of twenty.
    assert _odds((0.0, 10.0), (0.0, 10.0)) < _odds((0.0, 20.0))


def test_a_ghost_of_one_drive_loses_against_the_drives_that_do_not_see_it() -> None:
    ghost, silent = (5.0, 12.0), (0.0, 12.0)
    assert _odds(ghost) > 0 > _odds(ghost, silent, silent)


@given(st.floats(-12, 12))
def test_probability_and_logit_are_inverse(odds: float) -> None:
    assert abs(float(logit(probability(odds))) - odds) < 1e-6


def test_a_silent_stretch_is_cut_out_of_a_line() -> None:
    evidence = np.full(60, 3.0)
    evidence[20:40] = -4.0
    real = stretches(evidence, np.full(60, 1 / 8), 0.0, 2.0, ring=False)
    assert runs_of(~real)[0].tolist() == list(range(20, 40))
    # A dip shorter than one vote is noise.
    evidence = np.full(60, 3.0)
    evidence[30:33] = -3.0
    assert stretches(evidence, np.full(60, 1 / 8), 0.0, 2.0, ring=False).all()


def test_the_start_of_a_ring_is_no_special_place() -> None:
    evidence = np.full(60, 3.0)
    evidence[:10] = evidence[-10:] = -4.0
    real = stretches(evidence, np.full(60, 1 / 8), 0.0, 2.0, ring=True)
    gone = runs_of(~real, ring=True)
    assert len(gone) == 1 and set(gone[0]) == {*range(10), *range(50, 60)}


def _line(y: float, x0: float = 0.0, x1: float = 40.0) -> np.ndarray:
    x = np.linspace(x0, x1, 20)
    return np.stack([x, np.full_like(x, y)], axis=-1)


def _samples(*lines: np.ndarray) -> object:
    points = np.stack(lines)
    covariance = np.tile(np.eye(2) * 0.04, (*points.shape[:2], 1, 1))
    return samples_of(points, covariance, np.ones(len(lines)), np.zeros(len(lines), np.int64))


def test_each_detection_goes_to_one_line_only() -> None:
    stations = stations_of([_line(0.0), _line(1.1)])
    feet, taken = assign(stations, _samples(_line(0.3)))
    assert taken.all() and set(stations.line[feet.station]) == {0}
    assert np.allclose(feet.offset, 0.3)


def test_a_detection_over_two_lines_is_shared_and_its_rest_is_loose() -> None:
    stations = stations_of([_line(0.0, 0, 15), _line(0.0, 30, 40)])
    samples = _samples(_line(0.2))
    feet, taken = assign(stations, samples)
    assert set(stations.line[feet.station]) == {0, 1}
    assert len(np.unique(feet.sample)) == len(feet)
    loose = samples.xy[loose_stretches(samples, taken, 3.0), 0]
    assert 15 < loose.min() < 18.5 and 26.5 < loose.max() < 30


def test_pieces_that_share_an_end_are_one_chain_but_forks_are_not() -> None:
    a, b, c = _line(0.0, 0, 10), _line(0.0, 10, 20), _line(0.0, 50, 60)
    assert len(set(chains_of([a, b, c]).tolist())) == 2
    fork = np.array([[10.0, 0.0], [20.0, 8.0]])
    assert len(set(chains_of([a, b, fork]).tolist())) == 3
    ends = stations_of([a, b]).to_end
    assert ends.max() >= 9.9 and ends[0] == 0


def test_ridges_of_two_parallel_lines_are_traced_to_a_few_centimetres() -> None:
    cell = 0.2
    y, x = np.mgrid[0:120, 0:300] * cell + cell / 2
    field = np.exp(-0.5 * ((y - 8 - 0.05 * x) / 0.4) ** 2) + np.exp(
        -0.5 * ((y - 10 - 0.05 * x) / 0.4) ** 2
    )
    points = ridge_points(field, np.array([0, 0]), cell, 0.3, 0.1)
    lines = trace(points, 0.3, 3.0)
    assert len(lines) == 2
    for line, base in zip(sorted(lines, key=lambda p: p[:, 1].mean()), (8, 10), strict=True):
        inner = line[(line[:, 0] > 2) & (line[:, 0] < 58)]
        assert np.abs(inner[:, 1] - base - 0.05 * inner[:, 0]).max() < 0.05


def test_ends_that_look_at_each_other_are_joined_and_others_are_not() -> None:
    a, b = _line(0.0, 0, 20), _line(0.0, 25, 40)
    assert len(join_collinear([a, b], 6.0, 0.4)) == 1
    assert len(join_collinear([a, b], 4.0, 0.4)) == 2
    aside = _line(4.0, 22, 40)
    assert len(join_collinear([a, aside], 6.0, 0.4)) == 2


def test_ends_that_meet_at_a_corner_are_extended_to_it() -> None:
    a = _line(0.0, 0, 18)
    b = np.stack([np.full(20, 20.0), np.linspace(2, 20, 20)], axis=-1)
    joined = join_collinear([a, b], 3.0, 0.4, corner=4.0)
    assert len(joined) == 1
    assert np.hypot(*(joined[0] - [20.0, 0.0]).T).min() < 0.05


def ring(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])


def test_a_sliver_of_a_crossing_is_that_crossing() -> None:
    """The range may cut all but a corner off: far from the centre, small against the whole."""
    places = np.stack([open_ring(ring(0, 0, 4, 16)), open_ring(ring(30, 0, 34, 16))])
    pieces = [ring(0.2, 14.8, 2, 15.9), ring(12, 2, 16, 14), ring(31, 0.5, 33, 15)]
    points = np.stack([open_ring(p) for p in pieces])
    n = len(points)
    rings = Rings(
        points, np.ones(n), np.ones(n), np.zeros(n, int), np.ones(n, bool), features(points)
    )
    assert match(rings, places).tolist() == [0, -1, 1]


def _seen_at(centres: list[tuple[float, float]]) -> Rings:
    """Detections of a crossing of 4 by 8 m at some centres."""
    outline = open_ring(np.array([[-2, -4], [2, -4], [2, 4], [-2, 4], [-2, -4]], float))
    points = outline + np.array(centres)[:, None]
    n = len(points)
    return Rings(
        points, np.full(n, 0.25), np.full(n, 0.7), np.arange(n), np.zeros(n, bool), features(points)
    )


def test_a_crossing_that_a_drive_saw_a_little_off_is_one_candidate() -> None:
    one, other = _seen_at([(0.0, 0.0)] * 12), _seen_at([(2.3, -1.3)] * 10)
    found = new_rings(one.points[:0], [one, other])
    assert len(found) == 1
    assert np.hypot(*found[0].mean(axis=0)) < 2.0
    far = _seen_at([(6.0, 0.0)] * 10)
    assert len(new_rings(one.points[:0], [one, far])) == 2
