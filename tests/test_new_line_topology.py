"""Where new lines begin, end and go on is told by the pieces in which detections come."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from fusion_scene import CRS, ORIGIN, drive, line
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.geometry.rings import close, open_ring
from rtmap_cli.logs.run_files import write_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.existence import probability
from rtmap_cli.maps.stations import Samples, samples_of
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.crowdsource.cut_rings import cut_offsets
from rtmap_cli.steps.detect_changes.bridges import _apart, _Runs, cut_beside
from rtmap_cli.steps.detect_changes.lines import joined_lines
from rtmap_cli.steps.detect_changes.twins import without_twins

Array = NDArray[np.float64]


def mapped(world: VectorMap, rtmap: Any, folder: Path, noise: float = 0.35) -> list[Element]:
    """The elements of a first map from four drives, relative to the origin."""
    for k in range(4):
        write_run(drive(world, f"d{k}", seed=k, noise=noise), folder / "runs" / f"d{k}")
    rtmap("crowdsource", folder / "runs", "--map", folder / "map")
    offset = [*ORIGIN, 0.0]
    return [e.with_points(e.points - offset, e.covariance) for e in read_map(folder / "map")]


def boundary(name: str, *corners: tuple[float, float]) -> Element:
    return Element(name, "boundary", ORIGIN + np.array(corners))


def test_a_gap_that_every_frame_shows_stays_open(rtmap: Any, tmp_path: Path) -> None:
    kerb = line("kerb", "boundary", 7.0)
    parts = line("west", "divider", 1.5, x1=50.0), line("east", "divider", 1.5, x0=55.0)
    found = mapped(VectorMap([kerb, *parts], CRS), rtmap, tmp_path)
    dividers = sorted((e.xy for e in found if e.class_name == "divider"), key=lambda p: p[0, 0])
    assert len(dividers) == 2
    assert dividers[0][:, 0].max() == pytest.approx(50.0, abs=1.2)
    assert dividers[1][:, 0].min() == pytest.approx(55.0, abs=1.2)


@pytest.mark.parametrize(("frames", "there"), [(None, True), (2, False)])
def test_what_lies_at_the_border_of_the_range_is_judged(
    rtmap: Any, tmp_path: Path, frames: int | None, there: bool
) -> None:
    """17 m beside the vehicle, a metre inside its range: seen by all frames, or by two of them."""
    world = VectorMap([line("kerb", "boundary", 7.0), line("far", "boundary", 15.0)], CRS)
    for k in range(2):
        run = drive(world, f"d{k}", seed=k)
        o = run.observations
        far = np.flatnonzero(o.points[..., 1].mean(axis=1) > 14.0)
        kept = far if frames is None else far[: frames * (k == 0)]
        keep = np.isin(np.arange(len(o)), np.setdiff1d(far, kept), invert=True)
        write_run(replace(run, observations=o.select(keep)), tmp_path / "runs" / f"d{k}")
    rtmap("crowdsource", tmp_path / "runs", "--map", tmp_path / "map")
    found = [e for e in read_map(tmp_path / "map") if e.xy[:, 1].mean() > ORIGIN[1] + 12]
    if there:
        assert [float(probability(e.existence)) > 0.9 for e in found] == [True]
    else:
        assert all(probability(e.existence) < 0.3 for e in found)


def test_a_line_in_one_piece_has_no_gap(rtmap: Any, tmp_path: Path) -> None:
    lines = line("kerb", "boundary", 7.0), line("paint", "divider", 1.5)
    found = mapped(VectorMap(lines, CRS), rtmap, tmp_path)
    assert [e.class_name for e in found].count("divider") == 1


def test_a_line_is_cut_where_the_end_of_another_lies_beside_it() -> None:
    """Of the two sides of a wall either may be the one that goes on."""
    x = np.linspace(0.0, 30.0, 31)
    on = np.stack([x, np.zeros(31)], axis=-1)
    side = np.stack([x[:11], np.full(11, 0.8)], axis=-1)
    across = np.stack([np.full(9, 20.0), np.linspace(-4.0, 4.0, 9)], axis=-1)
    west, east, *rest = cut_beside([on, side, across])
    assert west[-1] == pytest.approx([10.0, 0.0], abs=0.6) and np.array_equal(west[-1], east[0])
    assert west[0] == pytest.approx([0.0, 0.0]) and east[-1] == pytest.approx([30.0, 0.0])
    assert [len(r) for r in rest] == [11, 9]
    # Near its own end there is nothing to tell, nor where lines do not run alike.
    assert len(cut_beside([on[:14], side])) == 2 and len(cut_beside([on, across])) == 2


def test_pieces_that_the_range_makes_are_not_apart() -> None:
    """Four frames have a line at either of two ends; the way between is in view of two of them."""
    n = np.arange(8)
    runs = _Runs(
        line=n % 2, frame=n // 2, score=np.full(8, 0.5), whole=n, first=n, last=n,
        begin=np.where(n % 2, 1.0, 10.0), end=np.where(n % 2, 9.0, 19.0),
    )  # fmt: skip

    class TwoFrames:
        def clear(self, frame: Array, xy: Array, margin: float) -> Array:
            return np.where(frame < 2, 5.0, -1.0) + 0 * xy[..., 0]

    way = np.array([[0.0, 0.0], [3.0, 0.0]])
    far, near = 1, 2
    assert _apart(runs, far, near, np.full(2, 20.0), TwoFrames(), way) == pytest.approx(1.0)  # type: ignore[arg-type]


def test_a_boundary_goes_on_through_a_niche(rtmap: Any, tmp_path: Path) -> None:
    corners = [(-20.0, 6.0), (48.0, 6.0), (48.0, 11.0), (53.0, 11.0), (53.0, 6.0), (120.0, 6.0)]
    world = VectorMap([boundary("kerb", *corners), line("far", "boundary", -7.0)], CRS)
    found = mapped(world, rtmap, tmp_path)
    north = [e.xy for e in found if e.class_name == "boundary" and e.xy[:, 1].mean() > 0]
    assert len(north) == 1
    truth = shapely.LineString(corners)
    away = shapely.distance(shapely.points(north[0]), truth)
    assert np.quantile(away, 0.9) < 0.6 and north[0][:, 1].max() > 10.0


def test_an_island_that_detections_run_around_is_closed(rtmap: Any, tmp_path: Path) -> None:
    ring = [
        (40.0, 2.0),
        (58.0, 2.0),
        (59.0, 3.2),
        (58.0, 4.4),
        (40.0, 4.4),
        (39.0, 3.2),
        (40.0, 2.0),
    ]
    world = VectorMap([boundary("island", *ring), line("far", "boundary", -7.0)], CRS)
    found = mapped(world, rtmap, tmp_path, noise=0.2)
    islands = [e for e in found if e.xy[:, 1].mean() > 0]
    assert len(islands) == 1 and is_ring(islands[0].points)
    area = shapely.Polygon(islands[0].xy).area
    assert area == pytest.approx(shapely.Polygon(ring).area, rel=0.15)


@pytest.mark.parametrize("move", [(0.8, -0.5), (-0.6, 1.2), (0.0, 0.0)])
def test_a_crossing_that_the_range_cuts_tells_where_it_lies(move: tuple[float, float]) -> None:
    corners = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 12.0), (0.0, 12.0)])
    reference = open_ring(close(corners))
    window = np.array([(-30.0, -20.0), (30.0, -20.0), (30.0, 8.0), (-30.0, 8.0)])
    seen = shapely.Polygon(corners + move).intersection(shapely.Polygon(window))
    ring = open_ring(np.asarray(seen.exterior.coords))
    rows, offset, share = cut_offsets(ring[None], window[None], reference, np.array([4.0]))
    assert rows.tolist() == [0] and 0.35 < share[0] < 0.9
    assert np.abs(offset[0].mean(axis=0) - move).max() < 0.15
    # What stands elsewhere is not this one, and what is hardly in view says nothing.
    assert not len(cut_offsets(ring[None] + 9.0, window[None], reference, np.array([4.0]))[0])
    low = window - [0.0, 7.0]
    assert not len(cut_offsets(ring[None], low[None], reference, np.array([4.0]))[0])


def test_a_side_street_is_not_closed_by_specks() -> None:
    """Its kerbs end at the border of the range, where noise leaves specks of three metres."""
    left, right = straight((0.0, 0.0), (0.0, 30.0)), straight((5.0, 0.0), (5.0, 30.0))
    speck = straight((1.0, 30.5), (4.0, 31.0))
    kept = joined_lines([left, right, speck], "boundary")
    assert sorted(len(x) for x in kept) == sorted(len(x) for x in (left, right, speck))
    # A kerb that long is no speck: its corners are corners.
    across = straight((1.0, 30.5), (11.0, 31.5))
    assert len(joined_lines([left, across], "boundary")) == 1


def straight(a: tuple[float, float], b: tuple[float, float]) -> Array:
    """A line with a vertex every half metre."""
    count = round(float(np.hypot(b[0] - a[0], b[1] - a[1])) * 2) + 1
    return np.linspace(a, b, count)


def seen_as(*offsets: float, frames: int = 12) -> Samples:
    """Detections of a line from x = 0 to 40 in every frame, one for each offset."""
    x = np.linspace(0.0, 40.0, 20)
    parts = []
    for f in range(frames):
        for k, y in enumerate(offsets):
            own = y if len(offsets) > 1 else y * (-1) ** f
            points = np.stack([x, np.full_like(x, own)], axis=-1)[None]
            covariance = np.tile(np.eye(2) * 0.09, (1, len(x), 1, 1))
            found = samples_of(points, covariance, np.array([0.8]), np.array([f]))
            parts.append(replace(found, detection=found.detection + f * len(offsets) + k))
    names = ("detection", "xy", "tangent", "spacing", "covariance", "score", "frame")
    return Samples(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def test_of_two_lines_where_frames_see_one_one_stays() -> None:
    twins = [straight((0.0, 0.3), (40.0, 0.3)), straight((0.0, -0.3), (40.0, -0.3))]
    assert len(without_twins(twins, [], [seen_as(0.3)])) == 1
    assert len(without_twins(twins, [], [seen_as(0.3, -0.3)])) == 2
    # A short stretch beside a line may be the tip of something, and few frames tell nothing.
    short = [twins[0], straight((0.0, -0.3), (6.0, -0.3))]
    assert len(without_twins(short, [], [seen_as(0.3)])) == 2
    assert len(without_twins(twins, [], [seen_as(0.3, frames=4)])) == 2
