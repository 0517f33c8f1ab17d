"""Which stations lie near points: the grid against a search among all of them."""

import numpy as np

from rtmap_cli.geometry.keys import packed
from rtmap_cli.maps import nearby as grid
from rtmap_cli.maps.stations import GATE, MIN_COS, STEP, candidate_feet, samples_of, stations_of


def _lines(rng):
    t = np.linspace(0, 1, 60)
    out = []
    for k in range(12):
        start, bend = rng.uniform(0, 120, 2), rng.uniform(-1.5, 1.5)
        heading = rng.uniform(-np.pi, np.pi) + bend * t
        step = np.stack([np.cos(heading), np.sin(heading)], -1) * (0.4 + 0.1 * k)
        out.append(start + np.cumsum(step, axis=0))
    return out


def _samples(rng, lines):
    points = np.stack([x[5:45:2] + rng.normal(0, 0.4, 2) for x in lines for _ in range(3)])
    n = len(points)
    covariance = np.tile(np.eye(2) * 0.1, (n, points.shape[1], 1, 1))
    return samples_of(points, covariance, np.full(n, 0.8), np.arange(n))


def test_feet_are_those_of_a_full_search(monkeypatch):
    rng = np.random.default_rng(3)
    lines = _lines(rng)
    for most in (grid.MOST, 0):
        monkeypatch.setattr(grid, "MOST", most)
        stations, samples = stations_of(lines), _samples(rng, lines)
        d = samples.xy[:, None] - stations.xy
        along = (d * stations.tangent).sum(-1)
        offset = (d * stations.normal).sum(-1)
        cosine = np.abs((samples.tangent[:, None] * stations.tangent).sum(-1))
        ok = (np.abs(offset) <= GATE) & (np.abs(along) <= STEP) & (cosine >= MIN_COS)
        far = np.where(ok, along**2 + offset**2, np.inf)
        exact = {}
        for i, j in np.argwhere(ok):
            key = i, stations.chain[j]
            exact[key] = min(exact.get(key, (np.inf, 0)), (far[i, j], j))
        i, j, got, _ = candidate_feet(stations, samples, GATE)
        pairs = list(zip(i.tolist(), stations.chain[j].tolist(), strict=True))
        assert len(set(pairs)) == len(pairs) and set(pairs) <= set(exact)
        # Beside bends and ends the step along the line may land one station off.
        same = [exact[p][1] == k for p, k in zip(pairs, j.tolist(), strict=True)]
        assert np.mean(same) > 0.98 and len(pairs) > 0.99 * len(exact)
        assert np.allclose(got, offset[i, j])


def test_points_elsewhere_find_nothing():
    stations = stations_of([np.array([[0.0, 0.0], [20.0, 0.0]])])
    i, j, *_ = stations.near(GATE).feet(np.array([[1e7, 0.0], [10.2, 0.3], [0.0, -50.0]]))
    assert i.tolist() == [1] and j.tolist() == [10]


def test_rows_packed_into_one_number_keep_their_order():
    rows = np.array([[0, -3, 9], [0, 2, -9], [1, -3, 0], [0, -3, 9]])
    order = np.lexsort(rows.T[::-1])
    assert np.argsort(packed(*rows.T), kind="stable").tolist() == order.tolist()
    assert packed(*rows[:0].T).tolist() == []
