"""Where a network was trained: from the frames through weights and model to the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_logs import write_native_log

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
pytest.importorskip("onnxscript", reason="onnxscript is not installed (extra: train)")
pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")

import onnx  # noqa: E402
from rtmap_models.training.checkpoint import footprint_of_source, load_checkpoint  # noqa: E402
from training_frames import painted_frames, tiny_config  # noqa: E402

from rtmap_cli.errors import BadInput  # noqa: E402
from rtmap_cli.formats.model_file import find_model  # noqa: E402
from rtmap_cli.geometry.poses import se3_from_xyyaw  # noqa: E402
from rtmap_cli.maps.crs import to_lonlat  # noqa: E402
from rtmap_cli.maps.element import Element, VectorMap  # noqa: E402
from rtmap_cli.maps.footprint import (  # noqa: E402
    METADATA_KEY,
    NOTHING_KNOWN,
    TOWNS,
    Footprint,
    footprint_of_poses,
    read_footprint,
)
from rtmap_cli.maps.store import write_new_map  # noqa: E402

CRS = "EPSG:32617"
HERE = to_lonlat(CRS, np.array([[583_000.0, 4_477_000.0]]))
"""Where the log of `write_native_log` begins."""
HOME = se3_from_xyyaw(583_000.0, 4_477_000.0, 0.0)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_config(tmp_path_factory.mktemp("config"))


@pytest.fixture
def step(rtmap: Any, tiny: Path, tmp_path: Path) -> Any:
    """``step("a", …)`` trains one step and gives what a.pt says it was trained on."""

    def call(name: str, *arguments: object) -> Footprint:
        command = ("train", "-o", tmp_path / f"{name}.pt", "--config", tiny, "--steps", 1)
        rtmap(*command, "--threads", 1, "--batch", 1, "--device", "cpu", *arguments)
        _, content = load_checkpoint(tmp_path / f"{name}.pt")
        return read_footprint(content.get("footprint"))

    return call


def note(folder: Path, **info: object) -> Path:
    """Frames with something else in the JSON of their only shard."""
    (path,) = folder.glob("*.json")
    path.write_text(json.dumps({"frames": 12, **info}))
    return folder


def a_log(folder: Path, **creation: object) -> Path:
    log = write_native_log(folder)
    info = json.loads((log / "log.json").read_text())
    (log / "log.json").write_text(json.dumps(info | {"creation": creation}))
    return log


def test_weights_know_their_places(rtmap: Any, step: Any, tiny: Path, tmp_path: Path) -> None:
    line = np.array([[582_950.0, 4_477_002.0], [583_100.0, 4_477_002.0]])
    where = tmp_path / "map"
    write_new_map(VectorMap([Element("a", "divider", line)], CRS), where, "test")
    real = step("real", "--data", a_log(tmp_path / "log"), "--map", where)
    assert real.known and real.origins == {"places"} and real.holds(HERE).all()
    assert 1 <= len(real.cells) <= 8
    simulated = a_log(tmp_path / "drawn", simulated=True, log="town:", command="simulate")
    assert step("drawn", "--data", simulated, "--map", where).origins == {"procedural"}
    towns = note(painted_frames(tmp_path / "towns", tiny), town=3)
    # The first weights hand on what they saw, and so do those that a run goes on from.
    second = step("second", "--data", towns, "--init", tmp_path / "real.pt")
    assert second.origins == {"places", "procedural"} and second.cells == real.cells
    command = ("train", "-o", tmp_path / "third.pt", "--config", tiny, "--steps", 3, "-q")
    more = ("--data", towns, "--threads", 1, "--batch", 1, "--device", "cpu")
    rtmap(*command, *more, "--resume", tmp_path / "second.pt")
    assert load_checkpoint(tmp_path / "third.pt")[1]["footprint"] == second.as_json()


def test_frames_that_cannot_be_believed(rtmap: Any, tiny: Path, tmp_path: Path) -> None:
    frames = note(painted_frames(tmp_path / "frames", tiny), footprint={"cells": 3})
    command = ("train", "-o", tmp_path / "a.pt", "--config", tiny, "--steps", 1, "--data", frames)
    bad = rtmap(*command, "--threads", 1, code=3)
    assert "unreadable shard" in bad.err and "footprint" in bad.err
    assert bad.err.count("\n") == 1


def test_weights_that_do_not_know(rtmap: Any, step: Any, tiny: Path, tmp_path: Path) -> None:
    frames = painted_frames(tmp_path / "frames", tiny)
    assert step("old", "--data", frames).origins == {"unknown"}
    _, content = load_checkpoint(tmp_path / "old.pt")
    del content["footprint"]  # as weights of earlier versions are
    torch.save(content, tmp_path / "old.pt")
    export = ("export-model", tmp_path / "old.pt", "-o", tmp_path / "new.onnx")
    # An export takes a while: these stop before it.
    silent = rtmap(*export, "--calibrate", tmp_path / "none", code=3)
    assert "trained on something unknown: say what with --trained-on" in silent.err
    assert "no such model, run, map or log" in rtmap(*export, "--trained-on", "x", code=3).err
    hidden = rtmap(*export, "--calibrate", tmp_path / "none", "--no-footprint", code=3)
    assert "unknown" not in hidden.err
    rtmap(*export, "--trained-on", "procedural", "--no-footprint", code=2)
    towns = note(painted_frames(tmp_path / "towns", tiny), town=3)
    for known in ("procedural", towns, write_native_log(tmp_path / "log", frames=2)):
        told = rtmap(*export, "--calibrate", tmp_path / "none", "--trained-on", known, code=3)
        assert "unknown" not in told.err
    still = rtmap(*export, "--calibrate", tmp_path / "none", "--trained-on", frames, code=3)
    assert "something unknown" in still.err, "frames that do not know their place tell nothing"


def test_what_a_model_says_goes_into_its_runs_and_heirs(rtmap: Any, tmp_path: Path) -> None:
    seen = footprint_of_poses(HOME[None], CRS, (-36, -18, 36, 18)) | TOWNS
    model, path = onnx.load(find_model("rtmap-tiny")), tmp_path / "model.onnx"
    kept = [e for e in model.metadata_props if e.key != METADATA_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    onnx.save(model, path)
    assert footprint_of_source(str(path)) == NOTHING_KNOWN
    entry = model.metadata_props.add()
    entry.key, entry.value = METADATA_KEY, json.dumps(seen.as_json())
    onnx.save(model, path)
    assert footprint_of_source(str(path)) == seen
    log = write_native_log(tmp_path / "log", frames=2)
    rtmap("infer", log, "--model", path, "-o", tmp_path / "run", "-q", "--threads", 1)
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert read_footprint(info["model_footprint"]) == seen
    entry.value = "{"
    onnx.save(model, path)
    with pytest.raises(BadInput, match="metadata make no sense"):
        footprint_of_source(str(path))
