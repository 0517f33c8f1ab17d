"""rtmap map review, apply, revert: decisions on changes, as a user makes them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_samples import CRS, line, small_map, tile_files

from rtmap_cli.errors import BadInput, UsageError
from rtmap_cli.formats.changes import ChangeEvent, write_changes
from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps import delta
from rtmap_cli.maps.condition import parse_condition
from rtmap_cli.maps.edits import Edit, apply_edits, together
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.evidence import Counts
from rtmap_cli.maps.place import Place
from rtmap_cli.maps.store import commit_map, read_map, write_new_map

Call = Callable[..., Any]
COUNTS = Counts(9, 12, 2, 3, 10, 20, ("monday",))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A map of three tiles."""
    write_new_map(small_map(), tmp_path / "map", "first")
    return tmp_path / "map"


def _event(name: str, kind: str, element: Element, points: Any, p: float) -> ChangeEvent:
    element_id = None if kind == "insert" else element.element_id
    odds = float(np.log(p / (1 - p)))
    return ChangeEvent(name, kind, element.class_name, element_id, points, p, odds, COUNTS)


@pytest.fixture
def changes(folder: Path, tmp_path: Path) -> Path:
    """A middle stretch of div-a gone, ped-a gone, a new divider, div-b half a metre to the side."""
    by_id = read_map(folder).by_id()
    a, b = by_id["div-a"], by_id["div-b"]
    stretch = a.points[0] + (a.points[-1] - a.points[0]) * np.array([[0.3], [0.6]])
    events = [
        _event("gone", "delete", a, stretch, 0.97),
        _event("crossing", "delete", by_id["ped-a"], by_id["ped-a"].points, 0.9),
        _event("new", "insert", line("x", y=50), line("x", y=50).points, 0.99),
        _event("moved", "modify", b, b.points + [0.0, 0.5, 0.0], 0.7),
    ]
    write_changes(events, CRS, tmp_path / "c.geojson", {"map_version": 0, "crs_of_map": CRS})
    return tmp_path / "c.geojson"


def _features(path: Path) -> dict[str, Any]:
    content = json.loads(path.read_text(encoding="utf-8"))
    return {f["properties"]["change_id"]: f for f in content["features"]}


def _files(folder: Path, version: int) -> set[str]:
    """The tile files of a version, which are named by their content."""
    return set(delta.tile_files(delta.open_table(Place.of(folder), version)))


def test_review_decides_and_touches_nothing_else(changes: Path, rtmap: Call) -> None:
    before = json.loads(changes.read_text(encoding="utf-8"))
    listed = rtmap("map", "review", changes)
    assert json.loads(changes.read_text(encoding="utf-8")) == before
    assert "4 open" in listed.err and "gone" in listed.out
    words = ("--accept", "gone", "crossing", "--reject-if", "kind==modify")
    rtmap("map", "review", changes, *words, "--accept-if", "probability>0.95")
    states = {k: f["properties"].get("review") for k, f in _features(changes).items()}
    assert states == {
        "gone": "accepted", "crossing": "accepted", "new": "accepted", "moved": "rejected"
    }  # fmt: skip
    rtmap("map", "review", changes, "--reopen", *states)
    assert json.loads(changes.read_text(encoding="utf-8")) == before


def test_review_into_another_file(changes: Path, tmp_path: Path, rtmap: Call) -> None:
    before = changes.read_bytes()
    other = tmp_path / "decided.geojson"
    rtmap("map", "review", "--accept", "new", changes, "-o", other)
    assert changes.read_bytes() == before
    assert _features(other)["new"]["properties"]["review"] == "accepted"
    rtmap("map", "review", changes, "--accept", "new", "-o", other, code=2)


def test_review_refuses(changes: Path, tmp_path: Path, rtmap: Call) -> None:
    before = changes.read_bytes()
    told = rtmap("map", "review", changes, "--accept", "gone", "nobody", code=3)
    assert "no change nobody" in told.err and told.err.count("\n") == 1
    told = rtmap("map", "review", changes, "--accept", "gone", "--reject", "gone", code=2)
    assert "both" in told.err
    told = rtmap("map", "review", changes, "--accept-if", "probabilty>0.5", code=2)
    assert "no change has probabilty" in told.err
    rtmap("map", "review", changes, "--accept-if", "__import__('os')", code=2)
    assert changes.read_bytes() == before
    (tmp_path / "bad.geojson").write_text('{"type": "FeatureCollection"', encoding="utf-8")
    rtmap("map", "review", tmp_path / "bad.geojson", code=3)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("probability>0.95", True),
        ("probability > 0.97", False),
        ("probability>=0.97 and not kind=='insert'", True),
        ("class in (divider, 'boundary') or probability<0", True),
        ("class not in (divider)", False),
        ("not (kind = delete or kind = insert)", False),
        ("element_id == null", False),
        ("element_id != null and frames_seen == 9", True),
        ("kind > 3", False),
        ("missing > 3", False),
        ("told", None),
        ("probability > ", None),
        ("probability > 0.5 )", None),
        ("(probability > 0.5", None),
        ("probability > 0.5 and", None),
        ("().__class__", None),
        ("((((" * 40 + "a=1", None),
        ("", None),
    ],
)
def test_conditions(text: str, found: bool | None) -> None:
    record = {
        "probability": 0.97, "kind": "delete", "class": "divider", "element_id": "div-a",
        "frames_seen": 9,
    }  # fmt: skip
    if found is None:
        with pytest.raises(UsageError):
            parse_condition(text)
    else:
        assert parse_condition(text)(record) is found


