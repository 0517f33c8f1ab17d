"""The map folder: versions, concurrency, time travel, restore, gc, and what is wrong with it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from map_samples import CRS, EAST, NORTH, assert_same, crossing, line, maps, small_map, tile_files

from rtmap_cli.errors import BadInput, UsageError
from rtmap_cli.maps import store
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import (
    commit_map,
    fused_runs,
    gc,
    history,
    map_crs,
    map_exists,
    read_map,
    restore,
    write_new_map,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A map of three tiles."""
    write_new_map(small_map(), tmp_path / "map", "first")
    return tmp_path / "map"


def moved(vector_map: VectorMap, element_id: str, metres: float = 0.1) -> VectorMap:
    """The map with one element shifted to the east."""
    return VectorMap(
        (
            e.with_points(e.points + [metres, 0, 0], e.covariance)
            if e.element_id == element_id
            else e
            for e in vector_map
        ),
        vector_map.crs,
    )


def test_new_map(folder: Path) -> None:
    assert map_exists(folder) and not map_exists(folder.parent)
    back = read_map(folder)
    assert_same(small_map(), back)
    assert (back.version, back.crs, map_crs(folder)) == (0, CRS, CRS)
    assert [e.element_id for e in back] == ["bou-a", "div-a", "div-b", "ped-a"]
    (entry,) = history(folder)
    assert (entry.message, entry.elements, entry.tiles_written) == ("first", 4, 3)
    assert entry.producer.startswith("rtmap ")


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(maps(), maps())
def test_round_trip_of_two_versions(tmp_path: Path, first: VectorMap, second: VectorMap) -> None:
    path = tmp_path / "map"
    write_new_map(first, path, "first", overwrite=True)
    assert commit_map(path, second, 0, "second") == 1
    assert_same(first, read_map(path, 0))
    assert_same(second, read_map(path))


def test_only_tiles_that_differ_are_written(folder: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in tile_files(folder)}
    base = read_map(folder)
    assert commit_map(folder, moved(base, "div-b"), 0, "second") == 1
    after = {p: p.stat().st_mtime_ns for p in tile_files(folder)}
    assert len(after) == 4 and before.items() <= after.items()
    entry = history(folder)[-1]
    assert (entry.tiles_written, entry.tiles_removed) == (1, 1)
    # The same content: no file, but a version.
    assert commit_map(folder, read_map(folder), 1, "nothing new", runs=["drive-1"]) == 2
    assert history(folder)[-1].tiles_written == 0
    assert set(tile_files(folder)) == set(after)
    # Back to the first content: the old file is used again.
    assert commit_map(folder, base, 2, "back") == 3
    assert set(tile_files(folder)) == set(after)
    assert_same(base, read_map(folder))


def test_tiles_of_another_pyarrow_stay(folder: Path) -> None:
    victim = tile_files(folder)[0]
    table = pq.read_table(victim, partitioning=None)
    pq.write_table(table, victim, compression="snappy")
    commit_map(folder, read_map(folder), 0, "nothing new")
    assert history(folder)[-1].tiles_written == 0


def test_tiles_go_when_their_last_element_goes(folder: Path) -> None:
    kept = VectorMap([e for e in read_map(folder) if e.element_id != "div-b"], CRS)
    commit_map(folder, kept, 0, "less")
    entry = history(folder)[-1]
    assert (entry.tiles_written, entry.tiles_removed, entry.elements) == (0, 1, 3)
    commit_map(folder, VectorMap([], CRS), 1, "nothing left")
    assert len(read_map(folder)) == 0 and read_map(folder).crs == CRS
    commit_map(folder, small_map(), 2, "all again")
    assert_same(small_map(), read_map(folder))


def test_empty_map(tmp_path: Path) -> None:
    write_new_map(VectorMap([], CRS), tmp_path / "map", "empty")
    assert len(read_map(tmp_path / "map", bbox=(0, 0, 1, 1))) == 0
    commit_map(tmp_path / "map", small_map(), 0, "first elements", runs=["a"])
    assert_same(small_map(), read_map(tmp_path / "map"))


