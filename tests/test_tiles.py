"""Tiles: GeoParquet that others open, exact round trips, the same bytes every time."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from map_samples import CRS, assert_same, crossing, line, maps, small_map, tile_files

from rtmap_cli.errors import BadInput
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.maps.tiles import (
    TILE,
    elements_to_table,
    geometry_wkb,
    quadkeys,
    table_to_elements,
    tile_bytes,
    tile_of,
    tile_statistics,
)


def test_quadkeys_of_known_places() -> None:
    # The example of the Bing Maps tile system: tile 3, 5 of zoom 3 is 213.
    lon, lat = (3.5 / 8) * 360 - 180, np.degrees(np.arctan(np.sinh(np.pi * (1 - 2 * 5.5 / 8))))
    assert quadkeys(np.array([[lon, lat]]), 3) == ["213"]
    # Null Island lies at the upper left corner of the lower right quarter.
    assert quadkeys(np.array([[0.0, 0.0]]), 2) == ["30"]
    # The ends of the world stay inside the grid.
    ends = quadkeys(np.array([[-180.0, 90.0], [180.0, -90.0]]), 16)
    assert ends == ["0" * 16, "3" * 16]


def test_quadkeys_agree_with_bit_by_bit() -> None:
    rng = np.random.default_rng(3)
    lonlat = np.column_stack([rng.uniform(-180, 180, 50), rng.uniform(-85, 85, 50)])
    for (lon, lat), key in zip(lonlat, quadkeys(lonlat, 16), strict=True):
        column = int((lon + 180) / 360 * 2**16)
        row = int(
            (1 - np.log(np.tan(np.radians(lat)) + 1 / np.cos(np.radians(lat))) / np.pi) * 2**15
        )
        digits = [((row >> k) & 1) * 2 + ((column >> k) & 1) for k in range(15, -1, -1)]
        assert key == "".join(map(str, digits))


@settings(max_examples=25, deadline=None)
@given(maps())
def test_table_round_trip(vector_map: VectorMap) -> None:
    table = elements_to_table(list(vector_map))
    back = VectorMap(table_to_elements(table, "x"), vector_map.crs)
    assert_same(vector_map, back)


def test_same_elements_same_bytes() -> None:
    elements = list(small_map())
    first = tile_bytes(elements_to_table(elements), CRS, "0")
    assert first == tile_bytes(elements_to_table(elements[::-1]), CRS, "0")
    assert pq.read_schema(io.BytesIO(first)).metadata[b"rtmap.schema"] == TILE.name.encode()


def test_unknown_height_is_never_zero() -> None:
    import shapely

    known, partly, unknown = (
        line("a"),
        line("b", z=np.array([1, np.nan, 2, 3, 4])),
        line("c", z=np.nan),
    )
    blobs = [geometry_wkb(e) for e in (known, partly, unknown)]
    assert [bool(shapely.has_z(shapely.from_wkb(b))) for b in blobs] == [True, True, False]
    z = shapely.get_coordinates(shapely.from_wkb(blobs[1]), include_z=True)[:, 2]
    assert np.isnan(z[1]) and z[0] == 1


def test_wkb_is_what_shapely_writes() -> None:
    import shapely

    for element in (line("a"), crossing("b")):
        blob = geometry_wkb(element)
        assert shapely.to_wkb(shapely.from_wkb(blob), flavor="iso") == blob


def test_ring_closed_within_a_micrometre_is_a_polygon() -> None:
    import shapely

    element = crossing("a")
    points = element.points.copy()
    points[-1, 0] += 5e-7
    shape = shapely.from_wkb(geometry_wkb(element.with_points(points)))
    assert shape.geom_type == "Polygon"
    open_ring = Element("b", "ped_crossing", element.points[:-1])
    assert shapely.from_wkb(geometry_wkb(open_ring)).geom_type == "LineString"


def test_statistics_hold_the_box() -> None:
    table = elements_to_table([line("b"), crossing("a", x=20.0)])
    found = json.loads(tile_statistics(table))
    assert found["numRecords"] == 2
    assert found["minValues"]["element_id"] == "a"
    assert found["maxValues"]["bbox"]["xmax"] == 585040.0
    assert found["minValues"]["bbox"]["ymin"] == 4478000.0


def test_element_belongs_to_the_tile_of_its_middle() -> None:
    here, there = line("a"), line("b", x=1500.0)
    across = line("c", n=152)  # from one to the other: its middle lies between
    keys = tile_of([here, there, across], CRS)
    assert len(set(keys)) == 3
    assert tile_of([], CRS) == []


def test_broken_rows_are_named() -> None:
    table = elements_to_table([line("a"), line("b")])
    index = table.schema.get_field_index("geometry")
    broken = table.set_column(index, "geometry", [[b"\x01\x02", geometry_wkb(line("b"))]])
    with pytest.raises(BadInput, match="not WKB"):
        table_to_elements(broken, "tile.parquet")
    import shapely

    point = shapely.to_wkb(shapely.Point(1, 2))
    broken = table.set_column(index, "geometry", [[geometry_wkb(line("a")), point]])
    with pytest.raises(BadInput, match="element b"):
        table_to_elements(broken, "tile.parquet")


@pytest.fixture
def tile(tmp_path: Path) -> Path:
    write_new_map(small_map(), tmp_path / "map", "first")
    found = tile_files(tmp_path / "map")
    assert len(found) == 3
    return max(found, key=lambda p: pq.read_metadata(p).num_rows)


def test_geo_metadata(tile: Path) -> None:
    geo = json.loads(pq.read_schema(tile).metadata[b"geo"])
    column = geo["columns"]["geometry"]
    assert geo["version"] == "1.1.0" and geo["primary_column"] == "geometry"
    assert column["encoding"] == "WKB"
    assert column["geometry_types"] == ["LineString Z", "Polygon"]
    assert column["crs"]["id"] == {"authority": "EPSG", "code": 32617}
    assert column["covering"]["bbox"]["xmin"] == ["bbox", "xmin"]
    assert column["bbox"] == [585000.0, 4478000.0, 585040.0, 4478018.0]


def test_geopandas_opens_a_tile(tile: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    frame = geopandas.read_parquet(tile)
    assert frame.crs.to_epsg() == 32617
    assert list(frame["element_id"]) == ["div-a", "ped-a"]
    assert list(frame.geometry.geom_type) == ["LineString", "Polygon"]
    assert frame.geometry.iloc[1].area == pytest.approx(32.0)
    few = geopandas.read_parquet(tile, bbox=(585019, 4478009, 585021, 4478011))
    assert list(few["element_id"]) == ["ped-a"]


def test_duckdb_opens_a_tile(tile: Path) -> None:
    import shapely

    duckdb = pytest.importorskip("duckdb")
    connection = duckdb.connect(config={"autoinstall_known_extensions": "false"})
    rows = connection.execute(
        "select element_id, bbox.xmax, cov_xx, attributes['mark'], runs, seen "
        "from read_parquet(?) order by element_id",
        [str(tile)],
    ).fetchall()
    assert rows[0] == ("div-a", 585040.0, [0.01] * 5, "SOLID_WHITE", ["drive-1", "drive-2"], 7)
    # DuckDB 2 knows the column as a geometry, older ones as a blob without their extension.
    (blob,) = connection.execute(
        "select geometry::blob from read_parquet(?) where bbox.ymin > 4478005", [str(tile)]
    ).fetchone()
    assert shapely.from_wkb(bytes(blob)).area == pytest.approx(32.0)
