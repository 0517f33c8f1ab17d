"""GeoJSON in and out: round trips, the fleet's prior maps, and one line for what is wrong."""

from __future__ import annotations

import copy
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from map_samples import CRS, assert_same, crossing, line, maps, small_map

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.features import counter_clockwise, feature
from rtmap_cli.formats.geojson import element_feature, read_geojson, write_geojson
from rtmap_cli.maps.element import VectorMap

LONLAT = [[-80.0, 40.44], [-80.0001, 40.4401], [-80.0002, 40.44]]


def one(**changes: Any) -> dict[str, Any]:
    """A collection with one divider; ``changes`` go to the feature, its properties, geometry."""
    properties = {"id": "div-1", "class": "divider"} | changes.pop("properties", {})
    geometry = {"type": "LineString", "coordinates": LONLAT} | changes.pop("geometry", {})
    item = {"type": "Feature", "properties": properties, "geometry": geometry} | changes
    return {"type": "FeatureCollection", "features": [item]}


def read(tmp_path: Path, value: Any, crs: str | None = CRS) -> VectorMap:
    path = tmp_path / "in.geojson"
    path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return read_geojson(path, crs)


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(maps())
def test_round_trip(tmp_path: Path, vector_map: VectorMap) -> None:
    write_geojson(vector_map, tmp_path / "out.geojson")
    back = read_geojson(tmp_path / "out.geojson", CRS)
    assert_same(vector_map, back, atol=5e-4)


def test_round_trip_of_everything(tmp_path: Path) -> None:
    write_geojson(small_map(), tmp_path / "out.geojson")
    assert_same(small_map(), read_geojson(tmp_path / "out.geojson"), atol=2e-4)
    lines = (tmp_path / "out.geojson").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + 4 + 1  # head, one line per feature, end
    by_id = {f["id"]: f for f in json.loads("\n".join(lines))["features"]}
    div = by_id["div-a"]["properties"]
    assert div["mark"] == "SOLID_WHITE" and div["existence"] == 2.5 and div["seen"] == 7
    assert div["sigma_m"] == pytest.approx([np.sqrt(0.015)] * 5)
    assert div["covariance_m2"][2] == [0.01, 0.002, 0.02, None]
    assert by_id["ped-a"]["geometry"]["type"] == "Polygon"
    assert by_id["bou-a"]["properties"] == {"id": "bou-a", "class": "boundary"}
    heights = [len(p) for p in by_id["div-b"]["geometry"]["coordinates"]]
    assert heights == [3, 2, 3, 3, 2]  # unknown is absent, never 0


def test_same_map_same_bytes(tmp_path: Path) -> None:
    write_geojson(small_map(), tmp_path / "a.geojson")
    write_geojson(small_map(), tmp_path / "b.geojson")
    assert (tmp_path / "a.geojson").read_bytes() == (tmp_path / "b.geojson").read_bytes()


def test_fleet_priors_round_trip(tmp_path: Path, rtmap_golden: Path) -> None:
    files = sorted(rtmap_golden.glob("fleet/*/*/prior.geojson"))
    assert files
    for path in files:
        vector_map = read_geojson(path, CRS)
        source = json.loads(path.read_text(encoding="utf-8"))["features"]
        assert [e.element_id for e in vector_map] == [f["properties"]["id"] for f in source]
        for element, item in zip(vector_map, source, strict=True):
            assert element.covariance is not None
            sigma = np.sqrt(element.covariance[:, 0])
            np.testing.assert_allclose(sigma, item["properties"]["sigma_m"])
            assert element.attributes.get("mark") == item["properties"].get("mark")
        write_geojson(vector_map, tmp_path / "out.geojson")
        assert_same(vector_map, read_geojson(tmp_path / "out.geojson"), atol=1e-3)


def test_crs_of_the_data_centre(tmp_path: Path) -> None:
    assert read(tmp_path, one(), None).crs == "EPSG:32617"
    south = [[18.4, -33.9], [18.4001, -33.9]]
    assert read(tmp_path, one(geometry={"coordinates": south}), None).crs == "EPSG:32734"


