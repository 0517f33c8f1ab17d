"""Bad input of ``rtmap semantic-map``: one clear line, its exit code, nothing written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from semantic_samples import CAMERA, RIBBON, ribbon_log

from rtmap_cli.logs.semantic import SemanticMap
from rtmap_cli.logs.tables import IMAGES, SWEEP
from rtmap_cli.tables import write_table

Call = Any


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ribbon_log(tmp_path_factory.mktemp("logs") / "ribbon", frames=2)


@pytest.fixture
def log(whole: Path, tmp_path: Path) -> Path:
    """A log of two frames that a test may break."""
    shutil.copytree(whole, tmp_path / "log")
    return tmp_path / "log"


def mask_of(log: Path) -> Path:
    return log / "masks" / CAMERA / "000001.png"


def labels_of(log: Path) -> Path:
    return log / "masks" / "labels.json"


def smaller_mask(log: Path) -> None:
    Image.open(mask_of(log)).resize((160, 100), 0).save(mask_of(log))


def unknown_number(log: Path) -> None:
    mask = np.array(Image.open(mask_of(log)))
    mask[150, 100] = 77
    Image.fromarray(mask).save(mask_of(log))


def coloured_mask(log: Path) -> None:
    Image.open(mask_of(log)).convert("RGB").save(mask_of(log))


def broken_mask(log: Path) -> None:
    mask_of(log).write_bytes(mask_of(log).read_bytes()[:60])


def no_masks(log: Path) -> None:
    shutil.rmtree(log / "masks")


def empty_masks(log: Path) -> None:
    shutil.rmtree(log / "masks" / CAMERA)


def masks_of_another_camera(log: Path) -> None:
    (log / "masks" / CAMERA).rename(log / "masks" / "rear")


def no_labels(log: Path) -> None:
    labels_of(log).unlink()


def strange_name(log: Path) -> None:
    names = [*RIBBON[:-1], "the-blue-stuff"]
    labels_of(log).write_text(json.dumps({"labels": [{"name": n} for n in names]}))


def strange_class(log: Path) -> None:
    labels_of(log).write_text(json.dumps({"labels": [{"name": "road", "class": "street"}]}))


def nothing_of_the_ground(log: Path) -> None:
    labels_of(log).write_text(json.dumps({"labels": [{"name": "nature--sky"}]}))


def no_list(log: Path) -> None:
    labels_of(log).write_text("[1, 2]")


def no_extrinsics(log: Path) -> None:
    (log / "rig.parquet").unlink()
    (log / "images.parquet").unlink()


def late_camera(log: Path) -> None:
    table = pq.read_table(log / "images.parquet")
    at = table.column_names.index("timestamp_ns")
    times = pa.array(table["timestamp_ns"].to_numpy() + 700_000_000)
    write_table(table.set_column(at, "timestamp_ns", times), log / "images.parquet", IMAGES)


def empty_sweep(log: Path) -> None:
    path = log / "lidar" / "000001.parquet"
    write_table(pq.read_table(path).slice(0, 0), path, SWEEP)


def missing_sweep(log: Path) -> None:
    (log / "lidar" / "000001.parquet").unlink()


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (smaller_mask, "is 160×100, its camera's images are 320×200"),
        (unknown_number, "label 77 is not in"),
        (coloured_mask, "not label numbers"),
        (broken_mask, "cannot be read as a mask"),
        (no_masks, "no such folder of masks; give --masks DIR, or --segmenter"),
        (empty_masks, "holds no masks"),
        (masks_of_another_camera, "has no calibration of this camera; it has front"),
        (no_labels, "no such label list"),
        (strange_name, "nothing is known of label 4 (the-blue-stuff)"),
        (strange_class, "is of unknown class 'street'"),
        (nothing_of_the_ground, "none of its labels is a class of the ground"),
        (no_list, "is not a label list"),
        (no_extrinsics, "has no calibration"),
        (late_camera, "front and the LiDAR are 0.84 s apart"),
        (empty_sweep, "holds no point"),
        (missing_sweep, "000001.parquet"),
    ],
)
def test_bad_logs(
    rtmap: Call, log: Path, tmp_path: Path, harm: Callable[[Path], None], said: str
) -> None:
    harm(log)
    result = rtmap("semantic-map", log, "-o", tmp_path / "out", "-q", code=3)
    assert said in result.err and result.err.count("\n") == 1, result.err
    assert not (tmp_path / "out").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log"], "nothing half-written"


def test_a_longer_delay_may_be_allowed(rtmap: Call, log: Path, tmp_path: Path) -> None:
    late_camera(log)
    rtmap("semantic-map", log, "-o", tmp_path / "out", "-q", "--max-delay", 1)


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (smaller_mask, "160 × 100, the calibration of front says 320 × 200"),
        (broken_mask, "cannot be read as an image"),
        (masks_of_another_camera, "rear is not in rig.parquet"),
        (no_labels, "has no labels.json"),
    ],
)
def test_check_log_names_bad_masks(
    rtmap: Call, log: Path, harm: Callable[[Path], None], said: str
) -> None:
    assert "0 errors" in rtmap("check-log", log, code=0).out
    harm(log)
    assert said in rtmap("check-log", log, code=3).out


def test_bad_side_files(rtmap: Call, log: Path, tmp_path: Path) -> None:
    side = tmp_path / "side.json"
    for content, said in (
        ({"classes": ["road"], "matrix": [[1]]}, "has other classes than"),
        ({"matrix": 1}, "is not a confusion matrix"),
    ):
        side.write_text(json.dumps(content))
        result = rtmap("semantic-map", log, "--confusion", side, "-o", tmp_path / "o", code=3)
        assert said in result.err
    result = rtmap("semantic-map", log, "--poses", tmp_path / "none", "-o", tmp_path / "o", code=3)
    assert "no such poses" in result.err
    side.write_bytes(b"not a network")
    labels = ("--labels", labels_of(log), "-o", tmp_path / "o")
    result = rtmap("semantic-map", log, "--segmenter", side, *labels, code=3)
    assert "cannot be loaded as ONNX" in result.err
    result = rtmap("semantic-map", log, "--segmenter", side, "-o", tmp_path / "o", code=3)
    assert "give --labels" in result.err
    result = rtmap(
        "semantic-map", log, "--segmenter", side, "--masks", log / "masks", *labels, code=2
    )
    assert "give one of them" in result.err
    assert not (tmp_path / "o").exists()


def test_no_ground_in_any_mask_is_no_answer(rtmap: Call, log: Path, tmp_path: Path) -> None:
    for path in (log / "masks" / CAMERA).glob("*.png"):
        Image.fromarray(np.zeros((200, 320), np.uint8)).save(path)
    result = rtmap("semantic-map", log, "-o", tmp_path / "out", "-q", code=4)
    assert "no point of the ground has a class" in result.err and not (tmp_path / "out").exists()


def test_outputs_are_not_replaced_unasked(rtmap: Call, log: Path, tmp_path: Path) -> None:
    rtmap("semantic-map", log, "-o", tmp_path / "out", "-q")
    rtmap("semantic-map", log, "-o", tmp_path / "out", "-q", code=2)
    rtmap("semantic-map", log, "-o", tmp_path / "out", "-q", "--overwrite")
    result = rtmap("semantic-map", log, "-o", log, "-q", "--overwrite", code=3)
    assert "would replace the input" in result.err and (log / "log.json").exists()


def test_broken_semantic_maps_are_refused(rtmap: Call, log: Path, tmp_path: Path) -> None:
    from rtmap_cli.errors import BadInput

    out = tmp_path / "out"
    rtmap("semantic-map", log, "-o", out, "-q")
    Image.fromarray(np.zeros((10, 10), np.uint8)).save(out / "windows" / "000001.png")
    with pytest.raises(BadInput, match="is not the 8-bit raster"):
        SemanticMap(out).read_window(1)
    with pytest.raises(BadInput, match="no raster of frame 9"):
        SemanticMap(out).read_window(9)
    with pytest.raises(BadInput, match="is not a semantic map"):
        SemanticMap(log)
