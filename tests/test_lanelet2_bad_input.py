"""Lanelet2 files that are broken or hostile: one clear line, exit 3, no map folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sample_lanelet2 import CRS, street

Rtmap = Callable[..., Any]

HEAD = '<?xml version="1.0"?>\n'
LOL = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))
BOMB = f'{HEAD}<!DOCTYPE osm [<!ENTITY l0 "lol">{LOL}]><osm><node id="1" lat="&l9;" lon="8"/></osm>'
FETCH = f'{HEAD}<!DOCTYPE osm [<!ENTITY x SYSTEM "file:///etc/passwd">]><osm a="&x;">&x;</osm>'
OUTSIDE = f'{HEAD}<!DOCTYPE osm SYSTEM "http://127.0.0.1:9/osm.dtd"><osm version="0.6"/>'


@pytest.fixture
def refused(rtmap: Rtmap, tmp_path: Path) -> Callable[..., str]:
    """``refused(content, *options)``: the line on stderr for a file that cannot be imported."""

    def call(content: str | bytes, *options: object) -> str:
        path, out = tmp_path / "in.osm", tmp_path / "map"
        data = content.encode() if isinstance(content, str) else content
        path.write_bytes(data)
        said = rtmap("import", "lanelet2", path, "-o", out, *options, code=3)
        assert said.err.count("\n") == 1 and str(path) in said.err
        assert "bug" not in said.err and said.out == ""
        assert not out.exists() and [p.name for p in tmp_path.iterdir()] == ["in.osm"]
        assert path.read_bytes() == data
        return str(said.err)

    return call


@pytest.fixture
def text(tmp_path: Path) -> str:
    """The small street as a file."""
    path = street().write(tmp_path / "in.osm")
    content = path.read_text(encoding="utf-8")
    path.unlink()
    return content


@pytest.mark.parametrize("content", [BOMB, FETCH, OUTSIDE])
def test_entities_and_document_types(refused: Any, content: str) -> None:
    start = time.monotonic()
    assert "line 2: declares a document type (entities)" in refused(content)
    assert time.monotonic() - start < 5.0


def test_cut_anywhere(refused: Any, text: str) -> None:
    for size in range(1, len(text) - 1, len(text) // 40):
        assert "cannot be read as XML" in refused(text[:size])


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "no element found"),
        (b"\x0a\x09OSMHeader\x18\x12\x10\x0a\x0eOsmSchema-V0.6", "cannot be read as XML"),
        (HEAD.replace("1.0", '1.0" encoding="klingon') + "<osm/>", "cannot be read as XML"),
        ('<kml xmlns="http://www.opengis.net/kml/2.2"/>', "not an OSM file (it begins with <kml>)"),
        ("<osm/>", "holds no ways"),
        ("<osm>" * 100_000, "cannot be read as XML"),
    ],
)
def test_no_osm(refused: Any, content: bytes | str, what: str) -> None:
    assert what in refused(content)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('<node id="2"', '<node id="1"', "node 1 is there twice"),
        ('<way id="102"', '<way id="101"', "way 101 is there twice"),
        ('<relation id="202"', '<relation id="201"', "relation 201 is there twice"),
        ('<nd ref="2"/>', '<nd ref="77"/>', "way 101 refers to node 77, which is missing"),
        (
            'type="way" ref="103"',
            'type="way" ref="1030"',
            "relation 201 refers to way 1030, which is missing",
        ),
        (
            'type="relation" ref="220"',
            'type="relation" ref="221"',
            "relation 204 refers to relation 221, which is missing",
        ),
        ('member type="way"', 'member type="street"', "a member's type is 'street'"),
        ('<node id="2"', '<node id="two"', "id is 'two', not an id"),
        ('<node id="2"', f'<node id="{2**63}"', "not an id"),
        ('<node id="2"', "<node", "<node>: id is '', not an id"),
        ('lat="49.', 'lat="149.', "not degrees within ±90"),
        ('lat="49.', 'lat="nan" x="49.', "lat is 'nan', not degrees"),
        ('lat="49.', 'lat="1e999" x="49.', "not degrees within ±90"),
        ('lat="49.', 'lat="" x="49.', "has neither latitude and longitude nor local_x"),
        ('k="ele" v="110.0"', 'k="ele" v="high"', "node 1: ele is 'high', not a number"),
        ('k="ele" v="110.0"', 'k="ele" v="inf"', "node 1: ele is 'inf', not a number"),
    ],
)
def test_one_thing_wrong(refused: Any, text: str, old: str, new: str, what: str) -> None:
    assert old in text
    assert what in refused(text.replace(old, new, 1))


def test_the_line_is_named(refused: Any, text: str) -> None:
    number = 1 + text[: text.index('<way id="102"')].count("\n")
    said = refused(text.replace('<way id="102"', '<way id="101"', 1))
    assert f"line {number}: way 101" in said


def test_two_elements_of_one_id(refused: Any, text: str) -> None:
    tag = '<tag k="rtmap:id" v="kerb"/>'
    for number in (101, 102):
        text = text.replace(f'<way id="{number}">', f'<way id="{number}">{tag}')
    assert "2 elements are called kerb" in refused(text)


def test_a_street_map_has_no_markings(refused: Any, text: str) -> None:
    start, stop = text.index("<way"), text.index("</osm>")
    way = '<way id="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="residential"/></way>'
    assert "no Lanelet2 map" in refused(text[:start] + way + text[stop:])


def test_a_crs_of_another_place(refused: Any, text: str) -> None:
    assert "lies outside EPSG:32617" in refused(text, "--crs", "EPSG:32617")


def test_an_origin_of_another_place(refused: Any, text: str) -> None:
    said = refused(text, "--origin", 400000, 5400000)
    assert "pass --crs too" in said


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "nonsense"])
def test_a_crs_that_carries_no_map(rtmap: Rtmap, tmp_path: Path, crs: str) -> None:
    path = street().write(tmp_path / "in.osm")
    said = rtmap("import", "lanelet2", path, "--crs", crs, "-o", tmp_path / "map", code=3)
    assert crs in said.err and not (tmp_path / "map").exists()


def test_local_coordinates_without_an_origin(rtmap: Rtmap, tmp_path: Path) -> None:
    path = street().write(tmp_path / "in.osm", degrees="empty", local=(0.0, 0.0))
    said = rtmap("import", "lanelet2", path, "-o", tmp_path / "map", code=3)
    assert "pass --crs and --origin" in said.err
    far = ["--crs", CRS, "--origin", 9e6, 9e6]
    said = rtmap("import", "lanelet2", path, *far, "-o", tmp_path / "map", code=3)
    assert said.err.count("\n") == 1 and not (tmp_path / "map").exists()


def test_missing_files_and_outputs_that_exist(rtmap: Rtmap, tmp_path: Path) -> None:
    out = tmp_path / "map"
    assert "no such file" in rtmap("import", "lanelet2", tmp_path / "x", "-o", out, code=3).err
    (tmp_path / "folder").mkdir()
    assert "no such file" in rtmap("import", "lanelet2", tmp_path / "folder", "-o", out, code=3).err
    path = street().write(tmp_path / "in.osm")
    rtmap("import", "lanelet2", path, "-o", out)
    assert "exists already" in rtmap("import", "lanelet2", path, "-o", out, code=2).err
    assert "exists already" in rtmap("export", "lanelet2", out, "-o", path, code=2).err
    rtmap("export", "lanelet2", out, "-o", out / "in.osm", code=3)
    rtmap("export", "lanelet2", tmp_path / "x", "-o", tmp_path / "y.osm", code=3)
    assert not (tmp_path / "y.osm").exists()


def test_what_is_marked_deleted_is_not_there(rtmap: Rtmap, tmp_path: Path, text: str) -> None:
    path = tmp_path / "in.osm"
    for kind, number in (("relation", 220), ("way", 120), ("node", 30)):
        item = f'<{kind} id="{number}"'
        assert item in text
        text = text.replace(item, f'{item} action="delete"')
    text = text.replace('<member type="relation" ref="220" role="regulatory_element"/>', "")
    path.write_text(text, encoding="utf-8")
    rtmap("import", "lanelet2", path, "-o", tmp_path / "map")
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "out.osm")
    out = (tmp_path / "out.osm").read_text(encoding="utf-8")
    assert 'id="220"' not in out and 'id="120"' not in out and 'id="30"' not in out
    assert 'id="121"' in out


def test_other_encodings_and_namesakes(rtmap: Rtmap, tmp_path: Path, text: str) -> None:
    """A node, a way and a relation may share an id; UTF-16 is XML too."""
    text = text.replace('<way id="101"', '<way id="1"').replace('ref="101"', 'ref="1"')
    text = text.replace('<?xml version="1.0"?>', '<?xml version="1.0" encoding="UTF-16"?>')
    path = tmp_path / "in.osm"
    path.write_bytes(text.encode("utf-16"))
    rtmap("import", "lanelet2", path, "-o", tmp_path / "map")
    rtmap("export", "lanelet2", tmp_path / "map", "-o", tmp_path / "out.osm")
    assert '<way id="1" ' in (tmp_path / "out.osm").read_text(encoding="utf-8")