def test_polygons_and_parts(tmp_path: Path) -> None:
    outer = [[0, 0], [0.001, 0], [0.001, 0.001], [0, 0.001], [0, 0]]
    hole = [[0.0002, 0.0002], [0.0002, 0.0004], [0.0004, 0.0004], [0.0002, 0.0002]]
    shape = {"type": "Polygon", "coordinates": [outer, hole]}
    found = read(tmp_path, one(geometry=shape, properties={"class": "boundary"}), None)
    assert [(e.element_id, e.ring) for e in found] == [("div-1-0", True), ("div-1-1", True)]
    two = {"type": "MultiLineString", "coordinates": [LONLAT, LONLAT[:2]]}
    sigma = {"sigma_m": [0.1, 0.2, 0.3, 0.4, 0.5]}
    found = read(tmp_path, one(geometry=two, properties=sigma))
    assert [e.element_id for e in found] == ["div-1-0", "div-1-1"]
    assert found.elements[1].covariance is not None
    np.testing.assert_allclose(found.elements[1].covariance[:, 0], [0.16, 0.25])
    many = {"type": "MultiPolygon", "coordinates": [[outer], [outer]]}
    found = read(tmp_path, one(geometry=many, properties={"class": "ped_crossing"}), None)
    assert len(found) == 2 and all(e.ring for e in found)


def test_what_other_tools_write(tmp_path: Path) -> None:
    item = one()["features"][0]
    # A bare feature, an id beside the properties, values that are no text, a BOM-free z.
    item = item | {"id": 17, "properties": {"class": "kerb", "lanes": 2, "paved": True, "x": None}}
    item["geometry"] = {"type": "LineString", "coordinates": [[-80, 40, 300], [-80, 40.1]]}
    (element,) = read(tmp_path, item)
    assert (element.element_id, element.class_name) == ("17", "kerb")
    assert element.attributes == {"lanes": "2", "paved": "true"}
    assert element.points[0, 2] == 300 and np.isnan(element.points[1, 2])
    nameless = {"type": "Feature", "properties": {"class": "a"}, "geometry": item["geometry"]}
    assert read(tmp_path, nameless).elements[0].element_id == "feature-0"
    scalar = read(tmp_path, one(properties={"sigma_m": 0.2})).elements[0]
    np.testing.assert_allclose(scalar.covariance[:, [0, 2]], 0.04)  # type: ignore[index]
    crs84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    assert len(read(tmp_path, one() | {"crs": crs84})) == 1


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ("{", "cannot be read as JSON"),
        ("[]", "not a GeoJSON FeatureCollection"),
        ({"type": "FeatureCollection", "features": 3}, "not a GeoJSON FeatureCollection"),
        ({"type": "FeatureCollection", "features": [3]}, "feature 0 is not a GeoJSON Feature"),
        (one(properties={"class": None}), "div-1: it has no class"),
        (one(geometry={"type": "Point", "coordinates": [0, 0]}), "div-1: geometry Point"),
        (one(geometry={"type": None}), "div-1: geometry null"),
        (one(geometry={"coordinates": [[-80, 40]]}), "div-1: a line needs two"),
        (one(geometry={"coordinates": [[-80, 40], ["a", 1]]}), "div-1: a position is not"),
        (one(geometry={"coordinates": [[-80, 40], []]}), "div-1: a position is not"),
        (one(geometry={"coordinates": [[-80, 40], [-80, float("nan")]]}), "is not finite"),
        (one(geometry={"coordinates": [[-80, 40], [-80, 99]]}), "latitude 99 lies outside"),
        (one(geometry={"coordinates": [[585000, 4478000], [0, 0]]}), "convert the file"),
        (one(geometry={"type": "Polygon", "coordinates": LONLAT}), "div-1: a position is not"),
        (one(geometry={"type": "Polygon", "coordinates": [3, 4]}), "div-1: a line needs two"),
        (one(geometry={"type": "MultiPolygon", "coordinates": [3]}), "div-1: its coordinates are"),
        (one(geometry={"coordinates": [[-80, 40], ["1", "2"]]}), "div-1: a position is not"),
        (one(geometry={"coordinates": [[-80, 40], "12"]}), "div-1: a position is not"),
        (one(geometry={"type": "Polygon", "coordinates": [LONLAT]}), "div-1: a ring is not closed"),
        (
            one(geometry={"type": "MultiLineString", "coordinates": []}),
            "div-1: its geometry is empty",
        ),
        (one(properties={"class": "ped_crossing"}), "div-1: a ped_crossing is a closed ring"),
        (one(properties={"sigma_m": [0.1]}), "div-1: sigma_m holds 1 × 1 values"),
        (one(properties={"sigma_m": [0.1, -1, 0.1]}), "div-1: sigma_m must be positive"),
        (one(properties={"sigma_m": "wide"}), "div-1: sigma_m is not a list of numbers"),
        (one(properties={"covariance_m2": [[1, 0], [1, 0], [1, 0]]}), "div-1: covariance_m2"),
        (one(properties={"seen": "often"}), "div-1: seen is 'often'"),
        (one(properties={"existence": float("inf")}), "div-1: existence is inf"),
        (one() | {"crs": {"properties": {"name": "EPSG:32617"}}}, "its crs member is"),
        (
            one() | {"rtmap": {"schema": "rtmap.map.geojson", "schema_version": "2.0"}},
            "version 2.0",
        ),
    ],
)
def test_one_line_for_what_is_wrong(tmp_path: Path, value: Any, what: str) -> None:
    with pytest.raises(BadInput) as caught:
        read(tmp_path, value)
    assert what in str(caught.value)
    assert "\n" not in str(caught.value) and "in.geojson" in str(caught.value)