def test_apply_commits_the_accepted_and_keeps_the_rest(
    folder: Path, changes: Path, rtmap: Call
) -> None:
    old = read_map(folder)
    rtmap("map", "review", changes, "--accept", "gone", "new")
    told = json.loads(rtmap("map", "apply", folder, changes, "--json").out)
    assert told["version"] == 1 and told["applied"] == ["gone", "new"]
    new = read_map(folder).by_id()
    assert set(new) == {"div-a", "div-a.1", "div-b", "ped-a", "bou-a", told["inserted"][1]}
    a = old.by_id()["div-a"]
    whole = length(a.points)
    assert length(new["div-a"].points) == pytest.approx(0.4 * whole, abs=1e-3)
    assert length(new["div-a.1"].points) == pytest.approx(0.3 * whole, abs=1e-3)
    assert np.array_equal(new["div-a"].points[-1], a.points[-1], equal_nan=True)
    assert new["div-a"].covariance is not None and new["div-a"].seen == a.seen
    made = new[told["inserted"][1]]
    assert made.runs == ("monday",) and made.existence == pytest.approx(4.595, abs=1e-3)
    for name in ("div-b", "ped-a", "bou-a"):
        assert np.array_equal(new[name].points, old.by_id()[name].points, equal_nan=True)


def test_apply_all_then_revert_is_exact(folder: Path, changes: Path, rtmap: Call) -> None:
    before = tile_files(folder)
    rtmap("map", "review", changes, "--reject", "new")
    dry = rtmap("map", "apply", folder, changes, "--all", "--dry-run").out
    assert "would get 3 of 4 changes" in dry and tile_files(folder) == before
    rtmap("map", "apply", folder, changes, "--all")
    moved = read_map(folder).by_id()["div-b"]
    old = read_map(folder, 0).by_id()["div-b"]
    assert np.allclose(moved.xy - old.xy, [0, 0.5], atol=2e-3)
    rtmap("map", "revert", folder)
    assert _files(folder, 2) == _files(folder, 0)
    rtmap("map", "revert", folder)  # the revert itself is a version, too
    assert _files(folder, 3) == _files(folder, 1)


def test_revert_of_an_older_version(folder: Path, changes: Path, rtmap: Call) -> None:
    rtmap("map", "review", changes, "--accept", "gone")
    rtmap("map", "apply", folder, changes)
    later = [*read_map(folder), line("later", y=80)]
    commit_map(folder, VectorMap(later, CRS), 1, "somebody else")
    told = json.loads(rtmap("map", "revert", folder, 1, "--json").out)
    assert told["elements"] == ["div-a", "div-a.1"]
    now, old = read_map(folder).by_id(), read_map(folder, 0).by_id()
    assert set(now) == {*old, "later"}
    assert all(np.array_equal(now[k].points, old[k].points, equal_nan=True) for k in old)
    told = rtmap("map", "revert", folder, 1, code=3)
    assert "was changed again" in told.err
    rtmap("map", "revert", folder, 0, code=3)
    rtmap("map", "revert", folder, 9, code=3)


def test_stale_and_unknown_are_refused_whole(
    folder: Path, changes: Path, tmp_path: Path, rtmap: Call
) -> None:
    told = rtmap("map", "apply", folder, changes, code=3)
    assert "none of its 4 changes is accepted" in told.err
    rtmap("map", "review", changes, "--accept", "gone", "new")
    content = json.loads(changes.read_text(encoding="utf-8"))
    content["features"][0]["properties"]["element_id"] = "div-z"
    (tmp_path / "unknown.geojson").write_text(json.dumps(content), encoding="utf-8")
    told = rtmap("map", "apply", folder, tmp_path / "unknown.geojson", code=3)
    assert "no element div-z" in told.err and told.err.count("\n") == 1
    assert read_map(folder).version == 0
    commit_map(folder, VectorMap([*read_map(folder), line("later", y=80)], CRS), 0, "other")
    told = rtmap("map", "apply", folder, changes, code=3)
    assert "is about version 0 of the map, which has version 1" in told.err
    rtmap("map", "apply", folder, changes, "--rebase")
    told = rtmap("map", "apply", folder, changes, "--rebase", code=3)
    assert "div-a is another one since version 0" in told.err
    assert read_map(folder).version == 2


