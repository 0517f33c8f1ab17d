"""schemas/ describes the files that the code writes: both are held together here."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from rtmap_cli.cli import run
from rtmap_cli.formats.geojson import map_collection
from rtmap_cli.logs.run import run_info
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.place import Place
from rtmap_cli.maps.store import write_new_map

FOLDER = Path(__file__).resolve().parents[1] / "schemas"


@pytest.fixture(scope="module")
def generate() -> Any:
    sys.path.insert(0, str(FOLDER))
    try:
        return importlib.import_module("generate")
    finally:
        sys.path.remove(str(FOLDER))


def test_files_are_what_the_code_says(generate: Any) -> None:
    wanted = {name: generate.text(value) for name, value in generate.descriptions().items()}
    found = {p.name: p.read_text(encoding="utf-8") for p in FOLDER.glob("*.json")}
    assert found == wanted, "run `make schemas` and commit schemas/"


def test_notes_name_no_column_that_is_gone(generate: Any) -> None:
    import notes

    schemas = generate.table_schemas()
    assert set(notes.TABLES) == set(schemas) == set(notes.FILES)
    for name, columns in notes.TABLES.items():
        assert set(columns) <= set(schemas[name].columns.names), name


def violations(node: dict[str, Any], value: Any, where: str = "") -> list[str]:
    """The part of JSON Schema that schemas/ uses."""
    types = {
        "object": dict,
        "array": list,
        "string": str,
        "integer": int,
        "number": int | float,
        "null": type(None),
        "boolean": bool,
    }
    if "const" in node and value != node["const"]:
        return [f"{where}: {value!r} is not {node['const']!r}"]
    if "enum" in node and value not in node["enum"]:
        return [f"{where}: {value!r} is not in {node['enum']}"]
    if "type" in node:
        names = node["type"] if isinstance(node["type"], list) else [node["type"]]
        if not any(isinstance(value, types[n]) for n in names):
            return [f"{where}: {value!r} is no {names}"]
    out = []
    if isinstance(value, dict):
        out += [f"{where}.{k} is missing" for k in node.get("required", ()) if k not in value]
        for key, item in value.items():
            out += violations(node.get("properties", {}).get(key, {}), item, f"{where}.{key}")
    if isinstance(value, list) and "items" in node:
        for k, item in enumerate(value):
            out += violations(node["items"], item, f"{where}[{k}]")
    return out


def schema(name: str) -> dict[str, Any]:
    value: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return value


def test_the_checker_sees_what_is_wrong() -> None:
    assert violations(schema("rtmap.run"), {"schema": "rtmap.log"})
    good = run_info("drive", "EPSG:32617", ["divider"], {"x": [-36, 36], "y": [-18, 18]})
    assert violations(schema("rtmap.run"), good) == []
    assert violations(schema("rtmap.run"), good | {"classes": [3]})


def test_map_files_follow_their_schemas(tmp_path: Path) -> None:
    points = np.array([[585000.0, 4478000, 300], [585010, 4478000, np.nan]])
    covariance = np.array([[0.01, 0.001, 0.02, 0.1], [0.01, 0.001, 0.02, np.nan]])
    element = Element("a", "divider", points, covariance, 2.0, 3, 4, 1, 5, 6, {"id": "x"}, ("r",))
    vector_map = VectorMap([element], "EPSG:32617")
    members, features = map_collection(vector_map)
    collection = {"type": "FeatureCollection", "features": features, **members}
    assert violations(schema("rtmap.map.geojson"), collection) == []

    from rtmap_cli.maps.delta import open_table

    write_new_map(vector_map, tmp_path / "map", "first")
    description = json.loads(open_table(Place.of(tmp_path / "map")).metadata().description)
    assert violations(schema("rtmap.map"), description) == []
    missing = set(schema("rtmap.map")["required"]) ^ set(description)
    assert not missing


def test_changes_follow_their_schema(tmp_path: Path) -> None:
    from rtmap_cli.formats.changes import ChangeEvent, write_changes
    from rtmap_cli.maps.evidence import Counts

    points = np.array([[585000.0, 4478000], [585010, 4478000]])
    counts = Counts(3, 5, 1, 2, 10, None, ("drive-1",))
    event = ChangeEvent("c1", "delete", "divider", "div-a", points, 0.9, 2.2, counts)
    info = {"map_version": 3, "crs_of_map": "EPSG:32617"}
    why = {"c1": "missing in new"}
    write_changes([event], "EPSG:32617", tmp_path / "changes.geojson", info, why)
    assert run(["map", "review", str(tmp_path / "changes.geojson"), "--accept", "c1"]) == 0
    value = json.loads((tmp_path / "changes.geojson").read_text(encoding="utf-8"))
    assert violations(schema("rtmap.changes"), value) == []
    found = value["features"][0]["properties"]
    node = schema("rtmap.changes")["properties"]["features"]["items"]["properties"]["properties"]
    assert set(found) == set(node["properties"])
    write_changes([event], "EPSG:32617", tmp_path / "bare.geojson")
    bare = json.loads((tmp_path / "bare.geojson").read_text(encoding="utf-8"))
    assert violations(schema("rtmap.changes"), bare) == []
    assert set(bare["features"][0]["properties"]) == set(node["required"])
    found["reason"] = "because"
    assert violations(schema("rtmap.changes"), value)


def test_update_tables_follow_their_schemas(tmp_path: Path) -> None:
    from fusion_scene import drive, save, street

    for k in range(2):
        save(drive(street(without=("lane",)), f"run-{k}", seed=k), tmp_path / "runs" / f"{k}")
    write_new_map(street(), tmp_path / "map", "old")
    words = ["update", tmp_path / "runs", "--map", tmp_path / "map", "-o", tmp_path / "c.geojson"]
    assert run([*map(str, words), "--report", str(tmp_path / "report")]) == 0
    for name in ("heat", "cells"):
        node = schema(f"rtmap.update.{name}")
        table = pq.read_table(tmp_path / "report" / f"{name}.parquet")
        # Parquet names the values of a map once more, behind their type.
        read = {f.name: str(f.type).replace(f" ('{f.name}')", "") for f in table.schema}
        assert read == {c["name"]: c["type"] for c in node["columns"]}
        said = {k.decode(): v.decode() for k, v in table.schema.metadata.items()}
        assert said["rtmap.schema"] == node["name"] and set(node["metadata"]) <= set(said)
        assert said["rtmap.units"] == node["units"] and len(table)
    changes = json.loads((tmp_path / "c.geojson").read_text(encoding="utf-8"))
    assert changes["features"] and violations(schema("rtmap.changes"), changes) == []


def test_logs_follow_their_schema(tmp_path: Path) -> None:
    from rtmap_cli.logs.log import Frame
    from rtmap_cli.logs.native import NativeLogWriter

    writer = NativeLogWriter(tmp_path, "drive", "EPSG:32617", None)
    writer.add(Frame(0, 1, np.eye(4), np.ones(3)), {})
    writer.close()
    info = json.loads((tmp_path / "log.json").read_text(encoding="utf-8"))
    assert violations(schema("rtmap.log"), info) == []
    assert set(info) == set(schema("rtmap.log")["properties"])
