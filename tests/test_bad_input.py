"""Bad input of many verbs: one line, the documented exit code, nothing lost."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from sample_logs import write_native_log

from rtmap_cli.geometry.poses import se3_from_xyyaw
from rtmap_cli.logs.run import MATCHED, Observations, Run, RunFrames, run_info, true_poses
from rtmap_cli.logs.run_files import read_run, write_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import read_map, write_new_map

Call = Callable[..., Any]
CRS = "EPSG:32632"
ORIGIN = np.array([500_000.0, 5_400_000.0])


@pytest.fixture
def town(tmp_path: Path) -> Path:
    line = Element("d", "divider", ORIGIN + np.array([[0.0, 0.0], [60.0, 0.0]]))
    write_new_map(VectorMap([line], CRS), tmp_path / "town", "test")
    return tmp_path / "town"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    n, v = 3, 20
    frame = np.arange(n, dtype=np.int32)
    pose = se3_from_xyyaw(ORIGIN[0] + 5.0 * np.arange(n), np.full(n, ORIGIN[1]), np.zeros(n))
    unknown = np.full((n, 3), np.nan)
    times = 10**18 + np.arange(n, dtype=np.int64) * 10**9
    frames = RunFrames(
        frame, times, pose, np.ones((n, 3)), unknown, unknown, unknown,
        np.full((n, 3, 3), np.nan), frame,
    )  # fmt: skip
    points = np.zeros((n, v, 2), np.float32)
    points[..., 0] = np.linspace(-10, 10, v)
    seen = Observations(
        frame, frame, np.full(n, MATCHED, np.int8), np.array(["divider"] * n, object),
        np.ones(n, np.float32), np.ones(n, np.float32), np.array(["d"] * n, object), points,
        np.full((n, v, 2), 0.1, np.float32), points + ORIGIN,
    )  # fmt: skip
    info = run_info("a", CRS, ["divider"], {"x": [-36, 36], "y": [-18, 18]})
    (tmp_path / "runs" / "a").mkdir(parents=True)
    made = Run(info, frames, seen, None, true_poses(frame, times, pose))
    write_run(made, tmp_path / "runs" / "a")
    return tmp_path / "runs" / "a"


def _one_line(result: Any) -> str:
    assert "Traceback" not in result.err
    assert len(result.err.strip().splitlines()) == 1, result.err
    return str(result.err)


def test_overwrite_replaces_only_what_is_alike(rtmap: Call, town: Path, run: Path) -> None:
    command = ("import", "geojson", _geojson(town.parent), "--crs", CRS, "--overwrite", "-o")
    for target in (run, run.parent):
        before = sorted(p.name for p in target.iterdir())
        assert "something else" in _one_line(rtmap(*command, target, code=3))
        assert sorted(p.name for p in target.iterdir()) == before
    assert len(read_map(town)) == 1 and len(read_run(run).frames) == 3
    told = rtmap("simulate", "degrade", "--map", town, "-o", town, "--overwrite", code=3)
    assert "replace the input" in _one_line(told)
    inside = next((town / "_delta_log").glob("*.json"))
    told = rtmap("export", "geojson", town, "-o", inside, "--overwrite", code=3)
    assert "inside the input" in _one_line(told)
    assert len(read_map(town)) == 1


def _geojson(folder: Path) -> Path:
    line = {"type": "LineString", "coordinates": [[9.0, 48.75], [9.001, 48.75]]}
    feature = {"type": "Feature", "properties": {"class": "divider"}, "geometry": line}
    path = folder / "one.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("classes", 5, "classes"),
        ("range_m", [], "range_m"),
        ("range_m", {"x": [-36, 36], "y": ["a", "b"]}, "range_m"),
        ("log_id", None, "log_id"),
        ("crs", "", "crs"),
    ],
)
def test_run_json_is_checked(
    rtmap: Call, town: Path, run: Path, key: str, value: Any, told: str
) -> None:
    info = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(info | {key: value}))
    assert told in _one_line(rtmap("localize", run, "--map", town, code=3))
    assert told in _one_line(rtmap("crowdsource", run, "--map", town, code=3))
    assert read_map(town).version == 0


@pytest.mark.parametrize("name", ["frames", "observations", "poses"])
def test_columns_of_another_type_are_named(rtmap: Call, town: Path, run: Path, name: str) -> None:
    import pyarrow as pa

    path = run / f"{name}.parquet"
    table = pq.read_table(path)
    column = table.schema.get_field_index("frame")
    words = pa.array([f"frame {k}" for k in range(len(table))])
    pq.write_table(
        table.set_column(column, "frame", words).replace_schema_metadata(table.schema.metadata),
        path,
    )
    told = _one_line(rtmap("crowdsource", run, "--map", town, code=3))
    assert f"{name}.parquet" in told and "type" in told
    assert read_map(town).version == 0


def test_numbers_that_are_none_are_usage_errors(rtmap: Call, town: Path, tmp_path: Path) -> None:
    out = ("-o", tmp_path / "out")
    rtmap("simulate", "town", "--seed", -1, *out, code=2)
    rtmap("simulate", "town", "--size", "nan", *out, code=2)
    rtmap("simulate", "degrade", "--map", town, "--sigma", "inf", *out, code=2)
    assert not (tmp_path / "out").exists()


def test_what_runs_say_alone_is_replaced_only_when_told(rtmap: Call, town: Path, run: Path) -> None:
    command = ("detect-changes", run, "--map", town, "-o", town.parent / "c.geojson")
    rtmap(*command, "--write-runs")
    (run / "changes.parquet").write_bytes(b"precious")
    (town.parent / "c.geojson").unlink()
    told = _one_line(rtmap(*command, "--write-runs", code=2))
    assert "changes.parquet" in told and "--overwrite" in told
    assert (run / "changes.parquet").read_bytes() == b"precious"
    assert not (town.parent / "c.geojson").exists()
    rtmap(*command, "--write-runs", "--overwrite")
    assert (run / "changes.parquet").read_bytes() != b"precious"


def test_drives_that_are_not_there_are_named(rtmap: Call, town: Path, run: Path) -> None:
    command = ("evaluate", "map", run, "--truth", town)
    assert "no traversal 07" in _one_line(
        rtmap(*command, "--poses", run, "--traversal", "07", code=3)
    )
    rtmap(*command, "--poses", run, "--traversal", "a")
    assert "--poses" in _one_line(rtmap(*command, "--traversal", "07", code=2))
    poses = ("evaluate", "poses", run, "--truth", run)
    assert "it has a" in _one_line(rtmap(*poses, "--traversal", "07", code=3))


def test_what_nobody_thought_of_is_still_one_line(
    rtmap: Call, monkeypatch: pytest.MonkeyPatch, town: Path
) -> None:
    import rtmap_cli.maps.store as store

    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("of a kind")

    monkeypatch.setattr(store, "read_map", broken)
    monkeypatch.setattr(store, "history", broken)
    assert "ZeroDivisionError" in _one_line(rtmap("map", "log", town, code=3))
    monkeypatch.setenv("RTMAP_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        rtmap("map", "log", town)


def test_what_was_taken_for_a_run_is_told(rtmap, tmp_path: Path) -> None:
    log, runs = tmp_path / "log", tmp_path / "runs"
    log.mkdir()
    (log / "log.json").write_text("{}")
    (runs / "monday").mkdir(parents=True)
    (runs / "monday" / "run.json").write_text("{}")
    rtmap("simulate", "town", "--size", 150, "-o", tmp_path / "map")
    taken = rtmap("localize", log, "--map", tmp_path / "map", code=3)
    assert "it is a log: make a run of it with rtmap infer" in taken.err
    held = rtmap("localize", runs, "--map", tmp_path / "map", code=3)
    assert "it holds runs (monday): name them" in held.err
    colon = ["simulate", "images", "--map", tmp_path / "map", "--log", "town", "-o", tmp_path / "x"]
    assert "town: with a colon" in rtmap(*colon, code=3).err


def test_a_run_a_log_and_a_map_in_each_others_place_are_named(
    rtmap: Call, town: Path, run: Path, tmp_path: Path
) -> None:
    log = write_native_log(tmp_path / "log")
    for call, told in (
        (("localize", run, "--map", run), "not a map (there is no _delta_log in it); it is a run"),
        (("map", "ls", log), "it is a log"),
        (("infer", run, "-o", tmp_path / "x"), "not a log (log.json is missing); it is a run"),
        (("check-log", town), "it is a map"),
        (("localize", town, "--map", town), "is no run (run.json is missing); it is a map"),
    ):
        assert told in _one_line(rtmap(*call, code=3))