def test_a_file_that_an_editor_saved(
    folder: Path, changes: Path, tmp_path: Path, rtmap: Call
) -> None:
    """QGIS drops members and makes multi-geometries, JOSM makes texts of numbers: still a file of
    changes. The user dropped one, moved another, drew a third."""
    content = json.loads(changes.read_text(encoding="utf-8"))
    kept = [f for f in content["features"] if f["properties"]["change_id"] in ("gone", "new")]
    for f in kept:
        f["geometry"]["coordinates"] = [f["geometry"]["coordinates"]]
        f["geometry"]["type"] = "MultiLineString"
        f["properties"] = {
            k: v if isinstance(v, str) else json.dumps(v) for k, v in f["properties"].items()
        }
        f["properties"]["review"] = "accepted"
    drawn = json.loads(json.dumps(kept[1]))
    drawn["id"] = None
    drawn["properties"] = {"kind": "insert", "class": "divider", "review": "accepted"}
    for p in drawn["geometry"]["coordinates"][0]:
        p[1] += 5e-5
    saved = tmp_path / "saved.geojson"
    saved.write_text(
        json.dumps({"type": "FeatureCollection", "name": "c", "features": [*kept, drawn]}), "utf-8"
    )
    told = json.loads(rtmap("map", "apply", folder, saved, "--json").out)
    assert told["applied"] == ["gone", "new", "feature-2"] and len(told["inserted"]) == 3
    found = [read_map(folder).by_id()[k] for k in told["inserted"] if k.startswith("divider")]
    assert {e.seen for e in found} == {0, 9}


def _as_qgis(feature: dict[str, Any], fid: int) -> dict[str, Any]:
    """A feature as QGIS (OGR's driver) saves it: the id lost or a number, properties in another
    order with more of them, nulls for what is not set, 15 digits, a Z that nobody asked for."""
    properties = dict(reversed(feature["properties"].items()))
    for key in ("runs", "evidence"):
        if key in properties:
            properties[key] = json.dumps(properties[key])  # lists become texts
    properties |= {"fid": fid, "layer": "changes", "path": "/home/x/c.geojson", "note": None}
    line = [[round(x, 15), round(y, 15), 0.0] for x, y, *_ in feature["geometry"]["coordinates"]]
    geometry = {"type": "LineString", "coordinates": line}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def test_qgis_moves_a_vertex_and_adds_a_feature(
    folder: Path, changes: Path, tmp_path: Path, rtmap: Call
) -> None:
    old = read_map(folder).by_id()
    features = _features(changes)
    moved, new = _as_qgis(features["moved"], 1), _as_qgis(features["new"], 2)
    for f in (moved, new):
        f["properties"]["review"] = "accepted"
    vertex = moved["geometry"]["coordinates"][1]
    vertex[1] += 1e-6  # 0.11 m north
    drawn = json.loads(json.dumps(new))
    drawn["properties"] = dict.fromkeys(new["properties"]) | {
        "fid": 3, "kind": "insert", "class": "divider", "review": "accepted", "note": "by hand",
    }  # fmt: skip
    for p in drawn["geometry"]["coordinates"]:
        p[1] += 4e-5
    name = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    saved = tmp_path / "qgis.geojson"
    collection = {"type": "FeatureCollection", "name": "changes", "crs": name}
    saved.write_text(json.dumps(collection | {"features": [new, drawn, moved]}, indent=0), "utf-8")
    told = json.loads(rtmap("map", "apply", folder, saved, "--json").out)
    assert len(told["inserted"]) == 2 and told["modified"] == ["div-b"]
    now = read_map(folder).by_id()
    # Half a metre aside, as the file said, and the vertex where the user put it.
    step = now["div-b"].xy - old["div-b"].xy
    assert np.allclose(step[[0, -1]], [0, 0.5], atol=2e-3)
    assert np.isclose(step[1, 1], 0.61, atol=5e-3)
    made = [now[k] for k in told["inserted"]]
    assert sorted(e.seen for e in made) == [0, 9]
    hand = next(e for e in made if e.seen == 0)
    assert hand.attributes["note"] == "by hand" and not hand.runs
    for k in ("div-a", "ped-a", "bou-a"):
        assert now[k].points.tobytes() == old[k].points.tobytes()
    rtmap("map", "revert", folder)
    assert _files(folder, 2) == _files(folder, 0)


