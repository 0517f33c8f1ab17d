"""rtmap map …, import geojson, export geojson: through the command line, as a user does it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from map_samples import CRS, assert_same, crossing, line, small_map, tile_files

from rtmap_cli.formats.geojson import write_geojson
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import commit_map, read_map, write_new_map
from rtmap_cli.maps.validate import check_elements

Call = Callable[..., Any]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A map of three tiles."""
    write_new_map(small_map(), tmp_path / "map", "first")
    return tmp_path / "map"


@pytest.fixture
def cycled(folder: Path) -> Path:
    """The map and a second version: div-a moved by 0.5 m, div-b gone, new-1 new, ped-a seen."""
    out = []
    for e in read_map(folder):
        if e.element_id == "div-a":
            e = e.with_points(e.points + [0.3, 0.4, 0], e.covariance)
        if e.element_id == "ped-a":
            e = Element(e.element_id, e.class_name, e.points, seen=3, in_view=4)
        if e.element_id != "div-b":
            out.append(e)
    commit_map(folder, VectorMap([*out, line("new-1", y=50)], CRS), 0, "cycle 1", runs=["drive-1"])
    return folder


def test_import_then_export(tmp_path: Path, rtmap: Call) -> None:
    write_geojson(small_map(), tmp_path / "in.geojson")
    made = rtmap("import", "geojson", tmp_path / "in.geojson", "--crs", CRS, "-o", tmp_path / "map")
    assert "version 0, EPSG:32617" in made.out and made.err == ""
    told = rtmap("export", "geojson", tmp_path / "map", "-o", tmp_path / "out.geojson", "--json")
    assert json.loads(told.out)["elements"] == 4
    rtmap("import", "geojson", tmp_path / "out.geojson", "--crs", CRS, "-o", tmp_path / "again")
    assert_same(small_map(), read_map(tmp_path / "again"), atol=1e-3)


def test_import_says_what_it_chose(tmp_path: Path, rtmap: Call) -> None:
    kerb = VectorMap([line("kerb-1", class_name="kerb")], CRS)
    write_geojson(kerb, tmp_path / "in.geojson")
    text = (tmp_path / "in.geojson").read_text(encoding="utf-8")
    (tmp_path / "in.geojson").write_text(text.replace("rtmap.map.geojson", "other"), "utf-8")
    result = rtmap("import", "geojson", tmp_path / "in.geojson", "-o", tmp_path / "map", "--json")
    assert json.loads(result.out)["classes"] == {"kerb": 1}
    assert "no --crs given, the map is in EPSG:32617" in result.err
    assert "do not know: kerb" in result.err


def test_import_of_bad_files(tmp_path: Path, rtmap: Call) -> None:
    (tmp_path / "bad.geojson").write_text('{"type": "FeatureCollection"', encoding="utf-8")
    for name in ("bad.geojson", "nothing.geojson"):
        result = rtmap("import", "geojson", tmp_path / name, "-o", tmp_path / "map", code=3)
        assert name in result.err and result.err.count("\n") == 1
    assert not (tmp_path / "map").exists()
    rtmap("import", "geojson", tmp_path / "bad.geojson", code=2)  # no -o


def test_import_does_not_overwrite(folder: Path, tmp_path: Path, rtmap: Call) -> None:
    write_geojson(small_map(), tmp_path / "in.geojson")
    result = rtmap("import", "geojson", tmp_path / "in.geojson", "-o", folder, code=2)
    assert "exists already" in result.err
    rtmap("import", "geojson", tmp_path / "in.geojson", "-o", folder, "--overwrite")


def test_export_of_a_part(folder: Path, tmp_path: Path, rtmap: Call) -> None:
    def ids(*arguments: object) -> list[str]:
        out = rtmap("export", "geojson", folder, "-o", "-", *arguments).out
        return [f["id"] for f in json.loads(out)["features"]]

    assert ids() == ["bou-a", "div-a", "div-b", "ped-a"]
    assert ids("--class", "divider") == ["div-a", "div-b"]
    assert ids("--class", "divider", "--class", "ped_crossing") == ["div-a", "div-b", "ped-a"]
    assert ids("--bbox", 585019, 4478009, 585025, 4478011) == ["ped-a"]
    box = ("--bbox", -80.0, 40.4480, -79.9950, 40.4490, "--lonlat")
    assert ids(*box) == ["div-a", "ped-a"]
    target = tmp_path / "out.geojson"
    rtmap("export", "geojson", folder, "-o", target)
    assert "exists already" in rtmap("export", "geojson", folder, "-o", target, code=2).err
    rtmap("export", "geojson", folder, "-o", target, "--overwrite")
    rtmap("export", "geojson", folder, "-o", "-", "--json", code=2)
    rtmap("export", "geojson", folder, "-o", "-", "--lonlat", code=2)
    rtmap("export", "geojson", folder, "-o", "-", "--bbox", 1, 1, 0, 0, code=2)


