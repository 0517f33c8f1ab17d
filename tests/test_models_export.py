"""``rtmap export-model``: parity, half precision, metadata, and weights that come back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")
pytest.importorskip("onnxscript", reason="onnxscript is not installed (extra: train)")

import onnx  # noqa: E402
import onnxruntime  # noqa: E402
from rtmap_models.architecture import build_network  # noqa: E402
from rtmap_models.bev import BLOCK, BevWarp  # noqa: E402
from rtmap_models.config import load_config  # noqa: E402
from rtmap_models.export import onnx_file  # noqa: E402
from rtmap_models.export.borders import pad_with_zeros  # noqa: E402
from rtmap_models.export.example import example_inputs  # noqa: E402
from rtmap_models.export.lean import lean  # noqa: E402
from rtmap_models.export.lean_warp import AT_ONCE  # noqa: E402
from rtmap_models.export.onnx_file import (  # noqa: E402
    read_configuration,
    read_weights,
    short_indices,
)
from rtmap_models.training.checkpoint import load_network, save_checkpoint  # noqa: E402
from training_frames import tiny_config  # noqa: E402

from rtmap_cli.errors import BadInput  # noqa: E402
from rtmap_cli.steps.infer import find_model  # noqa: E402


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a small network with every parameter and statistic away from its start."""
    folder = tmp_path_factory.mktemp("weights")
    config = load_config(tiny_config(folder))
    torch.manual_seed(0)
    network = build_network(config)
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            if name.endswith("num_batches_tracked"):
                tensor.fill_(7)
            elif name.endswith("running_var"):
                tensor.uniform_(0.5, 2.0)
            else:
                tensor.add_(torch.randn(tensor.shape) * 0.05)
    state = network.state_dict()
    numbers = {"step": 60, "seconds": 1.5, "samples": 480, "frames": 12}
    save_checkpoint(folder / "w.pt", config, {"average": state, "network": state, **numbers})
    return folder / "w.pt"


@pytest.fixture(scope="module")
def traced_once() -> Iterator[None]:
    """Tracing takes most of an export; the same weights are traced once for all tests."""
    made: list[onnx.ModelProto] = []
    trace = onnx_file._trace

    def traced(network: Any) -> onnx.ModelProto:
        if not made:
            made.append(trace(network))
        copy = onnx.ModelProto()
        copy.CopyFrom(made[0])
        return copy

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_file, "_trace", traced)
        yield


@pytest.fixture(scope="module")
def exported(weights: Path, traced_once: None) -> dict[str, Any]:
    """The model and its report, from the command line."""
    return _export(weights, "model.onnx")


def _export(weights: Path, name: str, *more: str) -> dict[str, Any]:
    from rtmap_cli.cli import run

    path, report = weights.with_name(name), weights.with_name(f"{name}.json")
    call = ["export-model", str(weights), "-o", str(path), "--report", str(report), *more]
    assert run(call) == 0
    return {"path": path, "report": json.loads(report.read_text())}


def test_the_report_names_providers_and_sizes(exported: dict[str, Any]) -> None:
    parity = exported["report"]["parity"]
    assert parity["within"] is True
    sizes = {(r["batch"], r["cameras"], r["prior_slots"]) for r in parity["rows"]}
    assert len(sizes) == 2 and min(map(min, sizes)) == 1
    assert {"CPUExecutionProvider"} <= {r["provider"] for r in parity["rows"]}
    for row in parity["rows"]:
        assert 0 < max(row["differences"].values()) < 1e-3


def test_weights_come_back_bit_for_bit(exported: dict[str, Any], weights: Path) -> None:
    network, content = load_network(weights)
    state = read_weights(exported["path"])
    assert state is not None and state.keys() == content["average"].keys()
    for name, tensor in content["average"].items():
        assert state[name].dtype == tensor.dtype and torch.equal(state[name], tensor), name
    network.load_state_dict(state)
    assert read_configuration(exported["path"]) == json.loads(json.dumps(network.config.to_dict()))
    # Small additions only: the graph's own initializers hold nearly all of it.
    extra = onnx.load(exported["path"]).training_info[0].algorithm.initializer
    assert sum(len(i.raw_data) for i in extra) < 0.2 * exported["path"].stat().st_size


def test_changed_or_foreign_models_give_no_weights(
    exported: dict[str, Any], tmp_path: Path
) -> None:
    model = onnx.load(exported["path"])
    tensor = next(i for i in model.graph.initializer if i.name == "propose.heat.weight")
    tensor.raw_data = bytes(len(tensor.raw_data))
    onnx.save(model, tmp_path / "changed.onnx")
    assert read_weights(tmp_path / "changed.onnx") is None
    del model.training_info[:]
    onnx.save(model, tmp_path / "stripped.onnx")
    assert read_weights(tmp_path / "stripped.onnx") is None
    (tmp_path / "cut.onnx").write_bytes(exported["path"].read_bytes()[:5000])
    for name in ("cut.onnx", "none.onnx"):
        with pytest.raises(BadInput, match=name):
            read_weights(tmp_path / name)