def test_box_keeps_whole_elements_and_skips_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []
    original = store.read_tile
    monkeypatch.setattr(
        store,
        "read_tile",
        lambda place, name, box=None: read.append(name) or original(place, name, box),
    )
    box = (EAST + 39, NORTH - 1, EAST + 41, NORTH + 1)
    (found,) = read_map(folder, bbox=box)
    assert found.element_id == "div-a" and len(found.points) == 5
    assert len(read) == 1
    assert len(read_map(folder, bbox=(0, 0, 1, 1))) == 0


def test_runs_are_counted_once(folder: Path) -> None:
    base = read_map(folder)
    commit_map(folder, base, 0, "fuse", runs=["drive-2", "drive-1"], info={"cycle": 1})
    assert fused_runs(folder) == {"drive-1", "drive-2"} and fused_runs(folder, 0) == set()
    assert history(folder)[-1].info == {"cycle": 1}
    files = tile_files(folder)
    with pytest.raises(BadInput, match="drive-1 was fused"):
        commit_map(folder, moved(base, "div-a"), 1, "again", runs=["drive-1"])
    assert tile_files(folder) == files and len(history(folder)) == 2


def test_runs_of_the_first_version(tmp_path: Path) -> None:
    write_new_map(small_map(), tmp_path / "map", "first traversals", runs=["a", "b"])
    assert fused_runs(tmp_path / "map") == {"a", "b"}
    with pytest.raises(BadInput, match="b was fused"):
        commit_map(tmp_path / "map", small_map(), 0, "again", runs=["b"])


def test_restore_forgets_later_runs(folder: Path) -> None:
    base = read_map(folder)
    commit_map(folder, moved(base, "div-a"), 0, "one", runs=["drive-1"])
    commit_map(folder, moved(base, "div-b"), 1, "two", runs=["drive-2"])
    assert restore(folder, 1, "back to one") == 3
    assert_same(read_map(folder, 1), read_map(folder))
    assert fused_runs(folder) == {"drive-1"}
    assert history(folder)[-1].restored == 1
    with pytest.raises(BadInput, match="drive-1 was fused"):
        commit_map(folder, base, 3, "again", runs=["drive-1"])
    assert commit_map(folder, base, 3, "two again", runs=["drive-2"]) == 4
    assert restore(folder, 0) == 5 and fused_runs(folder) == set()
    assert restore(folder, 4) == 6 and fused_runs(folder) == {"drive-1", "drive-2"}
    with pytest.raises(BadInput, match="drive-2 was fused"):
        commit_map(folder, base, 6, "again", runs=["drive-2"])
    with pytest.raises(BadInput, match="newest one already"):
        restore(folder, 6)


def test_writers_of_other_tiles_both_win(folder: Path) -> None:
    base = read_map(folder)
    commit_map(folder, moved(base, "div-a"), 0, "one", runs=["drive-1"])
    # The second writer started from version 0 too.
    assert commit_map(folder, moved(base, "div-b"), 0, "two", runs=["drive-2"]) == 2
    assert_same(moved(moved(base, "div-a"), "div-b"), read_map(folder))


def test_writers_of_one_tile_conflict(folder: Path) -> None:
    base = read_map(folder)
    commit_map(folder, moved(base, "div-a"), 0, "one")
    with pytest.raises(BadInput, match="meanwhile; start again"):
        commit_map(folder, moved(base, "ped-a"), 0, "two")  # it shares a tile with div-a
    with pytest.raises(BadInput, match="new-1 was added by somebody else"):
        commit_map(folder, VectorMap([*moved(base, "div-a"), line("new-1", y=-900)], CRS), 1, "x")
        commit_map(folder, VectorMap([*moved(base, "div-a"), line("new-1", y=-1900)], CRS), 1, "y")


