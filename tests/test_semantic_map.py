"""``rtmap semantic-map`` on small logs whose ground is known, through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from semantic_samples import (
    CAMERA,
    RIBBON,
    SPEED,
    STEP_S,
    ribbon_label,
    ribbon_log,
    ribbon_mask,
    ribbon_rig,
    write_labels,
)

from rtmap_cli.logs.semantic import CLASSES, SemanticMap

Call = Any
TRUTH = {1: "road", 2: "crosswalk", 3: "marking", 4: "sidewalk"}
EAST, NORTH = 500_000.0, 5_000_000.0


@pytest.fixture(scope="module")
def ribbon(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ribbon_log(tmp_path_factory.mktemp("logs") / "ribbon")


def cells_of(folder: Path) -> dict[str, Any]:
    table = pq.read_table(folder / "cells.parquet")
    return {n: table[n].to_numpy(zero_copy_only=False) for n in table.column_names}


def agreement(cells: dict[str, Any], edge: float = 0.15) -> float:
    """Share of the cells whose class is that of the ground, cells across a border left out."""
    x, y = cells["x"] - EAST, cells["y"] - NORTH
    truth = ribbon_label(x, y)
    shifts = [(edge, 0), (-edge, 0), (0, edge), (0, -edge)]
    inner = np.logical_and.reduce([ribbon_label(x + a, y + b) == truth for a, b in shifts])
    names = np.array([TRUTH[int(t)] for t in truth])
    return float((cells["class_name"] == names)[inner].mean())


def test_sweeps_and_masks_become_the_ground(rtmap: Call, ribbon: Path, tmp_path: Path) -> None:
    out = tmp_path / "semantic"
    result = json.loads(rtmap("semantic-map", ribbon, "-o", out, "--json", "-q").out)
    assert result["windows"] == 4 and result["points_from"] == "LiDAR" and not result["unused"]
    cells = cells_of(out)
    assert result["cells"] == len(cells["x"]) > 5_000
    assert agreement(cells) > 0.98
    assert np.allclose(sum(cells[f"p_{n}"] for n in CLASSES), 1, atol=1e-5)
    assert np.allclose(cells["z"], 0, atol=0.01) and cells["frames"].max() == 4
    # The painted line: thinner than two cells, where it is.
    line = (cells["class_name"] == "marking") & (cells["x"] - EAST > 3)
    assert abs(np.mean(cells["y"][line] - NORTH) - 1.0) < 0.04
    assert np.abs(cells["y"][line] - NORTH - 1.0).max() < 0.45


def test_ego_motion_between_the_sensors_is_taken_out(
    rtmap: Call, ribbon: Path, tmp_path: Path
) -> None:
    """LiDAR 0.04 s before, camera 0.1 s after the frame: at 10 m/s they see 1.4 m apart."""
    import pyarrow as pa

    from rtmap_cli.logs.tables import IMAGES, LIDAR
    from rtmap_cli.tables import write_table

    rtmap("semantic-map", ribbon, "-o", tmp_path / "right", "-q")
    log = ribbon_log(tmp_path / "log")
    frames = pq.read_table(log / "frames.parquet")
    for name, schema in (("images", IMAGES), ("lidar", LIDAR)):
        table = pq.read_table(log / f"{name}.parquet")
        at = table.column_names.index("timestamp_ns")
        table = table.set_column(at, "timestamp_ns", pa.array(frames["timestamp_ns"].to_numpy()))
        write_table(table, log / f"{name}.parquet", schema)
    rtmap("semantic-map", log, "-o", tmp_path / "wrong", "-q")

    def crosswalk(folder: Path) -> tuple[float, float]:
        cells = cells_of(folder)
        x = cells["x"][cells["class_name"] == "crosswalk"] - EAST
        return float(np.percentile(x, 2)), float(np.percentile(x, 98))

    right, wrong = crosswalk(tmp_path / "right"), crosswalk(tmp_path / "wrong")
    assert abs(right[0] - 12) < 0.25 and abs(right[1] - 15) < 0.25
    assert abs(wrong[0] - 12) > 0.6 and abs(wrong[1] - 15) > 0.6


def test_without_lidar_the_ground_is_a_plane(rtmap: Call, tmp_path: Path) -> None:
    log = ribbon_log(tmp_path / "log", sweeps=False)
    result = rtmap("semantic-map", log, "-o", tmp_path / "out")
    assert "no sweep" in result.err and "ground plane" in result.out
    assert agreement(cells_of(tmp_path / "out"), 0.25) > 0.97


def test_the_ego_window_is_what_lies_around_the_frame(
    rtmap: Call, ribbon: Path, tmp_path: Path
) -> None:
    rtmap("semantic-map", ribbon, "-o", tmp_path / "out", "-q", "--window", 20, 8, "--cell", 0.25)
    semantic = SemanticMap(tmp_path / "out")
    assert len(semantic) == 4 and semantic.classes == CLASSES
    assert (semantic.window.rows, semantic.window.columns) == (64, 160)
    for frame in (0, 3):
        planes = semantic.read_window(frame)
        assert planes.shape == (len(CLASSES) + 1, 64, 160) and planes.dtype == np.uint8
        ego = semantic.window.centres()
        x = ego[..., 0] + SPEED * STEP_S * frame
        truth = np.vectorize(lambda k: CLASSES.index(TRUTH[int(k)]))(ribbon_label(x, ego[..., 1]))
        sure = planes[:-1].max(axis=0) > 200
        assert (planes[:-1].argmax(axis=0) == truth)[sure].mean() > 0.93
        behind = ego[..., 0] < -SPEED * STEP_S * frame - 1
        assert not planes[:, behind].any(), "nothing behind the first frame was ever seen"
    assert np.count_nonzero(semantic.read_window(3)[-1]) > np.count_nonzero(
        semantic.read_window(0)[-1]
    ), "later windows remember what earlier frames saw"


def test_its_description_follows_the_schema(rtmap: Call, ribbon: Path, tmp_path: Path) -> None:
    rtmap("semantic-map", ribbon, "-o", tmp_path / "out", "-q")
    info = json.loads((tmp_path / "out" / "semantic.json").read_text())
    file = Path(__file__).resolve().parents[1] / "schemas" / "rtmap.semantic.json"
    described = json.loads(file.read_text())["properties"]
    assert set(info) == set(described)
    assert set(info["window"]) == set(described["window"]["properties"])
    assert info["window"]["planes"] == [*CLASSES, "evidence"]


def test_windows_of_the_whole_drive_and_none(rtmap: Call, ribbon: Path, tmp_path: Path) -> None:
    rtmap("semantic-map", ribbon, "-o", tmp_path / "all", "-q", "--windows", "all")
    rtmap("semantic-map", ribbon, "-o", tmp_path / "past", "-q")
    whole, past = (SemanticMap(tmp_path / n) for n in ("all", "past"))
    assert (whole.read_window(0)[-1] > 0).sum() > 1.3 * (past.read_window(0)[-1] > 0).sum()
    np.testing.assert_array_equal(whole.read_window(3), past.read_window(3))
    rtmap("semantic-map", ribbon, "-o", tmp_path / "none", "-q", "--windows", "none")
    assert not (tmp_path / "none" / "windows").exists()


def test_tiles_lie_where_their_world_files_say(rtmap: Call, ribbon: Path, tmp_path: Path) -> None:
    rtmap("semantic-map", ribbon, "-o", tmp_path / "out", "-q")
    cells = cells_of(tmp_path / "out")
    drawn = 0
    for picture in (tmp_path / "out" / "tiles").glob("*.png"):
        values = [float(v) for v in picture.with_suffix(".pgw").read_text().split()]
        size_x, _, _, size_y, west, north = values
        image = np.asarray(Image.open(picture))
        column = (cells["x"] - west) / size_x
        row = (cells["y"] - north) / size_y
        inside = (column > -0.5) & (column < 255.5) & (row > -0.5) & (row < 255.5)
        at = np.round(row[inside]).astype(int), np.round(column[inside]).astype(int)
        assert np.allclose(column[inside], at[1], atol=1e-3)
        assert (image[at][:, 3] > 0).all()
        drawn += int((image[..., 3] > 0).sum())
        assert "UTM_Zone_32N" in picture.with_suffix(".prj").read_text()
    assert drawn == len(cells["x"])
    assert Image.open(tmp_path / "out" / "overview.png").size[0] > 50


def test_same_input_same_bytes(rtmap: Call, ribbon: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        rtmap("semantic-map", ribbon, "-o", tmp_path / name, "-q")
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) > 10
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_given_poses_are_used(rtmap: Call, ribbon: Path, tmp_path: Path) -> None:
    from dataclasses import replace

    from rtmap_cli.logs.run import Poses
    from rtmap_cli.logs.run_files import write_poses

    frames = pq.read_table(ribbon / "frames.parquet").to_pydict()
    pose = np.tile(np.eye(4), (4, 1, 1))
    pose[:, 0, 3], pose[:, 1, 3] = np.array(frames["x"]), np.array(frames["y"]) + 7.0
    poses = Poses(
        frame=np.arange(4, dtype=np.int32), timestamp_ns=np.array(frames["timestamp_ns"]),
        method="truth", pose=pose, covariance=np.zeros((4, 6, 6)),
        eigenvalues=np.full((4, 3), np.nan), weakest_direction=np.full((4, 3), np.nan),
        residual_count=np.zeros(4, np.int32), chi2=np.zeros(4),
        status=np.full(4, "ok", dtype=object),
    )  # fmt: skip
    late = replace(poses, timestamp_ns=poses.timestamp_ns + 1)
    for name, content in (("moved", poses), ("late", late)):
        (tmp_path / name).mkdir()
        write_poses(content, tmp_path / name, "EPSG:32632")
    rtmap("semantic-map", ribbon, "-o", tmp_path / "out", "-q", "--poses", tmp_path / "moved")
    cells = cells_of(tmp_path / "out")
    line = (cells["class_name"] == "marking") & (cells["x"] - EAST > 3)
    assert abs(np.mean(cells["y"][line] - NORTH) - 8.0) < 0.04
    result = rtmap(
        "semantic-map", ribbon, "-o", tmp_path / "no", "--poses", tmp_path / "late", code=3
    )
    assert "another time" in result.err and not (tmp_path / "no").exists()


def test_a_segmentation_network_makes_the_masks(rtmap: Call, ribbon: Path, tmp_path: Path) -> None:
    """Images of the log show label · 50 as grey: a 1 × 1 convolution tells the label again."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    levels = np.arange(len(RIBBON)) * 50 / 255
    # −(g − l)² up to what all labels share: 2·g·l − l².
    weight = np.zeros((len(RIBBON), 3, 1, 1), np.float32)
    weight[:, 0, 0, 0] = 2 * levels * 1000
    tensors = {"w": weight, "b": (-(levels**2) * 1000).astype(np.float32)}
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "w", "b"], ["scores"])],
        "levels",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])],
        [helper.make_tensor_value_info("scores", TensorProto.FLOAT, [1, len(RIBBON), "h", "w"])],
        [numpy_helper.from_array(v.astype(np.float32), k) for k, v in tensors.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, tmp_path / "seg.onnx")
    labels = {"labels": [{"name": n} for n in RIBBON], "input": {"mean": [0] * 3, "std": [1] * 3}}
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    command = (
        "semantic-map", ribbon, "--segmenter", tmp_path / "seg.onnx", "-q", "--threads", 1
    )  # fmt: skip
    rtmap(*command, "--labels", tmp_path / "labels.json", "-o", tmp_path / "out")
    assert agreement(cells_of(tmp_path / "out"), 0.25) > 0.95
    labels["labels"].append({"name": "nature--sky"})  # type: ignore[attr-defined]
    (tmp_path / "more.json").write_text(json.dumps(labels))
    result = rtmap(*command, "--labels", tmp_path / "more.json", "-o", tmp_path / "no", code=3)
    assert "answers with 5 labels" in result.err and "lists 6" in result.err
    assert not (tmp_path / "no").exists()


def test_masks_may_be_named_as_the_images_and_hold_16_bits(rtmap: Call, tmp_path: Path) -> None:
    log = ribbon_log(tmp_path / "log", frames=2)
    masks = tmp_path / "masks"
    write_labels(masks, RIBBON)
    (masks / CAMERA).mkdir()
    for k in range(2):
        mask = ribbon_mask(ribbon_rig().cameras[0], SPEED * (STEP_S * k + 0.1))
        Image.fromarray(mask.astype(np.uint16)).save(masks / CAMERA / f"{k:06d}.png")
    rtmap("semantic-map", log, "--masks", masks, "-o", tmp_path / "out", "-q")
    rtmap("semantic-map", log, "-o", tmp_path / "own", "-q")
    assert (tmp_path / "out" / "cells.parquet").read_bytes() == (
        tmp_path / "own" / "cells.parquet"
    ).read_bytes()