def test_duplicates_and_empty_files(tmp_path: Path) -> None:
    twice = one()
    twice["features"].append(copy.deepcopy(twice["features"][0]))
    with pytest.raises(BadInput, match="two features are called div-1"):
        read(tmp_path, twice)
    nothing = {"type": "FeatureCollection", "features": []}
    assert len(read(tmp_path, nothing)) == 0
    with pytest.raises(BadInput, match="no CRS can be chosen"):
        read(tmp_path, nothing, None)


def test_crs_that_cannot_carry_the_data(tmp_path: Path) -> None:
    for crs, what in (
        ("EPSG:4326", "geographic"),
        ("EPSG:3857", "Mercator"),
        ("EPSG:99999", "not a CRS"),
        ("EPSG:32632", "lies outside EPSG:32632"),
    ):
        with pytest.raises(BadInput, match=what):
            read(tmp_path, one(), crs)


def test_clockwise_rings_are_turned_with_their_sigmas() -> None:
    ring = crossing("a")
    covariance = np.column_stack([np.arange(1, 6) ** 2.0, np.zeros(5), np.arange(1, 6) ** 2.0])
    covariance = np.column_stack([covariance, np.full(5, np.nan)])
    assert counter_clockwise(ring.points)
    left = element_feature(ring.with_points(ring.points, covariance), CRS)
    right = element_feature(ring.with_points(ring.points[::-1], covariance[::-1]), CRS)
    assert left == right
    assert left["properties"]["sigma_m"] == [1, 2, 3, 4, 5]


def test_covariance_follows_grid_north(tmp_path: Path) -> None:
    # Zones 17 and 18 differ by about 3.9° of grid north here, seen from the middle of zone 17.
    long_east = np.tile([1.0, 0.0, 0.01, np.nan], (5, 1))
    write_geojson(VectorMap([line("a", covariance=long_east)], CRS), tmp_path / "a.geojson")
    (turned,) = read_geojson(tmp_path / "a.geojson", "EPSG:32618")
    assert turned.covariance is not None
    xx, xy, yy, _ = turned.covariance[0]
    assert xx + yy == pytest.approx(1.01, rel=0.01)
    direction = np.degrees(0.5 * np.arctan2(2 * xy, xx - yy))
    run = turned.xy[-1] - turned.xy[0]
    assert direction == pytest.approx(np.degrees(np.arctan2(run[1], run[0])), abs=1e-3)
    assert abs(direction) > 2


def test_standard_streams(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_geojson(small_map(), "-")
    text = capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    assert_same(small_map(), read_geojson("-"), atol=2e-4)
    monkeypatch.setattr("sys.stdin", io.StringIO("{"))
    with pytest.raises(BadInput, match="cannot be read as JSON"):
        read_geojson("-")


def test_feature_of_any_geometry() -> None:
    item = feature(np.array([[585000.0, 4478000], [585001, 4478000]]), CRS, False, {})
    assert item["geometry"]["type"] == "LineString" and "id" not in item
    assert all(len(p) == 2 for p in item["geometry"]["coordinates"])
