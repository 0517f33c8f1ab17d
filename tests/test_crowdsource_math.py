"""The closed forms of the fusion: full covariances, one vote per drive, rings."""

from __future__ import annotations

import numpy as np

from rtmap_cli.geometry.rings import align, open_ring
from rtmap_cli.maps.consensus import Sightings, along, consensus
from rtmap_cli.maps.refit import FusionModel, solve_vertices
from rtmap_cli.maps.stations import stations_of

MODEL = FusionModel()
EXACT = FusionModel(floor=1e-6, huber=1e9)
"""Without repeatability and without robust weights: what the equation says."""


def _drive(
    offset: object, sigma: object, way: object = None, pose: float = 0.0, score: float = 1.0
) -> Sightings:
    """Frames of one drive at one station."""
    offset = np.atleast_1d(np.asarray(offset, float))
    n = len(offset)
    driven = np.arange(n) * 2.5 if way is None else np.asarray(way, float)
    return Sightings(
        np.zeros(n, np.int64),
        driven,
        offset[:, None],
        np.broadcast_to(np.asarray(sigma, float), n).copy(),
        np.ones(n),
        np.full(n, score),
        np.full(n, pose),
    )


def _covariance(drives: list[Sightings], model: FusionModel) -> np.ndarray:
    """Of all offsets, written down as the model says it."""
    sigma = np.concatenate([d.sigma for d in drives])
    way = np.concatenate([d.way for d in drives])
    drive = np.concatenate([np.full(len(d), k) for k, d in enumerate(drives)])
    pose = np.concatenate([d.pose for d in drives]) + model.floor**2
    same = drive[:, None] == drive[None]
    fade = np.exp(-np.abs(way[:, None] - way[None]) / model.memory_m)
    share = model.place_share + same * (model.drive_share + model.memory_share * fade)
    out = np.outer(sigma, sigma) * share + same * pose[:, None]
    return out + np.diag(model.own_share * sigma**2)


def test_the_consensus_is_the_generalised_least_squares_answer() -> None:
    rng = np.random.default_rng(3)
    drives = [
        _drive(rng.normal(0, 0.3, n), rng.uniform(0.1, 0.8, n), rng.uniform(0, 40, n).cumsum())
        for n in (7, 1, 12)
    ]
    place, variance = consensus(drives, 1, EXACT)
    inverse = np.linalg.inv(_covariance(drives, EXACT))
    offset = np.concatenate([d.offset[:, 0] for d in drives])
    # The scale of all sigmas is measured; it changes the variance, not the place.
    assert abs(place[0, 0] - (inverse @ offset).sum() / inverse.sum()) < 1e-5
    assert variance[0] > 0.95 / inverse.sum()


def test_an_error_that_goes_with_sigma_is_told_from_the_line() -> None:
    sigma = np.array([0.2, 0.3, 0.5, 0.8, 0.5, 0.3])
    drives = [_drive(0.1 + b * sigma, sigma) for b in (0.6, 0.4, 0.9)]
    place, _ = consensus(drives, 1, EXACT)
    mean = np.mean([d.offset.mean() for d in drives])
    assert abs(place[0, 0] - 0.1) < 0.05 < abs(mean - 0.1)


def test_a_drive_whose_poses_are_unsure_counts_for_less() -> None:
    sure, unsure = _drive(np.zeros(9), 0.3, pose=0.001), _drive(np.ones(9), 0.3, pose=1.0)
    assert consensus([sure, unsure], 1, EXACT)[0][0, 0] < 0.15
    assert consensus([unsure], 1, EXACT)[1][0] > 1.0


def test_frames_of_one_drive_do_not_average_out_what_they_share() -> None:
    one = consensus([_drive(np.zeros(50), 0.4)], 1, MODEL)[1][0]
    four = consensus([_drive(np.zeros(50), 0.4) for _ in range(4)], 1, MODEL)[1][0]
    many = consensus([_drive(np.zeros(200), 0.4, np.arange(200) * 0.6)], 1, MODEL)[1][0]
    assert four < 0.6 * one and many > 0.9 * one


def test_a_car_that_stands_sees_nothing_new() -> None:
    moving = consensus([_drive(np.zeros(30), 0.4)], 1, MODEL)[1][0]
    standing = consensus([_drive(np.zeros(30), 0.4, np.zeros(30))], 1, MODEL)[1][0]
    assert standing > moving


