"""``rtmap simulate degrade``: an error of the stated size, smooth, seeded, stated as covariance."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import read_map, write_new_map
from rtmap_cli.steps.simulate.worlds.degrade import smooth_error

ORIGIN = np.array([500_000.0, 5_400_000.0])


def test_the_error_has_its_size_and_length() -> None:
    rng = np.random.default_rng(0)
    at = rng.uniform(0, 5000, (3000, 2))
    draws = [(smooth_error(at, 0.2, 12.0, np.random.default_rng(k)),
              smooth_error(at + [12.0, 0.0], 0.2, 12.0, np.random.default_rng(k)))
             for k in range(5)]  # fmt: skip
    here, beside = (np.concatenate(d) for d in zip(*draws, strict=True))
    np.testing.assert_allclose(here.std(axis=0), 0.2, rtol=0.05)
    correlation = (here * beside).mean(axis=0) / 0.04
    np.testing.assert_allclose(correlation, np.exp(-0.5), atol=0.08)


def test_degrade_writes_a_map_that_says_how_wrong_it_is(
    rtmap: Callable[..., Any], tmp_path: Path
) -> None:
    line = np.column_stack([ORIGIN + [[0.0, 0.0], [400.0, 0.0]], [3.0, 5.0]])
    element = Element("d", "divider", line, attributes={"mark": "SOLID_WHITE"})
    exact = VectorMap([element], "EPSG:32632")
    write_new_map(exact, tmp_path / "map", "test")
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        rtmap("simulate", "degrade", "--map", tmp_path / "map", "--sigma", 0.3, "--seed", seed,
              "-o", tmp_path / name)  # fmt: skip
    (a,), (b,), (c,) = (read_map(tmp_path / n) for n in "abc")
    np.testing.assert_array_equal(a.points, b.points)
    assert np.abs(a.points - c.points).max() > 0.1
    assert np.diff(a.points[:, 0]).max() < 5.0 + 2.0
    np.testing.assert_allclose(a.covariance[:, [0, 2]], 0.09)
    assert 0.1 < np.abs(a.points[:, 1] - ORIGIN[1]).std() < 0.6
    assert a.attributes == {"mark": "SOLID_WHITE"} and a.points[:, 2].min() >= 3.0 - 1e-9
    again = rtmap("simulate", "degrade", "--map", tmp_path / "map", "-o", tmp_path / "a", code=2)
    assert "--overwrite" in again.err
