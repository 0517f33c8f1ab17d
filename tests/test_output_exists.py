"""An output that exists is a usage error (2) of every verb that writes, and stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from rtmap_cli.cli import COMMANDS, group

NOWHERE = "nowhere"
WRITERS: dict[str, list[str]] = {
    "infer": [NOWHERE],
    "detect-changes": [NOWHERE, "--map", NOWHERE],
    "import av2": [NOWHERE],
    "import nuscenes": [NOWHERE],
    "import geojson": [NOWHERE],
    "import lanelet2": [NOWHERE],
    "import detections": [NOWHERE],
    "export geojson": [NOWHERE],
    "export lanelet2": [NOWHERE],
    "simulate town": ["--size", "150"],
    "simulate changes": ["--map", NOWHERE, "--change", "delete:divider"],
    "simulate degrade": ["--map", NOWHERE],
    "simulate images": ["--map", NOWHERE, "--log", "town:"],
    "simulate observations": ["--map", NOWHERE, "--log", "town:"],
    "simulate lidar": ["--map", NOWHERE, "--log", "town:"],
    "label cloud": [NOWHERE],
    "label lift": [NOWHERE, "--cloud", NOWHERE],
    "label lanes": [NOWHERE],
    "label frames": [NOWHERE, NOWHERE],
    "semantic-map": [NOWHERE],
    "update": [NOWHERE, "--map", NOWHERE],
    "map review": [NOWHERE, "--accept", "some"],
    "map diff": [NOWHERE, "0", "1"],
    "picture": [NOWHERE],
    "train": ["--frames", "1", "--steps", "1"],
    "export-model": [NOWHERE],
    "demo": [],
}
"""Arguments with which each verb comes as far as its output."""

PLOTTERS = {
    "evaluate uncertainty": [NOWHERE, "--poses", NOWHERE, "--plot"],
    "label merge": [NOWHERE, NOWHERE, "--into", "labels", "--conflicts"],
}
"""Verbs whose only file is one that one may ask for; alike, up to the file's path."""

FILES = (
    "detect-changes",
    "export geojson",
    "export lanelet2",
    "update",
    "map review",
    "map diff",
    "picture",
    "train",
    "export-model",
)


def _leaves(table: dict[str, Any], before: str = "") -> Iterator[tuple[str, click.Command]]:
    with click.Context(group) as context:
        for name, entry in table.items():
            if isinstance(entry[1], dict):
                yield from _leaves(entry[1], f"{name} ")
                continue
            parent = group if not before else group.get_command(context, before.strip())
            assert isinstance(parent, click.Group)
            command = parent.get_command(context, name)
            assert command is not None
            yield before + name, command


def test_the_verbs_that_can_overwrite_are_all_here() -> None:
    can = {n for n, c in _leaves(COMMANDS) if any(p.name == "overwrite" for p in c.params)}
    assert can == {*WRITERS, *PLOTTERS}


@pytest.mark.parametrize("name", WRITERS)
def test_an_output_that_exists_is_a_usage_error(
    rtmap: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    output = tmp_path / "out.png"
    if name in FILES:
        output.write_bytes(b"precious")
    else:
        output.mkdir()
        (output / "precious").touch()
    result = rtmap(*name.split(), *WRITERS[name], "-o", output, code=2)
    assert f"{output}: exists already; " in result.err and "--overwrite" in result.err
    assert len(result.err.strip().splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["out.png"]
    kept = output.read_bytes() if name in FILES else [p.name for p in output.iterdir()]
    assert kept in (b"precious", ["precious"])


def test_second_outputs_are_guarded_alike(rtmap: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "precious").write_bytes(b"precious")
    second = {
        "simulate changes": ("--truth", "run"),
        "simulate observations": ("--truth-poses", "run"),
        "export-model": ("--report", "model.onnx"),
    }
    for name, (option, output) in second.items():
        guarded = (option, tmp_path / "precious")
        told = rtmap(*name.split(), *WRITERS[name], "-o", tmp_path / output, *guarded, code=2)
        assert "precious: exists already" in told.err
    assert (tmp_path / "precious").read_bytes() == b"precious"


@pytest.mark.parametrize("name", PLOTTERS)
def test_a_picture_that_exists_is_a_usage_error(
    rtmap: Callable[..., Any], tmp_path: Path, name: str
) -> None:
    picture = tmp_path / "plot.png"
    picture.write_bytes(b"precious")
    told = rtmap(*name.split(), *PLOTTERS[name], picture, code=2)
    assert f"{picture}: exists already; " in told.err and "--overwrite" in told.err
    assert picture.read_bytes() == b"precious"