def test_a_faster_writer_between_look_and_commit(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = read_map(folder)
    original = store.write_version
    calls = []

    def slow(table, *rest):  # type: ignore[no-untyped-def]
        calls.append(table.version())
        if len(calls) == 1:
            monkeypatch.setattr(store, "write_version", original)
            commit_map(folder, moved(base, "div-b"), 0, "faster")
            monkeypatch.setattr(store, "write_version", slow)
        return original(table, *rest)

    monkeypatch.setattr(store, "write_version", slow)
    assert commit_map(folder, moved(base, "div-a"), 0, "slower") == 2
    assert calls == [0, 1]
    assert_same(moved(moved(base, "div-a"), "div-b"), read_map(folder))


def test_two_processes_at_once(folder: Path) -> None:
    code = (
        "import sys; from rtmap_cli.maps.store import *; from rtmap_cli.maps.element import *\n"
        "path, name = sys.argv[1:]; base = read_map(path, 0)\n"
        "new = [e.with_points(e.points + 0.1, e.covariance) if e.element_id == name else e "
        "for e in base]\n"
        "commit_map(path, VectorMap(new, base.crs), 0, name, runs=[name])"
    )
    writers = [
        subprocess.Popen([sys.executable, "-c", code, str(folder), name])
        for name in ("div-a", "div-b", "bou-a")
    ]
    assert [w.wait() for w in writers] == [0, 0, 0]
    assert fused_runs(folder) == {"div-a", "div-b", "bou-a"}
    base, now = read_map(folder, 0).by_id(), read_map(folder).by_id()
    for name in ("div-a", "div-b", "bou-a"):
        np.testing.assert_allclose(now[name].xy, base[name].xy + 0.1)


def test_a_crash_before_the_commit_leaves_orphans_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = read_map(folder)

    def crash(*_: object) -> int:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(store, "write_version", crash)
        with pytest.raises(KeyboardInterrupt):
            commit_map(folder, moved(base, "div-a"), 0, "never")
    assert_same(base, read_map(folder))
    assert len(tile_files(folder)) == 4
    assert gc(folder) == []  # too young: might belong to a commit under way
    (orphan,) = gc(folder, dry_run=True, min_age_s=0)
    assert len(tile_files(folder)) == 4
    assert gc(folder, min_age_s=0) == [orphan]
    assert len(tile_files(folder)) == 3
    assert_same(base, read_map(folder))


def test_gc_keeps_versions_unless_told(folder: Path) -> None:
    base = read_map(folder)
    commit_map(folder, moved(base, "div-a"), 0, "one")
    commit_map(folder, moved(base, "div-a", 0.2), 1, "two")
    assert gc(folder, min_age_s=0) == []
    assert len(gc(folder, keep=2, min_age_s=0)) == 1
    assert_same(moved(base, "div-a"), read_map(folder, 1))
    with pytest.raises(BadInput, match="tile is missing"):
        read_map(folder, 0)
    with pytest.raises(BadInput, match="needs this tile"):
        restore(folder, 0)


def test_other_engines_read_the_table(folder: Path) -> None:
    from deltalake import DeltaTable

    table = DeltaTable(str(folder))
    rows = table.to_pyarrow_table(columns=["element_id", "tile"]).to_pylist()
    assert {r["element_id"] for r in rows} == {"div-a", "div-b", "bou-a", "ped-a"}
    assert all(len(r["tile"]) == 16 for r in rows)


def test_a_moved_map_is_the_same_map(folder: Path) -> None:
    target = folder.parent / "a new näme"
    folder.rename(target)
    assert_same(small_map(), read_map(target))
    commit_map(target, moved(read_map(target), "div-a"), 0, "second")
    assert read_map(target).version == 1 and len(history(target)) == 2


def test_overwrite_is_never_implied(folder: Path) -> None:
    with pytest.raises(UsageError, match="exists already"):
        write_new_map(VectorMap([], CRS), folder, "again")
    assert_same(small_map(), read_map(folder))
    write_new_map(VectorMap([line("only")], CRS), folder, "again", overwrite=True)
    assert [e.element_id for e in read_map(folder)] == ["only"]


def test_nothing_is_left_of_a_map_that_failed(tmp_path: Path) -> None:
    twice = VectorMap([line("a"), line("a", x=900)], CRS)
    with pytest.raises(BadInput, match="two elements are called a"):
        write_new_map(twice, tmp_path / "map", "x")
    with pytest.raises(BadInput, match="geographic"):
        write_new_map(VectorMap([], "EPSG:4326"), tmp_path / "map", "x")
    assert list(tmp_path.iterdir()) == []


def test_another_crs_is_refused(folder: Path) -> None:
    with pytest.raises(BadInput, match="its CRS is EPSG:32618"):
        commit_map(folder, VectorMap(small_map(), "EPSG:32618"), 0, "x")


@pytest.mark.parametrize(
    ("path", "what"),
    [
        ("nothing", "no such map folder"),
        ("empty", "not a map"),
        ("s3://bucket/map", "object stores"),
        ("odd#name", "cannot hold '#'"),
    ],
)
def test_what_is_no_map(tmp_path: Path, path: str, what: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match=what):
        read_map(path if ":" in path else tmp_path / path)


def test_a_version_that_is_not_there(folder: Path) -> None:
    for version in (1, -1):
        with pytest.raises(BadInput, match=f"no version {version}"):
            read_map(folder, version)


def test_truncated_and_foreign_tiles(folder: Path) -> None:
    victim = tile_files(folder)[0]
    data = victim.read_bytes()
    victim.write_bytes(data[: len(data) // 2])
    with pytest.raises(BadInput, match=victim.name):
        read_map(folder)
    table = pq.read_table(tile_files(folder)[1], partitioning=None)
    metadata = dict(table.schema.metadata) | {b"rtmap.schema_version": b"9.0"}
    pq.write_table(table.replace_schema_metadata(metadata), victim)
    with pytest.raises(BadInput, match=r"version 9\.0 is unknown"):
        read_map(folder)


def test_a_newer_map_and_another_delta_table(folder: Path) -> None:
    log = folder / "_delta_log" / "00000000000000000000.json"
    text = log.read_text(encoding="utf-8")
    assert '\\"version\\": \\"1.0\\"' in text
    log.write_text(text.replace('\\"version\\": \\"1.0\\"', '\\"version\\": \\"2.0\\"'))
    with pytest.raises(BadInput, match=r"map version 2\.0 is unknown"):
        read_map(folder)
    log.write_text(text.replace("rtmap.map", "else.map"))
    with pytest.raises(BadInput, match="not an rtmap map"):
        read_map(folder)
    log.write_text(text[: len(text) // 2])
    with pytest.raises(BadInput, match="versions cannot be read"):
        read_map(folder)


def test_a_log_that_names_files_outside(folder: Path) -> None:
    log = folder / "_delta_log" / "00000000000000000000.json"
    lines = [json.loads(text) for text in log.read_text(encoding="utf-8").splitlines()]
    for action in lines:
        if "add" in action:
            action["add"]["path"] = "../secret.parquet"
    log.write_text("\n".join(map(json.dumps, lines)), encoding="utf-8")
    with pytest.raises(BadInput, match="not inside the map"):
        read_map(folder)


def test_reading_writes_nothing(folder: Path) -> None:
    copy = folder.parent / "copy"
    shutil.copytree(folder, copy)
    for path in [copy, *copy.rglob("*")]:
        os.utime(path, (1, 1))
    read_map(copy), history(copy), fused_runs(copy), gc(copy, dry_run=True, min_age_s=0)
    assert all(p.stat().st_mtime == 1 for p in [copy, *copy.rglob("*")])


def test_elements_far_apart_do_not_break_the_box(tmp_path: Path) -> None:
    far = crossing("far", x=250_000.0)
    write_new_map(small_map(far), tmp_path / "map", "first")
    (found,) = read_map(tmp_path / "map", bbox=(EAST + 249_999, NORTH, EAST + 250_001, NORTH + 1))
    assert found.element_id == "far"
