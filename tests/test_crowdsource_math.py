"""The closed forms of the fusion: full covariances, one vote per drive, rings."""

from __future__ import annotations

import numpy as np

from rtmap_cli.geometry.rings import align, open_ring
from rtmap_cli.maps.refit import DriveOffsets, FusionModel, combine, measured_share, solve_vertices
from rtmap_cli.maps.stations import stations_of

MODEL = FusionModel(place_share=0.0, floor=0.0, huber=1e9)


def _drive(offset: float, variance: float, frames: float = 1.0, n: int = 3) -> DriveOffsets:
    return DriveOffsets(*(np.full(n, v) for v in (offset, variance, frames, 0.0)))


def test_drives_combine_by_information() -> None:
    offset, variance = combine([_drive(1.0, 0.1), _drive(0.0, 0.3)], 1.0, MODEL)
    assert np.allclose(offset, (1 / 0.1) / (1 / 0.1 + 1 / 0.3))
    assert np.allclose(variance, 1 / (1 / 0.1 + 1 / 0.3))


def test_frames_of_one_drive_do_not_average_out_what_they_share() -> None:
    _, once = combine([_drive(0.0, 0.2, frames=1)], 0.5, MODEL)
    _, often = combine([_drive(0.0, 0.2, frames=1e9)], 0.5, MODEL)
    assert np.allclose(once, 0.2) and np.allclose(often, 0.1)
    _, four = combine([_drive(0.0, 0.2, frames=1e9)] * 4, 0.5, MODEL)
    assert np.allclose(four, 0.1 / 4)


def test_sigma_never_falls_below_repeatability() -> None:
    model = FusionModel()
    _, variance = combine([_drive(0.0, 1e-6)] * 1000, 0.5, model)
    assert (variance >= model.floor**2).all()


def test_one_drive_that_is_far_off_hardly_moves_the_mean() -> None:
    good = [_drive(0.0, 0.01) for _ in range(4)]
    plain, _ = combine([*good, _drive(1.4, 0.01)], 1.0, MODEL)
    robust, _ = combine([*good, _drive(1.4, 0.01)], 1.0, FusionModel(huber=1.5))
    assert np.all(robust < plain / 3)


def test_unseen_stations_stay_unknown() -> None:
    offset, variance = combine([_drive(np.nan, np.nan, 0)], 0.5, MODEL)
    assert np.isnan(offset).all() and np.isinf(variance).all()


def test_the_share_of_a_drive_is_measured_where_drives_overlap() -> None:
    rng = np.random.default_rng(0)
    wanted = 0.8
    drives = [
        DriveOffsets(
            rng.normal(0, np.sqrt(wanted * 0.2), 4000),
            np.full(4000, 0.2),
            np.full(4000, 1e9),
            np.zeros(4000),
        )
        for _ in range(6)
    ]
    assert abs(measured_share(drives, FusionModel(floor=0.0)) - wanted) < 0.12
    assert measured_share(drives[:1], MODEL) == MODEL.drive_share


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
