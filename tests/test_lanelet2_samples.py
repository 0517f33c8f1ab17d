"""Real Lanelet2 and Autoware maps, and Lanelet2's own library as the judge of what is written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from sample_lanelet2 import street

from rtmap_cli.formats.lanelet2.osm import OsmFile, read_osm
from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps.crs import lonlat_to
from rtmap_cli.maps.store import read_map

Rtmap = Callable[..., Any]

CAMPUS = "gyor_campus/lanelet2_map.osm"
DRIVEN = "gyor_automapper_lightweight.osm"
SAMPLES: dict[str, dict[str, Any]] = {
    "mapping_example.osm": {"crs": "EPSG:32632", "lanelet": 363, "ped_crossing": 8, "area": 76},
    "autoware_vm_03_right_hand.osm": {"crs": "EPSG:32654", "lanelet": 63, "ped_crossing": 5},
    "autoware_cargo_transport_map.osm": {"crs": "EPSG:32654", "lanelet": 88},
    "autoware_bag2lanelet_example.osm": {"crs": "EPSG:32654", "lanelet": 1, "divider": 2},
    CAMPUS: {"crs": "EPSG:32633", "lanelet": 468, "untyped": 936},
    DRIVEN: {"crs": "EPSG:32633", "lanelet": 2, "untyped": 4},
}
CAMPUS_ORIGIN = (697_237.0, 5_285_644.0)
"""Of local coordinates, as the publisher of the campus map states it (UTM zone 33)."""


@pytest.fixture
def sample(rtmap_data: Path) -> Callable[[str], Path]:
    """``sample(name)``: a file of RTMAP_DATA/lanelet2; the test is skipped without it."""

    def find(name: str) -> Path:
        path = rtmap_data / "lanelet2" / name
        if not path.is_file():
            pytest.skip(f"{name} not found in RTMAP_DATA/lanelet2")
        return path

    return find


@pytest.fixture
def both_ways(rtmap: Rtmap, sample: Any, tmp_path: Path) -> Callable[[str], tuple[Path, Path]]:
    """``both_ways(name)``: a sample, and what import and export made of it."""

    def call(name: str) -> tuple[Path, Path]:
        path, out = sample(name), tmp_path / "out.osm"
        more = ["--crs", "EPSG:32633", "--origin", *CAMPUS_ORIGIN] if name == DRIVEN else []
        said = rtmap("import", "lanelet2", path, "-o", tmp_path / "map", *more, "--json")
        found = json.loads(said.out)
        for key, value in SAMPLES[name].items():
            assert (found["crs"] if key == "crs" else found["elements"][key]) == value
        rtmap("export", "lanelet2", tmp_path / "map", "-o", out)
        return path, out

    return call


def places(osm: OsmFile, crs: str, origin: tuple[float, float] | None) -> dict[int, Any]:
    """Node → x, y, ele by latitude and longitude, or by local_x, local_y from ``origin``."""
    height = [float(n.tags.get("ele", "nan")) for n in osm.nodes.values()]
    if origin is None:
        degrees = [(n.longitude, n.latitude) for n in osm.nodes.values()]
        xy = lonlat_to(crs, np.array(degrees))
    else:
        rows = [(float(n.tags["local_x"]), float(n.tags["local_y"])) for n in osm.nodes.values()]
        xy = np.array(rows) + origin
    return dict(zip(osm.nodes, np.column_stack([xy, height]), strict=True))


@pytest.mark.parametrize("name", list(SAMPLES))
def test_every_sample_comes_back(both_ways: Any, name: str) -> None:
    """Every way, relation, tag and id; nodes within 1 mm, heights known where they were."""
    path, out = both_ways(name)
    before, after = read_osm(path), read_osm(out)
    assert before.ways == after.ways
    assert before.relations == after.relations
    assert before.meta == after.meta
    local = "mapping" not in name
    crs = SAMPLES[name]["crs"]
    a, b = (places(o, crs, (0.0, 0.0) if local else None) for o in (before, after))
    used = sorted({n for way in before.ways.values() for n in way.nodes})
    old, new = np.stack([a[n] for n in used]), np.stack([b[n] for n in used])
    np.testing.assert_array_equal(np.isnan(old), np.isnan(new))
    assert np.nanmax(np.abs(old - new)) < 1e-3
    if name in (CAMPUS, DRIVEN):
        earth = places(after, crs, None)
        np.testing.assert_allclose(
            np.stack([earth[n][:2] for n in used]), old[:, :2] + CAMPUS_ORIGIN, atol=1e-3
        )


def test_a_map_without_a_place_on_earth_says_what_it_needs(
    rtmap: Rtmap, sample: Any, tmp_path: Path
) -> None:
    said = rtmap("import", "lanelet2", sample(DRIVEN), "-o", tmp_path / "map", code=3)
    assert "--crs and --origin" in said.err and said.err.count("\n") == 1
    assert not (tmp_path / "map").exists()


def test_heights_that_are_missing_stay_so(rtmap: Rtmap, sample: Any, tmp_path: Path) -> None:
    """The Karlsruhe map has heights at four of its 2,258 nodes."""
    rtmap("import", "lanelet2", sample("mapping_example.osm"), "-o", tmp_path / "map")
    heights = np.concatenate([e.points[:, 2] for e in read_map(tmp_path / "map")])
    assert np.isfinite(heights).any() and np.isnan(heights).mean() > 0.99


def test_campus_by_place(rtmap: Rtmap, sample: Any, tmp_path: Path) -> None:
    """The campus map has no types: the edges of its lanes are boundaries, what two lanes share is
    a divider, and what crosses junctions neither."""
    out = tmp_path / "map"
    rtmap("import", "lanelet2", sample(CAMPUS), "--untyped", "by-place", "-o", out)
    vector_map = read_map(out)
    metres = {
        name: sum(length(e.points) for e in vector_map.of_class(name))
        for name in ("boundary", "divider", "untyped")
    }
    # Streets of two lanes, mostly: two edges and a middle, which was drawn for each lane.
    assert 0.25 < metres["divider"] / metres["boundary"] < 0.5
    assert metres["untyped"] > metres["divider"]
    assert len(vector_map.of_class("boundary")) < 60, "joined end to end"
    rtmap("map", "validate", out, "--fail-on", "error")


def test_a_plain_extract_of_openstreetmap_is_refused(
    rtmap: Rtmap, rtmap_data: Path, tmp_path: Path
) -> None:
    path = rtmap_data / "osm" / "garching_intersection.osm"
    if not path.is_file():
        pytest.skip("garching_intersection.osm not found in RTMAP_DATA/osm")
    said = rtmap("import", "lanelet2", path, "-o", tmp_path / "map", code=3)
    assert "no Lanelet2 map" in said.err and not (tmp_path / "map").exists()


# ---- what Lanelet2 itself makes of the files


def load(path: Path) -> Any:
    """A file read by Lanelet2, the reasons for what it did not understand, its routing graph."""
    core = pytest.importorskip(
        "lanelet2.core", reason="the lanelet2 wheel is not installed (extra: dev)"
    )
    import lanelet2.io
    import lanelet2.projection
    import lanelet2.routing
    import lanelet2.traffic_rules as rules

    assert core is not None
    first = next(n for n in read_osm(path).nodes.values() if n.latitude == n.latitude)
    origin = lanelet2.io.Origin(round(first.latitude, 1), round(first.longitude, 1))
    found, errors = lanelet2.io.loadRobust(str(path), lanelet2.projection.UtmProjector(origin))
    cars = rules.create(rules.Locations.Germany, rules.Participants.Vehicle)
    return found, list(errors), lanelet2.routing.RoutingGraph(found, cars)


def relations(found: Any, graph: Any) -> dict[str, set[tuple[int, int]]]:
    """Which lanelets follow which, and which lie beside which."""
    lanes = list(found.laneletLayer)
    return {
        "following": {(a.id, b.id) for a in lanes for b in graph.following(a)},
        "besides": {(a.id, b.id) for a in lanes for b in graph.besides(a)},
        "conflicting": {(a.id, b.id) for a in lanes for b in graph.conflicting(a)},
    }


@pytest.mark.parametrize("name", [n for n in SAMPLES if n != DRIVEN])
def test_lanelet2_reads_the_same_map(both_ways: Any, name: str) -> None:
    path, out = both_ways(name)
    a, errors_a, graph_a = load(path)
    b, errors_b, graph_b = load(out)
    assert errors_a == errors_b, (
        "what Lanelet2 does not know (rules of Autoware) stays all there is"
    )
    for layer in ("laneletLayer", "lineStringLayer", "areaLayer", "regulatoryElementLayer"):
        assert {p.id for p in getattr(a, layer)} == {p.id for p in getattr(b, layer)}
    assert relations(a, graph_a) == relations(b, graph_b)
    if "bag2lanelet" not in name:  # its latitudes are rounded to a metre, ours are not
        far = [np.hypot(p.x - q.x, p.y - q.y) for p in b.pointLayer for q in [a.pointLayer[p.id]]]
        assert max(far) < 1e-3


def test_routes_lead_where_they_led(both_ways: Any) -> None:
    path, out = both_ways("autoware_cargo_transport_map.osm")
    (a, _, first), (b, _, second) = load(path), load(out)
    start = min(lane.id for lane in a.laneletLayer)
    ways = 0
    for goal in sorted(lane.id for lane in a.laneletLayer):
        old = first.getRoute(a.laneletLayer[start], a.laneletLayer[goal])
        new = second.getRoute(b.laneletLayer[start], b.laneletLayer[goal])
        assert (old is None) == (new is None)
        if old is not None and new is not None:
            ways += 1
            assert [p.id for p in old.shortestPath()] == [p.id for p in new.shortestPath()]
    assert ways > 5


def test_lanelet2_reads_what_is_new_and_what_was_cut(rtmap: Rtmap, tmp_path: Path) -> None:
    """Paint that goes leaves the lanes connected; a simulated town's crossings are lanelets."""
    path = street().write(tmp_path / "in.osm")
    old, _, graph = load(path)
    assert relations(old, graph)["following"] == {(201, 202), (203, 204)}
    rtmap("import", "lanelet2", path, "-o", tmp_path / "map")
    change = ["--change", "delete:divider", "--seed", 1]
    rtmap("simulate", "changes", "--map", tmp_path / "map", *change, "-o", tmp_path / "changed")
    rtmap("export", "lanelet2", tmp_path / "changed", "-o", tmp_path / "out.osm")
    new, errors, graph = load(tmp_path / "out.osm")
    assert relations(new, graph)["following"] == {(201, 202), (203, 204)}
    assert not errors and {lane.id for lane in new.laneletLayer} == {201, 202, 203, 204, 210}
    rtmap("simulate", "town", "--seed", 3, "--size", 200, "-o", tmp_path / "town")
    rtmap("export", "lanelet2", tmp_path / "town", "-o", tmp_path / "town.osm")
    town, errors, _ = load(tmp_path / "town.osm")
    crossings = read_map(tmp_path / "town").of_class("ped_crossing")
    assert not errors and len(town.laneletLayer) == len(crossings) > 0


@pytest.mark.parametrize("name", ["mapping_example.osm", "autoware_vm_03_right_hand.osm", CAMPUS])
def test_lanelet2_turns_bounds_the_same_way(
    rtmap: Rtmap, sample: Any, tmp_path: Path, name: str
) -> None:
    """Outlines run along the left bound forwards, as Lanelet2 aligns the bounds of a lanelet."""
    found, _, _ = load(sample(name))
    rtmap("import", "lanelet2", sample(name), "-o", tmp_path / "map")
    by_id = read_map(tmp_path / "map").by_id()
    checked = 0
    for lane in found.laneletLayer:
        element = by_id[f"lanelet-{lane.id}"]
        # Some lanelets of the campus are scribbles that cross themselves: they have no sides.
        if element.class_name == "lanelet" and shapely.Polygon(element.xy).is_valid:
            left = [p.id for p in lane.leftBound]
            ids = [int(n) for n in element.attributes["lanelet2:nodes"].split()]
            assert ids[: len(left)] == left, f"lanelet {lane.id}"
            checked += 1
    assert checked > 60