def test_the_shipped_model_reads(tmp_path: Path) -> None:
    path = find_model("rtmap-tiny")
    state = read_weights(path)
    assert state is None or read_configuration(path) is not None


def test_metadata(exported: dict[str, Any]) -> None:
    session = onnxruntime.InferenceSession(str(exported["path"]))
    meta = session.get_modelmeta().custom_metadata_map
    assert meta["rtmap.opset"] == "20" and meta["rtmap.precision"] == "float32"
    assert json.loads(meta["rtmap.training"])["samples"] == 480
    assert "480 samples" in meta["rtmap.training_data"]
    state = read_weights(exported["path"])
    assert state is not None
    statistics = ("running_mean", "running_var", "num_batches_tracked", "inflation", "sigma_factor")
    own = sum(t.numel() for n, t in state.items() if not n.endswith(statistics))
    assert int(meta["rtmap.parameters"]) == own
    raw = exported["path"].read_bytes()
    assert str(Path(__file__).parents[1]).encode() not in raw and b"site-packages" not in raw
    model = onnx.load(exported["path"])
    assert {node.domain for node in model.graph.node} == {""} and not model.functions


def test_half_precision(weights: Path, exported: dict[str, Any], tmp_path: Path) -> None:
    half = _export(weights, "half.onnx", "--fp16")
    assert half["report"]["parity"]["within"] is True
    assert half["path"].stat().st_size < 0.8 * exported["path"].stat().st_size
    session, single = (onnxruntime.InferenceSession(str(x["path"])) for x in (half, exported))
    for a, b in (
        (session.get_inputs(), single.get_inputs()),
        (session.get_outputs(), single.get_outputs()),
    ):
        assert [(x.name, x.type, x.shape) for x in a] == [(x.name, x.type, x.shape) for x in b]
    assert session.get_modelmeta().custom_metadata_map["rtmap.precision"] == "float16"
    graph = onnx.load(half["path"]).graph
    kinds = {i.name: i.data_type for i in graph.initializer}
    convolutions = [n for n in graph.node if n.op_type == "Conv"]
    inside = [n for n in convolutions if kinds[n.input[1]] == onnx.TensorProto.FLOAT16]
    assert len(inside) > 0.8 * len(convolutions)
    assert read_weights(half["path"]) is None


def test_places_stay_single_precision(weights: Path, exported: dict[str, Any]) -> None:
    """What feeds a grid, a pose or an output is computed in float32 in the half variant."""
    from rtmap_models.export.half import to_half

    model = onnx.load(exported["path"])
    to_half(model)
    inferred = onnx.shape_inference.infer_shapes(model).graph
    kinds = {v.name: v.type.tensor_type.elem_type for v in [*inferred.value_info, *inferred.input]}
    grids = [n.input[1] for n in inferred.node if n.op_type == "GridSample"]
    assert grids and {kinds[g] for g in grids} == {onnx.TensorProto.FLOAT}
    ran = {n.op_type for n in inferred.node if kinds.get(n.output[0]) == onnx.TensorProto.FLOAT16}
    assert not ran & {"GridSample", "TopK", "Div", "Sqrt", "Reciprocal", "Exp", "ScatterND"}
    weights32 = {i.name for i in model.graph.initializer if i.data_type == onnx.TensorProto.FLOAT}
    assert "propose.shape.weight" in weights32 and "decoder.layers.0.move.weight.T" in weights32


def test_every_map_is_sampled_with_zero_padding(exported: dict[str, Any]) -> None:
    """In every layer of the decoder four times; the picture is gathered from the bytes."""
    model = onnx.load(exported["path"])
    samplings = [n for n in model.graph.node if n.op_type == "GridSample"]
    padding = [a.s for n in samplings for a in n.attribute if a.name == "padding_mode"]
    assert padding == [b"zeros"] * len(samplings)
    settings = read_configuration(exported["path"])
    assert len(samplings) == 4 * settings["layers"]
    assert pad_with_zeros(model) == 0


def test_bytes_are_gathered_by_short_indices(exported: dict[str, Any]) -> None:
    """Four neighbours of every point; images are never made floats."""
    model = onnx.load(exported["path"])
    inferred = onnx.shape_inference.infer_shapes(model).graph
    kinds = {v.name: v.type.tensor_type.elem_type for v in [*inferred.value_info, *inferred.input]}
    byte, short = onnx.TensorProto.UINT8, onnx.TensorProto.INT32
    gathers = [n for n in model.graph.node if n.op_type == "GatherElements"]
    of_bytes = [n for n in gathers if kinds[n.input[0]] == byte]
    points = BLOCK**2 * read_configuration(exported["path"])["supersample"] ** 2
    assert len(of_bytes) == 4 * points // AT_ONCE
    assert {kinds[n.input[1]] for n in of_bytes} == {short}
    assert all(n.op_type in ("Reshape", "GatherElements") for n in _readers(model, "images"))
    assert short_indices(model) == 0


