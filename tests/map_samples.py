"""Elements and maps for the tests of the map store."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from rtmap_cli.maps.element import Element, VectorMap

CRS = "EPSG:32617"
EAST, NORTH = 585_000.0, 4_478_000.0
"""A corner in Pittsburgh."""


def line(name: str, x: float = 0.0, y: float = 0.0, n: int = 5, **more: Any) -> Element:
    """A divider of ``n`` vertices, 10 m apart, starting x, y metres from the corner."""
    points = np.column_stack([EAST + x + 10.0 * np.arange(n), np.full(n, NORTH + y), np.zeros(n)])
    points[:, 2] = more.pop("z", 300.0)
    return Element(name, more.pop("class_name", "divider"), points, **more)


def crossing(name: str, x: float = 0.0, y: float = 0.0, **more: Any) -> Element:
    """A crossing of 4 × 8 m, turning to the left, without heights."""
    ring = np.array([[0, 0], [4, 0], [4, 8], [0, 8], [0, 0]]) + [EAST + x, NORTH + y]
    return Element(name, "ped_crossing", ring, **more)


def small_map(*more: Element) -> VectorMap:
    """Elements in three tiles."""
    covariance = np.column_stack([np.full(5, 0.01), np.full(5, 0.002), np.full(5, 0.02)])
    covariance = np.column_stack([covariance, [0.1, 0.1, np.nan, 0.1, 0.1]])
    evidence: dict[str, Any] = {
        "existence": 2.5,
        "seen": 7,
        "in_view": 9,
        "traversals": 2,
        "first_seen_ns": 1_767_600_000_123_456_789,
        "last_seen_ns": 1_767_700_000_123_456_789,
        "attributes": {"mark": "SOLID_WHITE", "colour": "weiß"},
        "runs": ("drive-1", "drive-2"),
        "model_sha256": "ab" * 32,
    }
    elements = [
        line("div-a", covariance=covariance, **evidence),
        line("div-b", x=1500.0, z=np.array([300.0, np.nan, 301, 302, np.nan])),
        line("bou-a", y=1800.0, class_name="boundary", z=np.nan),
        crossing("ped-a", x=20.0, y=10.0),
        *more,
    ]
    return VectorMap(elements, CRS)


def assert_same(first: VectorMap, second: VectorMap, atol: float = 0.0) -> None:
    """Both maps hold the same elements; vertices may differ by ``atol`` metres."""
    assert set(first.by_id()) == set(second.by_id())
    for element_id, a in first.by_id().items():
        b = second.by_id()[element_id]
        for field in fields(Element):
            x, y = getattr(a, field.name), getattr(b, field.name)
            if field.name == "points":
                np.testing.assert_allclose(x, y, rtol=0, atol=atol, equal_nan=True)
            elif field.name == "covariance" and x is not None:
                np.testing.assert_allclose(x, y, rtol=1e-7 if atol else 0, equal_nan=True)
            else:
                assert x == y, f"{element_id}: {field.name}"


def tile_files(folder: Path) -> list[Path]:
    """The tiles of a map folder."""
    return sorted((folder / "tiles").rglob("*.parquet"))


_text = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=8)


@st.composite
def elements(draw: st.DrawFn, element_id: str = "e") -> Element:
    """Any element within a few kilometres, heights and covariances known or not."""
    n = draw(st.integers(2, 6))
    metre = st.floats(-5e3, 5e3, allow_nan=False, width=32)
    xy = draw(st.lists(st.tuples(metre, metre), min_size=n, max_size=n))
    z = draw(st.lists(st.one_of(st.just(np.nan), metre), min_size=n, max_size=n))
    points = np.column_stack([np.array(xy) + [EAST, NORTH], z])
    name = draw(st.sampled_from(["divider", "boundary", "ped_crossing", "kerb"]))
    if name == "ped_crossing":
        around = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
        height = draw(st.sampled_from([np.nan, 12.5]))
        points = np.column_stack([points[0, :2] + 4 * around, np.full(5, height)])
    count = len(points)
    covariance = None
    if draw(st.booleans()):
        variance = st.floats(1e-6, 1.0)
        xx, yy = draw(variance), draw(variance)
        xy_ = draw(st.floats(-0.9, 0.9)) * np.sqrt(xx * yy)
        zz = draw(st.one_of(st.just(np.nan), variance))
        covariance = np.tile([xx, xy_, yy, zz], (count, 1))
    counts = st.integers(0, 10**6)
    time = st.one_of(st.none(), st.integers(0, 2**62))
    return Element(
        element_id,
        name,
        points,
        covariance,
        existence=draw(st.floats(-12, 12)),
        seen=draw(counts),
        in_view=draw(counts),
        traversals=draw(counts),
        first_seen_ns=draw(time),
        last_seen_ns=draw(time),
        attributes=draw(st.dictionaries(_text, _text, max_size=2)),
        runs=tuple(draw(st.lists(_text, max_size=2))),
        model_sha256=draw(st.one_of(st.none(), st.just("cd" * 32))),
    )


@st.composite
def maps(draw: st.DrawFn) -> VectorMap:
    """Any small map."""
    return VectorMap([draw(elements(f"e{k}")) for k in range(draw(st.integers(0, 4)))], CRS)
