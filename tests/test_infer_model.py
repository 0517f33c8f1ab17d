"""Models that keep the contract run; models that lie about themselves end in one line, exit 3."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_logs import write_native_log

from rtmap_cli.logs.run_files import read_run

onnx = pytest.importorskip("onnx", reason="onnx is not installed (extra: train)")

CLASSES, VERTICES, HEIGHT, WIDTH = 3, 4, 16, 24
F32, U8, I64 = (getattr(onnx.TensorProto, name) for name in ("FLOAT", "UINT8", "INT64"))

META: dict[str, Any] = {
    "model_name": "small",
    "classes": ["ped_crossing", "divider", "boundary"],
    "range_m": {"x": [-36.0, 36.0], "y": [-18.0, 18.0]},
    "axis_order": "x forward, y left",
    "ground": "z = 0",
    "units": "metres",
    "vertex_count": VERTICES,
    "prior_slots": 5,
    "image_size": [HEIGHT, WIDTH],
    "horizon": 0.3,
    "sigma": "standard deviation, metres",
}

IN: dict[str, Any] = {
    "images": (U8, ["B", "N", HEIGHT, WIDTH, 3]),
    "ego_to_image": (F32, ["B", "N", 3, 4]),
    "prior_points": (F32, ["B", "P", VERTICES, 2]),
    "prior_class": (I64, ["B", "P"]),
    "prior_mask": (F32, ["B", "P"]),
}

OUT: dict[str, Any] = {
    "scores": (["Q", CLASSES], 0.5),
    "points": (["Q", VERTICES, 2], 1.0),
    "sigma": (["Q", VERTICES, 2], 0.3),
    "prior_score": (["P"], 0.9),
    "pose_delta": ([3], 0.0),
    "pose_covariance": ([3, 3], 0.1),
}


def write_model(
    path: Path,
    meta: dict[str, Any] | None = None,
    inputs: dict[str, Any] | None = None,
    outputs: dict[str, Any] | None = None,
    hidden: bool = False,
) -> Path:
    """A model that answers constants, one new query beside the prior slots; None leaves out.

    ``hidden`` declares the sizes of the outputs dynamic, as some exporters do.
    """
    helper = onnx.helper
    given, answers = IN | (inputs or {}), OUT | (outputs or {})
    nodes = [
        helper.make_node("Shape", ["prior_mask"], ["B"], start=0, end=1),
        helper.make_node("Shape", ["prior_mask"], ["P"], start=1, end=2),
        helper.make_node("Add", ["P", "one"], ["Q"]),
    ]
    constants = [onnx.numpy_helper.from_array(np.array([1], np.int64), "one")]
    declared = []
    for name, answer in answers.items():
        if answer is None:
            continue
        shape, value = answer
        sizes = [s for s in shape if isinstance(s, int)]
        fixed = onnx.numpy_helper.from_array(np.array(sizes, np.int64), f"{name} sizes")
        filled = onnx.numpy_helper.from_array(np.array([value], np.float32), f"{name} value")
        constants += [fixed, filled]
        axes = ["B", *[s for s in shape if isinstance(s, str)], f"{name} sizes"]
        nodes.append(helper.make_node("Concat", axes, [f"{name} shape"], axis=0))
        nodes.append(helper.make_node("Expand", [f"{name} value", f"{name} shape"], [name]))
        told = [None] * (len(shape) + 1) if hidden else ["B", *shape]
        declared.append(helper.make_tensor_value_info(name, F32, told))
    taken = [helper.make_tensor_value_info(n, *v) for n, v in given.items() if v is not None]
    graph = helper.make_graph(nodes, "small", taken, declared, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    for key, value in (META | (meta or {})).items():
        if value is not None:
            text = value if isinstance(value, str) else json.dumps(value)
            helper.set_model_props(
                model, {p.key: p.value for p in model.metadata_props} | {f"rtmap.{key}": text}
            )
    onnx.save(model, path)
    return path


@pytest.fixture
def refuse(rtmap: Callable[..., Any], tmp_path: Path) -> Callable[..., None]:
    """``refuse(what, meta=…)``: infer with such a model ends with exit 3 and one line, which names
    the file and says what; nothing is written."""

    def call(what: str, **changes: Any) -> None:
        path = write_model(tmp_path / "lies.onnx", **changes)
        log = tmp_path / "drive"
        if not log.exists():
            write_native_log(log)
        result = rtmap("infer", log, "--model", path, "-o", tmp_path / "run", "-q", code=3)
        assert len(result.err.strip().splitlines()) == 1, result.err
        assert "lies.onnx" in result.err and what in result.err, result.err
        assert not (tmp_path / "run").exists()

    return call


def test_a_model_that_keeps_the_contract_runs(rtmap: Callable[..., Any], tmp_path: Path) -> None:
    log = write_native_log(tmp_path / "drive")
    for hidden in (False, True):
        model = write_model(tmp_path / "small.onnx", hidden=hidden)
        rtmap("infer", log, "--model", model, "-o", tmp_path / "run", "-q", "--overwrite")
        run = read_run(tmp_path / "run")
        assert run.info["model"] == "small" and (run.observations.score == 0.5).all()


def test_metadata_must_be_there_and_make_sense(refuse: Callable[..., None]) -> None:
    for key in META:
        refuse(f"lacks rtmap.{key}", meta={key: None})
    refuse("rtmap.units is 'feet', not 'metres'", meta={"units": "feet"})
    refuse("rtmap.sigma", meta={"sigma": "Laplace scale, metres"})
    refuse("rtmap.axis_order", meta={"axis_order": "x right, y forward"})
    refuse("spans 36 … -36", meta={"range_m": {"x": [36.0, -36.0], "y": [-18.0, 18.0]}})
    refuse("make no sense", meta={"range_m": [1, 2]})
    refuse("make no sense", meta={"image_size": [16]})
    refuse("make no sense", meta={"horizon": "NaN"})
    refuse("make no sense", meta={"vertex_count": "many"})
    refuse("prior_slots is 0", meta={"prior_slots": 0})
    refuse("rtmap.classes are divider, divider", meta={"classes": ["divider", "divider"]})
    refuse("rtmap.classes are none", meta={"classes": []})


def test_metadata_that_the_graph_denies(refuse: Callable[..., None]) -> None:
    refuse("scores has the shape B×Q×3, its metadata say B×Q×2", meta={"classes": ["a", "b"]})
    refuse("prior_points has the shape B×P×4×2", meta={"vertex_count": 20})
    refuse("images has the shape B×N×16×24×3", meta={"image_size": [24, 16]})


def test_inputs_and_outputs_of_other_names_types_and_shapes(refuse: Callable[..., None]) -> None:
    refuse("has no input images", inputs={"images": None})
    refuse("has no output sigma", outputs={"sigma": None})
    refuse(
        "input images is tensor(float), not tensor(uint8)",
        inputs={"images": (F32, IN["images"][1])},
    )
    refuse("input prior_class is tensor(float)", inputs={"prior_class": (F32, ["B", "P"])})
    refuse("images has the shape", inputs={"images": (U8, ["B", "N", 3, HEIGHT, WIDTH])})
    refuse("images has the shape 1×N", inputs={"images": (U8, [1, "N", HEIGHT, WIDTH, 3])})
    refuse("prior_mask has the shape B×5", inputs={"prior_mask": (F32, ["B", 5])})
    refuse("an input speed that nobody gives", inputs={"speed": (F32, ["B"])})
    refuse("pose_delta has the shape B×2", outputs={"pose_delta": ([2], 0.0)})
    refuse("sigma has the shape", outputs={"sigma": (["Q", VERTICES], 0.3)})


def test_answers_that_break_the_contract(refuse: Callable[..., None]) -> None:
    refuse("answers points that are not finite", outputs={"points": (["Q", VERTICES, 2], np.nan)})
    refuse("answers sigma that are not finite", outputs={"sigma": (["Q", VERTICES, 2], np.inf)})
    refuse("pose_covariance that are not finite", outputs={"pose_covariance": ([3, 3], np.nan)})
    refuse("scores of 4.2, outside 0 … 1", outputs={"scores": (["Q", CLASSES], 4.2)})
    refuse("prior_score of -0.5, outside 0 … 1", outputs={"prior_score": (["P"], -0.5)})
    refuse("sigma below 0", outputs={"sigma": (["Q", VERTICES, 2], -0.3)})
    # Shapes that only an answer shows, where the model declares none.
    refuse("answers points of the shape", outputs={"points": (["Q", 7, 2], 0.0)}, hidden=True)
    refuse("answers scores of the shape", outputs={"scores": ([0, CLASSES], 0.0)}, hidden=True)


def test_files_that_are_no_model(rtmap: Callable[..., Any], tmp_path: Path) -> None:
    log = write_native_log(tmp_path / "drive")
    whole = write_model(tmp_path / "whole.onnx").read_bytes()
    (tmp_path / "cut.onnx").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.onnx").write_bytes(b"")
    (tmp_path / "text.onnx").write_text("a model, believe me")
    (tmp_path / "folder.onnx").mkdir()
    broken = write_model(tmp_path / "broken.onnx")
    graph = onnx.load(broken)
    graph.graph.node[2].op_type = "Juggle"
    onnx.save(graph, broken)
    for name in ("cut", "empty", "text", "folder", "broken", "absent"):
        path = tmp_path / f"{name}.onnx"
        result = rtmap("infer", log, "--model", path, "-o", tmp_path / "run", "-q", code=3)
        assert len(result.err.strip().splitlines()) == 1 and path.name in result.err, result.err
    assert not (tmp_path / "run").exists()