def _readers(model: onnx.ModelProto, name: str) -> list[onnx.NodeProto]:
    """Nodes that read a value or another shape of it, but not those that ask for its shape."""
    found: list[onnx.NodeProto] = []
    for node in model.graph.node:
        if name in node.input and node.op_type != "Shape":
            found += [node, *(_readers(model, node.output[0]) if node.op_type == "Reshape" else [])]
    return found


@pytest.mark.parametrize("size", [(1, 7), (3, 2)])
def test_the_warp_that_is_traced_reads_the_same_pixels(size: tuple[int, int]) -> None:
    """Noise in every pixel, points outside all cameras, on the rims, and an absent camera."""
    warp = BevWarp(36.0, 18.0, 31, 61, 2)  # blocks reach beyond the picture
    config = load_config("rtmap-tiny")
    _, ego_to_image, *_ = example_inputs(config, *size, 1)
    ego_to_image[-1, -1] = 0.0
    height, width = config.image_size
    images = torch.randint(0, 256, (*size, height, width, 3), dtype=torch.uint8)
    want = warp(images, ego_to_image)
    with lean(warp):
        got = warp(images, ego_to_image)
    assert ((want[:, 3] == 0) == (got[:, 3] == 0)).all() and (want[:, 3] > 0).float().mean() > 0.2
    torch.testing.assert_close(got, want, atol=0.1, rtol=0.0)
    assert (got - want).abs().mean() < 1e-3


@pytest.mark.parametrize("channels", [3, 20])
def test_clipped_places_equal_border_padding(channels: int) -> None:
    """At any batch, inside, on the rim and far outside."""
    helper, f32 = onnx.helper, onnx.TensorProto.FLOAT
    nodes = [
        helper.make_node("GridSample", ["x", "g"], [y], padding_mode=padding)
        for y, padding in (("y", "border"), ("z", "zeros"))
    ]
    shapes = {
        "x": ["B", channels, "H", "W"],
        "g": ["B", "h", "w", 2],
        "y": ["B", channels, "h", "w"],
        "z": ["B", channels, "h", "w"],
    }
    x, g, *out = (helper.make_tensor_value_info(n, f32, s) for n, s in shapes.items())
    graph = helper.make_graph(nodes, "sampling", [x, g], out)
    opset = [helper.make_opsetid("", 20)]
    native, clipped = (helper.make_model(graph, opset_imports=opset, ir_version=9) for _ in "ab")
    assert pad_with_zeros(clipped) == 1
    onnx.checker.check_model(clipped, full_check=True)
    rng = np.random.default_rng(0)
    for batch, height, width in ((1, 5, 7), (3, 1, 4)):
        grid = rng.uniform(-1.5, 1.5, (batch, 6, 9, 2)).astype(np.float32)
        grid[:, 0, :4] = [[-1, -1], [1, 1], [1, -1], [0, 0]]
        maps = rng.normal(size=(batch, channels, height, width)).astype(np.float32)
        a, b = (
            onnxruntime.InferenceSession(m.SerializeToString()).run(None, {"x": maps, "g": grid})
            for m in (native, clipped)
        )
        np.testing.assert_allclose(a[0], b[0], atol=1e-5)
        np.testing.assert_array_equal(a[1], b[1])  # zeros were asked for
        assert np.abs(a[0] - a[1]).max() > 0.1


@pytest.mark.parametrize("size", [(1, 4, 6), (2, 3, 1)])
def test_what_is_traced_says_what_the_network_says(
    weights: Path, size: tuple[int, int, int]
) -> None:
    network = load_network(weights)[0].eval()
    inputs = example_inputs(network.config, *size, 3)
    with torch.no_grad():
        want = network(*inputs)
        with lean(network):
            got = network(*inputs)
        again = network(*inputs)
    assert not torch.equal(want.points, got.points)  # it is other code
    for a, b, c in zip(want, got, again, strict=True):
        torch.testing.assert_close(b, a, atol=1e-3, rtol=1e-3)
        assert torch.equal(a, c)


def test_a_miss_writes_nothing_and_exits_1(
    rtmap: Callable[..., Any],
    weights: Path,
    tmp_path: Path,
    traced_once: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """onnxruntime is made to answer a little beside: as a faulty provider would."""
    run = onnxruntime.InferenceSession.run

    def off(self: Any, names: Any, feed: Any, *more: Any) -> Any:
        return [x + np.float32(0.01) for x in run(self, names, feed, *more)]

    monkeypatch.setattr(onnxruntime.InferenceSession, "run", off)
    call = ("export-model", weights, "-o", tmp_path / "m.onnx", "--report", tmp_path / "r.json")
    call += ("--trained-on", "procedural")
    miss = rtmap(*call, "--json", code=1)
    assert json.loads(miss.out)["parity"]["within"] is False
    assert "differs from torch" in miss.err and len(miss.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
