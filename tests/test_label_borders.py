"""Borders of lanes drawn to what was seen: which line, how sure, and where lanelets end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Result
from lane_drives import PLACE, write_drive
from numpy.typing import NDArray

from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.label.lanes.borders import Sides, Widths, borders_of, sides_of
from rtmap_cli.steps.label.lanes.cuts import cut_in_lanelets
from rtmap_cli.steps.label.lanes.graph import Edge, LaneGraph
from rtmap_cli.steps.label.lanes.snap import Evidence, snapped
from rtmap_cli.steps.label.lanes.traces import STEP
from rtmap_cli.steps.label.lanes.write import to_lanelet2
from rtmap_cli.steps.simulate.driving.drive import linked
from rtmap_cli.steps.simulate.driving.tours import tour_of
from rtmap_cli.steps.simulate.towns.town import make_town

Array = NDArray[np.float64]
Rtmap = Callable[..., Result]
PAINT, CURB = 1, 2
LONG = 200.0


def straight(long: float = LONG) -> LaneGraph:
    """One lane to the east."""
    x = np.arange(0.0, long + STEP / 2, STEP)
    return LaneGraph([Edge(0, 1, np.column_stack([x, 0 * x]) + PLACE, 8.0, 1)])


def line(y: float, kind: int, start: float = 0.0, end: float = LONG) -> tuple[Array, int]:
    """Returns of a line 0.1 m wide beside the lane, 20 a metre with 2 cm of noise."""
    rng = np.random.default_rng(round(abs(y) * 100) + kind)
    x = rng.uniform(start, end, int(20 * (end - start)))
    aside = y + rng.uniform(-0.05, 0.05, len(x)) + rng.normal(0, 0.02, len(x))
    return np.column_stack([x, aside]) + PLACE, kind


def evidence(*lines: tuple[Array, int]) -> Evidence:
    """What was seen."""
    xy = np.concatenate([p for p, _ in lines])
    kind = np.concatenate([np.full(len(p), k, np.int8) for p, k in lines])
    return Evidence(xy, kind, np.ones(len(xy)))


def drawn(*lines: tuple[Array, int], bound: float = 1.9) -> Sides:
    """The sides of the straight lane after snapping; index 0 is the left one."""
    graph = straight()
    return snapped(graph, sides_of(graph, Widths()), evidence(*lines), bound)[0]


@pytest.mark.parametrize("off", [1.3, 1.8, 3.0, 4.2, 4.8])
def test_a_line_within_the_bound_is_found_wherever_it_lies(off: float) -> None:
    got = drawn(line(off, PAINT), line(-off, CURB))
    assert (got.kind[:, 0] == PAINT).mean() > 0.98 and (got.kind[:, 1] == CURB).mean() > 0.98
    assert np.abs(got.metres - off).max() < 0.06


def test_what_lies_beyond_the_bound_is_not_taken() -> None:
    got = drawn(line(4.4, PAINT), line(-1.7, PAINT), bound=1.0)
    assert not got.kind[:, 0].any() and np.allclose(got.metres[:, 0], Widths().both)
    assert not got.kind[:, 1].any()


def test_a_double_line_has_its_middle() -> None:
    got = drawn(line(1.7, PAINT), line(1.95, PAINT))
    assert (got.kind[:, 0] == PAINT).mean() > 0.98
    assert np.abs(np.median(got.metres[:, 0]) - 1.825) < 0.03


def test_where_the_near_line_ends_the_far_one_goes_on() -> None:
    got = drawn(line(1.6, PAINT, 0, 100), line(4.2, CURB))
    x = np.arange(len(got.metres)) * STEP
    assert np.abs(got.metres[x < 95, 0] - 1.6).max() < 0.06
    assert np.abs(got.metres[x > 105, 0] - 4.2).max() < 0.06
    assert (got.kind[np.abs(x - 100) < 3, 0] == 0).any(), "on its way across it was not seen"
    assert np.abs(np.diff(got.metres[:, 0])).max() / STEP < 1.0, "no step"


def test_gaps_are_bridged_and_open_stretches_are_not() -> None:
    dashes = [line(1.7, PAINT, a, a + 3) for a in np.arange(0, 100, 7.5)]
    got = drawn(*dashes, line(1.7, PAINT, 160, LONG))
    x = np.arange(len(got.metres)) * STEP
    assert (got.kind[x < 98, 0] == PAINT).mean() > 0.95
    assert not got.kind[(x > 108) & (x < 155), 0].any()


def test_grass_is_no_line() -> None:
    rng = np.random.default_rng(1)
    grass = np.column_stack([rng.uniform(0, LONG, 40_000), rng.uniform(1.2, 5.5, 40_000)]) + PLACE
    got = drawn((grass, CURB), line(-1.7, CURB))
    assert got.kind[:, 0].mean() < 0.1 and (got.kind[:, 1] == CURB).all()


def test_lanelets_end_where_a_border_changes_for_long() -> None:
    graph = straight()
    x = np.arange(len(graph.edges[0].xy)) * STEP
    left = np.select([x < 60, x < 63, x < 120], [PAINT, 0, PAINT], CURB)
    right = np.where(np.abs(x - 150) < 20, 0, CURB)
    kind = np.column_stack([left, right]).astype(np.int8)
    cut, sides = cut_in_lanelets(graph, [Sides(np.full(kind.shape, 2.0), kind)], 80.0)
    ends = np.cumsum([len(e.xy) - 1 for e in cut.edges]) * STEP
    # 3 m of nothing are too short; 120 paint to curb, 130 and 170 of the right, else 80 m at most.
    assert np.allclose(ends, [60, 120, 130, 170, 200], atol=1.0)
    assert all(a.end == b.start for a, b in zip(cut.edges, cut.edges[1:], strict=False))
    assert sum(len(s.metres) - 1 for s in sides) == len(kind) - 1


def test_what_was_not_seen_says_so_in_the_map() -> None:
    graph = straight()
    sides = drawn(line(1.7, PAINT, 0, 100), line(-2.0, CURB))
    cut, parts = cut_in_lanelets(graph, [sides], 100.0)
    made = to_lanelet2(cut, borders_of(cut, parts), "EPSG:32632", None, looked=True)
    ways = [e for e in made.vector_map if e.class_name != "lanelet"]
    told = {(e.class_name, e.attributes["rtmap:border"]) for e in ways}
    assert told == {("divider", "paint"), ("boundary", "curb"), ("virtual", "width")}
    for e in ways:
        assert e.covariance is not None
        sigma = np.sqrt(e.covariance[:, 0])
        assert np.isnan(e.covariance[:, 3]).all()
        if e.class_name == "virtual":
            assert np.median(sigma) > 1.0
        else:
            assert np.median(sigma) < 0.1


def test_a_border_that_a_node_draws_aside_is_not_seen_there() -> None:
    graph = straight(100.0)
    first = graph.edges[0]
    second = Edge(1, 2, first.xy + [100.0, 0.0], 8.0, 1)
    graph = LaneGraph([first, second])
    n = len(first.xy)
    seen = np.full((n, 2), CURB, np.int8)
    parts = [Sides(np.full((n, 2), 1.6), seen), Sides(np.full((n, 2), 4.2), seen)]
    got = borders_of(graph, parts)
    assert (got[0].kinds[0] == CURB).all(), "the nearest line is the lane's own"
    x = got[1].lines[0][:, 0] - PLACE[0] - 100.0
    assert not got[1].kinds[0][x < 5].any() and (got[1].kinds[0][x > 10] == CURB).all()
    assert np.allclose(got[0].lines[0][-1], got[1].lines[0][0])


def test_a_tour_with_forks_merges_and_a_roundabout_loads_and_routes(
    rtmap: Rtmap, tmp_path: Path
) -> None:
    lanelet2 = pytest.importorskip("lanelet2")
    town = make_town(2, 350.0, style="campus")
    tour = tour_of(linked(town.lanes), 1500.0, 0, 0)[::2, :2]
    log = write_drive(tmp_path / "log", tour - PLACE)
    rtmap("label", "lanes", log, "-o", tmp_path / "map", "--centrelines", tmp_path / "g.geojson")
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "map.osm")
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(48.75, 9.0))
    loaded, errors = lanelet2.io.loadRobust(str(tmp_path / "map.osm"), projector)
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    lanes = list(loaded.laneletLayer)
    made = [e for e in read_map(tmp_path / "map") if e.class_name == "lanelet"]
    assert not errors and len(lanes) == len(made)
    assert sum(len(graph.following(x)) > 1 for x in lanes) == 2
    assert sum(len(graph.previous(x)) > 1 for x in lanes) == 2
    # One drive: from its first lanelet every other one is reached.
    start = [x for x in lanes if not graph.previous(x)]
    first = start[0] if start else lanes[0]
    reached = {x.id for x in graph.reachableSet(first, 1e5, 0)}
    assert reached == {x.id for x in lanes}
    assert all(graph.getRoute(first, x) is not None for x in lanes)