def test_export_of_an_old_version(cycled: Path, rtmap: Call) -> None:
    out = rtmap("export", "geojson", cycled, "-o", "-", "--map-version", 0).out
    assert "div-b" in out and "new-1" not in out
    assert (
        "no version 7"
        in rtmap("export", "geojson", cycled, "-o", "-", "--map-version", 7, code=3).err
    )


def test_ls(folder: Path, rtmap: Call) -> None:
    result = rtmap("map", "ls", folder)
    lines = result.out.splitlines()
    assert lines[0].split()[:2] == ["id", "class"] and len(lines) == 5
    assert lines[2].split() == ["div-a", "divider", "5", "40.0", "0.122", "0.924", "7/9", "2"]
    assert "version 0, EPSG:32617, 4 elements" in result.err
    told = json.loads(rtmap("map", "ls", folder, "--class", "divider", "--json").out)
    assert told["count"] == 2 and told["classes"]["divider"]["length_m"] == pytest.approx(80)
    by_id = {e["id"]: e for e in told["elements"]}
    assert by_id["div-b"]["height_m"] == [300.0, 302.0] and by_id["div-b"]["sigma_m"] is None
    summary = rtmap("map", "ls", folder, "--summary").out.splitlines()
    assert summary[1].split() == ["boundary", "1", "40.0", "-"]


def test_log(cycled: Path, rtmap: Call) -> None:
    lines = rtmap("map", "log", cycled).out.splitlines()
    assert lines[1].split()[0] == "1" and lines[1].endswith("cycle 1")
    assert lines[2].endswith("first")
    newest, oldest = json.loads(rtmap("map", "log", cycled, "--json").out)["versions"]
    assert newest["runs"] == ["drive-1"] and newest["elements"] == 4
    assert oldest["version"] == 0 and oldest["time"].endswith("Z")


def test_diff(cycled: Path, tmp_path: Path, rtmap: Call) -> None:
    result = rtmap("map", "diff", cycled, 0, 1)
    assert "1 added, 1 removed, 1 modified, 1 updated" in result.err
    rows = {r.split()[0]: r.split()[1:] for r in result.out.splitlines()[1:]}
    assert rows["div-a"] == ["modified", "divider", "0.500", "points"]
    assert rows["ped-a"][0] == "updated" and rows["new-1"][0] == "added"
    told = json.loads(rtmap("map", "diff", cycled, 0, 1, "--json").out)
    assert told["counts"] == {"added": 1, "removed": 1, "modified": 1, "updated": 1}
    told = json.loads(rtmap("map", "diff", cycled, 1, 1, "--json").out)
    assert told["differences"] == []
    out = json.loads(rtmap("map", "diff", cycled, 0, 1, "-o", "-").out)
    kinds = {f["properties"]["id"]: f["properties"]["kind"] for f in out["features"]}
    assert kinds["div-b"] == "removed" and out["features"][-1]["geometry"]["type"] == "Polygon"
    rtmap("map", "diff", cycled, 0, 1, "-o", tmp_path / "d.geojson")
    rtmap("map", "diff", cycled, 0, 1, "-o", tmp_path / "d.geojson", code=2)
    assert "no version 9" in rtmap("map", "diff", cycled, 0, 9, code=3).err


def test_diff_of_two_folders(cycled: Path, tmp_path: Path, rtmap: Call) -> None:
    write_new_map(read_map(cycled), tmp_path / "other", "copy")
    told = json.loads(
        rtmap("map", "diff", cycled, 1, 0, "--with", tmp_path / "other", "--json").out
    )
    assert told["differences"] == []
    write_new_map(VectorMap([], "EPSG:32618"), tmp_path / "east", "other zone")
    err = rtmap("map", "diff", cycled, 1, 0, "--with", tmp_path / "east", code=3).err
    assert "its CRS is EPSG:32618" in err


def test_displacement_of_lines_with_other_vertices() -> None:
    from rtmap_cli.maps.difference import displacement

    a = np.array([[0.0, 0], [10, 0]])
    assert displacement(a, np.array([[0.0, 0], [5, 2], [10, 0]])) == pytest.approx(2)
    assert displacement(a, a + [0, 3]) == pytest.approx(3)


def test_restore(cycled: Path, rtmap: Call) -> None:
    told = json.loads(rtmap("map", "restore", cycled, 0, "-m", "undo", "--json").out)
    assert told == {"map": str(cycled), "version": 2, "restored": 0, "forgotten": ["drive-1"]}
    assert_same(small_map(), read_map(cycled))
    assert rtmap("map", "log", cycled).out.splitlines()[1].endswith("undo")
    assert "no version 5" in rtmap("map", "restore", cycled, 5, code=3).err