def test_josm_saves_closed_lines_and_texts(
    folder: Path, changes: Path, tmp_path: Path, rtmap: Call
) -> None:
    """JOSM writes every property as a text, leaves empty ones out, rounds to 1e-7 degrees and makes
    closed ways polygons or lines as it sees fit."""
    features = _features(changes)
    ring, new = features["crossing"], features["new"]
    for f in (ring, new):
        kept = {k: v for k, v in f["properties"].items() if v not in (None, [])}
        f["properties"] = {
            k: v if isinstance(v, str) else json.dumps(v) for k, v in kept.items()
        } | {"review": "accepted"}
        f.pop("id", None)
    (outline,) = ring["geometry"]["coordinates"]
    ring["geometry"] = {"type": "LineString", "coordinates": outline}
    new["geometry"]["coordinates"] = [
        [round(x, 7), round(y, 7)] for x, y, *_ in new["geometry"]["coordinates"]
    ]
    saved = tmp_path / "josm.geojson"
    collection = {"type": "FeatureCollection", "generator": "JOSM", "features": [new, ring]}
    saved.write_text(json.dumps(collection), "utf-8")
    told = json.loads(rtmap("map", "apply", folder, saved, "--json").out)
    assert told["deleted"] == ["ped-a"] and len(told["inserted"]) == 1
    (made,) = (read_map(folder).by_id()[k] for k in told["inserted"])
    assert np.abs(made.xy - line("x", y=50).xy).max() < 0.02 and made.seen == 9


def _edit(name: str, kind: str, element: Element, points: Any) -> Edit:
    element_id = None if kind == "insert" else element.element_id
    return Edit(name, kind, element.class_name, element_id, np.asarray(points, float))


def test_of_stretches_that_overlap_the_first_one_is_made() -> None:
    e = line("a")
    ends = [[[0.1], [0.35]], [[0.3], [0.6]], [[0.6], [0.8]], [[0.9], [0.05]]]
    edits = [
        _edit(str(k), "delete", e, e.points[0] + (e.points[-1] - e.points[0]) * np.array(s))
        for k, s in enumerate(ends)
    ]
    assert [x.change_id for x in together(e, edits)] == ["0", "2"]
    assert [x.change_id for x in together(e, edits[::-1])] == ["3"]
    apply_edits(VectorMap([e], CRS), together(e, edits), "f")
    # Also a short one near the start of a longer one.
    short = _edit("5", "delete", e, e.points[0] + (e.points[-1] - e.points[0]) * [[0.11], [0.115]])
    assert together(e, [edits[0], short]) == [edits[0]]
    with pytest.raises(BadInput, match="overlap"):
        apply_edits(VectorMap([e], CRS), [edits[0], short], "f")


def test_two_stretches_of_one_line_and_a_clash() -> None:
    e = line("a")
    one, two = (e.points[0] + (e.points[-1] - e.points[0]) * np.array(s) for s in (
        [[0.1], [0.3]], [[0.7], [0.5]],
    ))  # fmt: skip
    done = apply_edits(
        VectorMap([e], CRS), [_edit("1", "delete", e, one), _edit("2", "delete", e, two)], "f"
    )
    sizes = [length(x.points) / length(e.points) for x in done.vector_map]
    assert sorted(sizes) == pytest.approx([0.1, 0.2, 0.3])
    clash = [_edit("1", "delete", e, one), _edit("2", "modify", e, one)]
    with pytest.raises(BadInput, match="overlap"):
        apply_edits(VectorMap([e], CRS), clash, "f")
    with pytest.raises(BadInput, match=r"lies 9\.0 m from"):
        apply_edits(VectorMap([e], CRS), [_edit("1", "delete", e, one + [0, 9, 0])], "f")


def test_a_stretch_of_a_closed_line() -> None:
    t = np.linspace(0, 2 * np.pi, 41)
    ring = np.stack([20 * np.cos(t), 20 * np.sin(t), np.full(41, np.nan)], axis=-1)
    ring[-1] = ring[0]
    e = Element("o", "boundary", ring)
    across = np.roll(ring[:-1], 3, axis=0)[:7]  # over the start of the ring
    done = apply_edits(VectorMap([e], CRS), [_edit("1", "delete", e, across)], "f").vector_map
    (rest,) = done
    assert length(rest.points) == pytest.approx(length(ring) * 34 / 40)
    out = across * [1.02, 1.02, 1.0]
    done = apply_edits(VectorMap([e], CRS), [_edit("1", "modify", e, out)], "f").vector_map
    (moved,) = done
    assert moved.ring and np.hypot(*moved.xy.T).max() == pytest.approx(20.4)


def test_a_stretch_moved_far_aside_is_a_line_of_its_own() -> None:
    e = line("a")
    points = e.points[0] + (e.points[-1] - e.points[0]) * np.array([[0.4], [0.6]])
    done = apply_edits(VectorMap([e], CRS), [_edit("1", "modify", e, points + [0, 1.2, 0])], "f")
    assert done.modified == ("a",) and done.inserted == ("a.1", "a.2")
