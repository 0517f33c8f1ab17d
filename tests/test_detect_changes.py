"""detect-changes through the command line, on streets with known changes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_scene import CRS, ORIGIN, crossing, drive, line, save, shifted, street

from rtmap_cli.formats.changes import read_change_table
from rtmap_cli.maps.crs import lonlat_to
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import write_new_map

Call = Callable[..., Any]


def _detect(
    rtmap: Call, tmp_path: Path, prior: VectorMap, runs: list[Any], *options: object, code: int = 0
) -> list[dict[str, Any]]:
    write_new_map(prior, tmp_path / "map", "prior")
    folders = [save(r, tmp_path / "runs" / r.log_id) for r in runs]
    out = tmp_path / "changes.geojson"
    rtmap("detect-changes", *folders, "--map", tmp_path / "map", "-o", out, *options, code=code)
    features: list[dict[str, Any]] = json.loads(out.read_text())["features"]
    return features


def _local(feature: dict[str, Any]) -> np.ndarray:
    """Coordinates in the street's own metres."""
    geometry = feature["geometry"]
    rings = geometry["coordinates"]
    lonlat = np.array(rings[0] if geometry["type"] == "Polygon" else rings)
    return lonlat_to(CRS, lonlat[:, :2]) - ORIGIN


def test_a_true_map_has_no_changes(rtmap: Call, tmp_path: Path) -> None:
    world = street()
    runs = [drive(world, f"d{k}", seed=k) for k in range(2)]
    assert _detect(rtmap, tmp_path, world, runs, "--fail-on-change") == []


def test_deleted_and_inserted_crossings_are_told_with_their_evidence(
    rtmap: Call, tmp_path: Path
) -> None:
    world = street(crossing("new", 50.0), without=["west"])
    runs = [drive(world, f"d{k}", seed=k) for k in range(3)]
    found = _detect(rtmap, tmp_path, street(), runs, "--fail-on-change", code=1)
    kinds = {f["properties"]["kind"]: f for f in found}
    assert len(found) == 2 and set(kinds) == {"insert", "delete"}
    gone, new = kinds["delete"]["properties"], kinds["insert"]["properties"]
    assert gone["element_id"] == "west" and gone["class"] == "ped_crossing"
    assert gone["traversals_in_view"] == 3 and gone["traversals_seen"] == 0
    assert gone["frames_seen"] == 0 and gone["frames_in_view"] > 20
    assert gone["probability"] > 0.9 and new["probability"] > 0.9
    assert new["element_id"] is None and new["runs"] == ["d0", "d1", "d2"]
    assert new["first_seen_ns"] < new["last_seen_ns"]
    centre = _local(kinds["insert"])[:-1].mean(axis=0)
    assert np.allclose(centre, [52.0, 0.0], atol=0.5)
    assert kinds["insert"]["geometry"]["type"] == "Polygon"


def test_more_drives_make_a_delete_more_probable(rtmap: Call, tmp_path: Path) -> None:
    world = street(without=["east"])
    runs = [drive(world, f"d{k}", seed=k) for k in range(3)]
    one = _detect(rtmap, tmp_path / "one", street(), runs[:1], "--min-probability", "0.1")
    three = _detect(rtmap, tmp_path / "three", street(), runs, "--min-probability", "0.1")
    first, last = (
        [f for f in found if f["properties"]["kind"] == "delete"] for found in (one, three)
    )
    assert first[0]["properties"]["probability"] < last[0]["properties"]["probability"]


def test_a_deleted_stretch_of_a_line_is_told_as_a_stretch(rtmap: Call, tmp_path: Path) -> None:
    world = street(
        line("lane-a", "divider", 3.5, -20, 40), line("lane-b", "divider", 3.5, 60, 120),
        without=["lane"],
    )  # fmt: skip
    runs = [drive(world, f"d{k}", seed=k) for k in range(3)]
    found = _detect(rtmap, tmp_path, street(), runs)
    assert [f["properties"]["kind"] for f in found] == ["delete"]
    assert found[0]["properties"]["element_id"] == "lane"
    x, y = _local(found[0]).T
    assert np.allclose(y, 3.5, atol=0.01)
    assert abs(x.min() - 40) < 3.5 and abs(x.max() - 60) < 3.5


def test_a_missing_stretch_is_told_as_an_insert(rtmap: Call, tmp_path: Path) -> None:
    prior = street(
        line("lane-a", "divider", 3.5, -20, 40), line("lane-b", "divider", 3.5, 60, 120),
        without=["lane"],
    )  # fmt: skip
    runs = [drive(street(), f"d{k}", seed=k) for k in range(3)]
    found = _detect(rtmap, tmp_path, prior, runs)
    assert [f["properties"]["kind"] for f in found] == ["insert"]
    x, y = _local(found[0]).T
    assert np.abs(y - 3.5).max() < 0.3
    assert abs(x.min() - 40) < 3.5 and abs(x.max() - 60) < 3.5