def test_gc(folder: Path, rtmap: Call) -> None:
    orphan = folder / "tiles" / "0320011102322210" / "orphan.parquet"
    orphan.parent.mkdir(parents=True, exist_ok=True)
    orphan.write_bytes(b"12345")
    assert "removed 0 files" in rtmap("map", "gc", folder).out
    assert (
        "would remove 1 files, 5 bytes"
        in rtmap("map", "gc", folder, "--dry-run", "--older-than", 0).out
    )
    assert orphan.exists()
    told = json.loads(rtmap("map", "gc", folder, "--older-than", 0, "--json").out)
    assert told["files"] == ["tiles/0320011102322210/orphan.parquet"] and not orphan.exists()
    assert_same(small_map(), read_map(folder))


@pytest.mark.parametrize("verb", ["ls", "log", "validate", "gc"])
def test_what_is_no_map(tmp_path: Path, verb: str, rtmap: Call) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("nothing", "empty"):
        result = rtmap("map", verb, tmp_path / name, code=3)
        assert name in result.err and result.err.count("\n") == 1


def test_validate_a_good_map(cycled: Path, rtmap: Call) -> None:
    before = {p: p.stat().st_mtime_ns for p in cycled.rglob("*")}
    result = rtmap("map", "validate", cycled, "--fail-on", "warning")
    assert "4 elements, 0 errors, 0 warnings" in result.out
    assert {p: p.stat().st_mtime_ns for p in cycled.rglob("*")} == before


def _bad_elements() -> dict[str, Element]:
    bow = np.array([[0.0, 0], [4, 4], [4, 0], [0, 4], [0, 0]]) + [585000, 4478000]
    eight = np.array([[0.0, 0], [4, 4], [4, 0], [0, 4]]) + [585000, 4478000]
    flat = np.tile([0.01, 0.02, 0.01, np.nan], (5, 1))
    return {
        "self-crossing": Element("bow", "ped_crossing", bow),
        "open-ring": Element("open", "ped_crossing", crossing("x").points[:-1]),
        "zero-length": Element("dot", "divider", np.tile([585000.0, 4478000], (2, 1))),
        "covariance": line("flat", covariance=flat),
        "existence": line("maybe", existence=float("nan")),
        "times": line("late", first_seen_ns=2, last_seen_ns=1),
        "counts": line("often", seen=-1),
        "self-crossing ": Element("eight", "boundary", eight),
        "repeated-vertex": line("twice").with_points(line("x").points[[0, 1, 1, 2]]),
        "counts ": line("seldom", seen=2, in_view=1),
        "no-id": line(""),
    }


def test_checks_of_elements() -> None:
    for code, element in _bad_elements().items():
        assert [f.code for f in check_elements([element])] == [code.strip()], code
    assert check_elements(list(small_map())) == []


def test_validate_names_what_is_wrong(tmp_path: Path, rtmap: Call) -> None:
    write_new_map(VectorMap(_bad_elements().values(), CRS), tmp_path / "map", "bad")
    told = json.loads(rtmap("map", "validate", tmp_path / "map", "--json").out)
    assert told["counts"] == {"warning": 3, "error": 8}
    assert {f["element_id"] for f in told["findings"]} >= {"bow", "open", "dot", "flat"}
    result = rtmap("map", "validate", tmp_path / "map", "--fail-on", "error", code=1)
    assert "8 errors" in result.err and "Self-intersection" in result.out


def _rewrite(path: Path, **columns: Any) -> None:
    table = pq.read_table(path, partitioning=None)
    for name, values in columns.items():
        k = table.schema.get_field_index(name)
        table = table.set_column(k, table.schema.field(k), pa.array(values, table.schema.types[k]))
    pq.write_table(table, path)


def test_validate_sees_altered_files(folder: Path, rtmap: Call) -> None:
    first, second, third = sorted(tile_files(folder), key=lambda p: -pq.read_metadata(p).num_rows)
    rows = pq.read_table(first, partitioning=None)
    box = [{"xmin": 0.0, "ymin": 0.0, "xmax": 1.0, "ymax": 1.0}] * 2
    _rewrite(first, bbox=box, element_id=["div-b", "ped-a"])
    _rewrite(second, geometry=[b"broken"])
    third.write_bytes(third.read_bytes()[:100])
    assert rows.num_rows == 2
    told = json.loads(rtmap("map", "validate", folder, "--json").out)
    codes = {f["code"] for f in told["findings"]}
    assert {"tile-altered", "bbox", "element-unreadable", "tile-unreadable"} <= codes
    other = tile_files(folder)
    assert len(other) == 3  # nothing was repaired or removed
    rtmap("map", "validate", folder, "--fail-on", "error", code=1)


def test_validate_sees_an_id_in_two_tiles(folder: Path, rtmap: Call) -> None:
    for path in tile_files(folder):
        count = pq.read_metadata(path).num_rows
        _rewrite(path, element_id=["same", "other"][:count])
    told = json.loads(rtmap("map", "validate", folder, "--json").out)
    assert sum(f["code"] == "duplicate-id" for f in told["findings"]) == 2