def test_sigma_never_falls_below_repeatability() -> None:
    _, variance = consensus([_drive(np.zeros(20), 0.01) for _ in range(100)], 1, MODEL)
    assert (variance >= MODEL.floor**2).all()


def test_one_drive_that_is_far_off_hardly_moves_the_consensus() -> None:
    good = [_drive(np.zeros(8), 0.1) for _ in range(4)]
    far = _drive(np.full(8, 1.4), 0.1)
    plain, _ = consensus([*good, far], 1, EXACT)
    robust, _ = consensus([*good, far], 1, MODEL)
    assert robust[0, 0] < plain[0, 0] / 3


def test_unseen_stations_stay_unknown() -> None:
    offset, variance = consensus([_drive(np.zeros(0), 1.0)], 3, MODEL)
    assert np.isnan(offset).all() and np.isinf(variance).all()
    offset, variance = consensus([_drive(np.zeros(4), 1.0)], 3, MODEL)
    assert np.isfinite(offset[0]).all() and np.isnan(offset[1:]).all()


def test_neighbours_tell_of_the_error_that_they_share() -> None:
    line = np.stack([np.linspace(0, 60, 61), np.zeros(61)], axis=-1)
    stations = stations_of([line])
    rng = np.random.default_rng(0)
    n, sigma = len(stations), np.array([0.2, 0.35, 0.6])
    rows = np.repeat(np.arange(n), 3)
    noise = np.concatenate([0.5 * sigma + rng.normal(0, 0.3, 3) * sigma for _ in range(n)])
    drive = Sightings(
        rows, np.tile([0.0, 15, 30], n), noise[:, None], np.tile(sigma, n), *np.ones((2, 3 * n)),
        np.zeros(3 * n),
    )  # fmt: skip
    alone, _ = consensus([drive], n, MODEL)
    pooled, _ = consensus([drive], n, MODEL, along(stations, MODEL.shared_m))
    assert np.abs(pooled).mean() < 0.8 * np.abs(alone).mean()


def test_on_a_straight_line_a_vertex_moves_across_only() -> None:
    line = np.stack([np.linspace(0, 40, 9), np.zeros(9)], axis=-1)
    stations = stations_of([line])
    n = len(stations)
    prior = np.tile(np.eye(2) * 0.09, (9, 1, 1))
    move, after = solve_vertices(
        line, np.zeros(9, np.int64), prior, stations, np.full(n, 0.3), np.full(n, 0.01), 1.5
    )
    assert np.allclose(move[:, 0], 0) and np.allclose(move[:, 1], 0.3 * 0.09 / (0.09 + 0.01))
    assert np.allclose(after[:, 0, 0], 0.09) and np.allclose(after[:, 1, 1], 0.009)


def test_at_a_corner_a_vertex_is_fixed_in_full() -> None:
    corner = np.array([[-20.0, 0.0], [0.0, 0.0], [0.0, 20.0]])
    moved = corner + [0.4, -0.2]
    stations = stations_of([corner])
    # Offsets to the left of each leg that the displaced corner shows.
    offset = (stations.normal * [0.4, -0.2]).sum(axis=1)
    move, _ = solve_vertices(
        corner,
        np.zeros(3, np.int64),
        np.tile(np.eye(2) * 100.0, (3, 1, 1)),
        stations,
        offset,
        np.full(len(stations), 0.01),
        1.5,
    )
    assert np.allclose(corner[1] + move[1], moved[1], atol=0.02)


def test_vertices_that_two_pieces_share_stay_together() -> None:
    a = np.stack([np.linspace(0, 20, 5), np.zeros(5)], axis=-1)
    b = np.stack([np.linspace(20, 40, 5), np.linspace(0, 4, 5)], axis=-1)
    stations = stations_of([a, b])
    rng = np.random.default_rng(1)
    vertices = np.concatenate([a, b])
    chain = np.full(10, stations.chain[0])
    move, _ = solve_vertices(
        vertices,
        chain,
        np.tile(np.eye(2), (10, 1, 1)),
        stations,
        rng.normal(0, 0.2, len(stations)),
        np.full(len(stations), 0.02),
        1.5,
    )
    assert np.allclose(vertices[4] + move[4], vertices[5] + move[5])


def test_rings_are_aligned_whatever_their_start_and_direction() -> None:
    square = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 4.0], [0.0, 4.0], [0.0, 0.0]])
    reference = open_ring(square)
    turned = open_ring(np.roll(square[:-1], 2, axis=0)[::-1])
    assert np.abs(align(turned, reference) - reference).max() < 0.11