def test_a_displaced_line_is_a_modify_and_not_a_delete(rtmap: Call, tmp_path: Path) -> None:
    prior = street(line("off", "divider", 0.9), without=["middle", "lane"])
    world = street(without=["lane"])
    runs = [drive(world, f"d{k}", seed=k) for k in range(3)]
    found = _detect(rtmap, tmp_path, prior, runs, "--displaced")
    assert {f["properties"]["kind"] for f in found} == {"modify"}
    assert np.abs(_local(found[0])[:, 1]).max() < 0.3


def test_what_is_hidden_is_not_deleted(rtmap: Call, tmp_path: Path) -> None:
    world = street(line("verge", "divider", 14.0), without=["left"])
    # A wall beside the street: nobody ever looks behind it.
    wall = np.array([[50.0, 10.0, 0.0, 400.0, 0.5]])
    runs = [drive(world, f"d{k}", seed=k, boxes=wall) for k in range(3)]
    prior = street(line("verge", "divider", 14.0), line("gone", "divider", 16.0), without=["left"])
    assert _detect(rtmap, tmp_path, prior, runs) == []


def test_the_networks_own_answers_about_the_prior_count(rtmap: Call, tmp_path: Path) -> None:
    prior, world = street(), street(without=["west"])
    runs = [drive(world, f"d{k}", seed=k, found=0.0, prior=prior) for k in range(2)]
    found = _detect(rtmap, tmp_path, prior, runs)
    assert [f["properties"]["element_id"] for f in found] == ["west"]


def test_inputs_stay_untouched_unless_asked(rtmap: Call, tmp_path: Path) -> None:
    world = street(without=["west"])
    runs = [drive(world, "d0"), drive(world, "d1", seed=1)]
    _detect(rtmap, tmp_path, street(), runs)
    table = tmp_path / "runs" / "d0" / "changes.parquet"
    assert not table.exists()
    folder, out = tmp_path / "runs" / "d0", tmp_path / "again.geojson"
    rtmap("detect-changes", folder, "--map", tmp_path / "map", "-o", out, "--write-runs")
    changes, crs = read_change_table(table)
    assert crs == CRS and [c.element_id for c in changes] == ["west"]
    assert changes[0].counts.traversals_in_view == 1


def test_json_and_streams(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    run = save(drive(street(without=["west"]), "d0"), tmp_path / "d0")
    base = ("detect-changes", run, "--map", tmp_path / "map", "-o")
    told = json.loads(rtmap(*base, tmp_path / "c.geojson", "--json").out)
    assert told["counts"] == {"delete": 1, "insert": 0, "modify": 0} and told["map_version"] == 0
    assert json.loads(rtmap(*base, "-").out)["type"] == "FeatureCollection"
    rtmap(*base, "-", "--json", code=2)


def test_it_does_not_overwrite(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(street(), tmp_path / "map", "prior")
    run = save(drive(street(), "d0"), tmp_path / "d0")
    out = tmp_path / "c.geojson"
    out.write_text("mine")
    base = ("detect-changes", run, "--map", tmp_path / "map", "-o", out)
    assert "--overwrite" in rtmap(*base, code=2).err
    assert out.read_text() == "mine"
    rtmap(*base, "--overwrite")


@pytest.mark.parametrize("case", ["no run", "no map", "other crs", "twice", "truncated"])
def test_bad_input_is_one_line(rtmap: Call, tmp_path: Path, case: str) -> None:
    prior, run = tmp_path / "map", tmp_path / "d0"
    write_new_map(street(), prior, "prior")
    save(drive(street(), "d0", crs="EPSG:32618" if case == "other crs" else CRS), run)
    runs = [run]
    if case == "no run":
        runs = [tmp_path / "nothing"]
    elif case == "no map":
        prior = tmp_path / "nothing"
    elif case == "twice":
        runs = [run, save(drive(street(), "d0"), tmp_path / "copy")]
    elif case == "truncated":
        table = run / "observations.parquet"
        table.write_bytes(table.read_bytes()[:500])
    result = rtmap("detect-changes", *runs, "--map", prior, "-o", tmp_path / "c.geojson", code=3)
    assert len(result.err.strip().splitlines()) == 1
    assert not (tmp_path / "c.geojson").exists()


def test_a_map_out_of_view_gives_no_answer(rtmap: Call, tmp_path: Path) -> None:
    write_new_map(shifted(street(), 5000.0, 0.0), tmp_path / "map", "elsewhere")
    run = save(drive(street(), "d0"), tmp_path / "d0")
    out = tmp_path / "c.geojson"
    result = rtmap("detect-changes", run, "--map", tmp_path / "map", "-o", out, code=4)
    assert "in view" in result.err
