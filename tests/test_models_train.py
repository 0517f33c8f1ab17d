"""Train on a painted road, resume, export, and run the ONNX file: a whole life in seconds."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
pytest.importorskip("onnxscript", reason="onnxscript is not installed (extra: train)")
cv2 = pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")

import onnx  # noqa: E402
import onnxruntime  # noqa: E402
from rtmap_models.answer import hints  # noqa: E402
from rtmap_models.bev import normalize_picture  # noqa: E402
from rtmap_models.config import load_config  # noqa: E402
from rtmap_models.data.dataset import Frames, collate, make_sample  # noqa: E402
from rtmap_models.export import onnx_weights  # noqa: E402
from rtmap_models.export.onnx_file import OUTPUTS, example_inputs, parity  # noqa: E402
from rtmap_models.tiny.criterion import LossWeights, compute_losses  # noqa: E402
from rtmap_models.tiny.decoder import LayerOutput  # noqa: E402
from rtmap_models.tiny.matcher import Matcher  # noqa: E402
from rtmap_models.tiny.network import RTMapNet  # noqa: E402
from rtmap_models.training.calibrate import calibrate  # noqa: E402
from rtmap_models.training.checkpoint import load_network  # noqa: E402
from rtmap_models.training.recipe import Recipe  # noqa: E402
from rtmap_models.training.scores import fit_scores  # noqa: E402
from rtmap_models.training.train import TrainOptions, train  # noqa: E402
from training_frames import painted_frames, tiny_config  # noqa: E402

from rtmap_cli.errors import BadInput  # noqa: E402


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default configuration with every size cut down."""
    return tiny_config(tmp_path_factory.mktemp("config"))


@pytest.fixture(scope="module")
def frames(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve painted frames: a straight road of two lanes, some with a crossing."""
    return painted_frames(tmp_path_factory.mktemp("frames"), tiny)


@pytest.fixture(scope="module")
def weights(tiny: Path, frames: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixty steps of training."""
    path = tmp_path_factory.mktemp("weights") / "weights.pt"
    recipe = Recipe(warmup=10, precision="fp32", rate=3e-3)
    options = TrainOptions((frames,), path, recipe, steps=60, log_every=20)
    train(load_config(tiny), options)
    return path


@pytest.fixture(scope="module")
def model(weights: Path) -> Path:
    """The trained weights, exported by the command line."""
    from rtmap_cli.cli import run

    path = weights.with_name("model.onnx")
    command = ["export-model", str(weights), "-o", str(path), "--name", "test-model"]
    assert run([*command, "--trained-on", "procedural"]) == 0
    return path


def test_losses_fall(weights: Path) -> None:
    rows = [line.split(",") for line in weights.with_suffix(".csv").read_text().splitlines()]
    losses = [float(row[rows[0].index("points")]) for row in rows[1:]]
    assert len(losses) == 3 and losses[-1] < 0.8 * losses[0]


def test_matched_queries_are_one_to_one(tiny: Path, frames: Path) -> None:
    config, rng = load_config(tiny), np.random.default_rng(0)
    data = Frames(frames, config)
    batch = collate([make_sample(data[k], config, rng, prior="none") for k in range(4)], config)
    network = RTMapNet(config).eval()
    prediction = network.predict(
        normalize_picture(batch.picture), batch.prior_points, batch.prior_class, batch.prior_mask
    )
    match = Matcher(batch)(prediction.layers[-1], prediction.new_count)
    assert sorted(match.truth) == list(range(len(batch.truth_class)))
    assert len(set(zip(match.sample, match.query, strict=True))) == len(match.query)
    parts = compute_losses(prediction, batch, LossWeights())
    assert all(torch.isfinite(v) for v in parts.values())


def test_a_hidden_prior_does_not_reach_the_new_queries(weights: Path) -> None:
    network, _ = load_network(weights)
    _, _, *prior = example_inputs(network.config, 2, 3, 5)
    picture = torch.randn(2, 4, *network.config.picture_size)
    empty = (torch.zeros_like(prior[0]), prior[1], torch.zeros_like(prior[2]))
    with torch.no_grad():
        alone = network.predict(picture, *empty).layers[-1].points[:, :12]
        hidden = network.predict(picture, *prior, torch.zeros(2)).layers[-1].points[:, :12]
        seen = network.predict(picture, *prior, torch.ones(2)).layers[-1].points[:, :12]
    assert torch.allclose(alone, hidden, atol=1e-4)
    assert not torch.allclose(alone, seen, atol=1e-4)


def test_export_runs_at_any_size_and_equals_torch(model: Path, weights: Path) -> None:
    network, _ = load_network(weights)
    worst = parity(network, model, ((1, 7, 9), (3, 2, 1), (2, 8, 50)))
    assert max(worst.values()) < 1e-3
    session = onnxruntime.InferenceSession(str(model))
    inputs = example_inputs(network.config, 2, 6, 4)
    names = [i.name for i in session.get_inputs()]
    out = session.run(list(OUTPUTS), dict(zip(names, [x.numpy() for x in inputs], strict=True)))
    shapes = [o.shape for o in out]
    assert shapes == [(2, 16, 3), (2, 16, 20, 2), (2, 16, 20, 2), (2, 4), (2, 3), (2, 3, 3)]
    unused = inputs[4].numpy() == 0
    assert (out[3][unused] == 0).all() and (out[0][:, 12:][unused] == 0).all()


def test_export_describes_itself(model: Path) -> None:
    session = onnxruntime.InferenceSession(str(model))
    meta = session.get_modelmeta().custom_metadata_map
    assert meta["rtmap.model_name"] == "test-model"
    assert json.loads(meta["rtmap.classes"]) == ["ped_crossing", "divider", "boundary"]
    assert json.loads(meta["rtmap.range_m"]) == {"x": [-36.0, 36.0], "y": [-18.0, 18.0]}
    assert meta["rtmap.sigma"] == "standard deviation, metres"
    for key in ("model_version", "axis_order", "units", "vertex_count", "prior_slots", "horizon"):
        assert meta[f"rtmap.{key}"]
    for key in ("image_size", "training_data", "licence", "code_sha"):
        assert meta[f"rtmap.{key}"]
    assert meta["rtmap.training_data"].startswith("procedural towns: ")
    footprint = json.loads(meta["rtmap.training_footprint"])
    assert footprint == {"origins": ["procedural"], "zoom": 18, "cells": {}}
    graph = onnx.load(model)
    assert {node.domain for node in graph.graph.node} == {""}
    raw = model.read_bytes()
    assert str(Path(__file__).parents[1]).encode() not in raw and b"site-packages" not in raw


def test_an_exported_model_is_calibrated_again(
    rtmap, model: Path, frames: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again.onnx"
    told = rtmap("export-model", model, "-o", again, "--calibrate", frames, "--json")
    factors = json.loads(told.out)["calibration"]
    one, two = (onnx_weights.read_weights(p) for p in (model, again))
    assert one is not None and two is not None
    changed = {name for name in one if not torch.equal(one[name], two[name])}
    assert changed == {"sigma_factor", "pose.inflation"}
    meta = onnx_weights.read_metadata(again)
    assert json.loads(meta["rtmap.calibration"]).keys() == factors.keys()
    before = onnx_weights.read_metadata(model)
    for key in ("rtmap.training", "rtmap.training_footprint", "rtmap.training_data"):
        assert meta[key] == before[key]
    # What the graph answers is what the weights of the hints make of it.
    network, _ = load_network(again)
    for mode in range(2):
        for c, name in enumerate(network.config.classes):
            fit = factors[f"score {name} {'with' if mode else 'without'} prior"]
            network.score_fit[mode, c] = torch.tensor(fit)
    assert not torch.allclose(network.score_fit, load_network(again)[0].score_fit)
    assert max(parity(network, again, ((1, 2, 3),)).values()) < 1e-3
    assert parity(load_network(model)[0], again, ((1, 2, 3),))["scores"] > 1e-3
    # A model that cannot give its weights back says so.
    assert "holds no weights" in rtmap(
        "export-model", _stripped(model, tmp_path / "s.onnx"), "-o", tmp_path / "x.onnx", code=3
    ).err  # fmt: skip
    assert "no such model" in rtmap("export-model", "none", "-o", tmp_path / "x.onnx", code=3).err


def _stripped(model: Path, path: Path) -> Path:
    content = onnx.load(model)
    del content.training_info[:]
    onnx.save(content, path)
    return path


def test_scores_are_fitted_to_what_was_right() -> None:
    rng, true = np.random.default_rng(0), np.array([0.7, 1.5, -0.4, 0.3])
    x = np.column_stack([rng.normal(0, 1.5, (20_000, 3)), np.ones(20_000)])
    right = rng.random(len(x)) < 1 / (1 + np.exp(-x @ true))
    assert fit_scores(np.column_stack([x, right])) == pytest.approx(true, abs=0.08)
    # Nothing right at all: scores fall, and do so within bounds.
    none = fit_scores(np.column_stack([x[:50], np.zeros(50)]))
    assert np.isfinite(none).all() and none[0] > 0 and (x[:50] @ none).mean() < -1


def test_hints_are_logit_sharpness_and_length() -> None:
    points = torch.zeros(1, 3, 5, 2)
    points[0, 0, :, 0] = torch.linspace(0, 8, 5)
    scale = torch.full((1, 3, 5, 2), -1.5)
    logits = torch.arange(12.0).reshape(1, 3, 4)
    got = hints(LayerOutput(points, scale, logits), new_count=2, classes=3)
    assert got.shape == (1, 2, 3, 4)
    assert torch.equal(got[0, 1, :, 0], torch.tensor([4.0, 5.0, 6.0]))
    assert torch.allclose(got[..., 1], torch.tensor(1.5)) and (got[..., 3] == 1).all()
    assert torch.allclose(got[0, :, 0, 2], torch.tensor([9.0, 1.0]).log(), atol=1e-3)


def test_export_refuses_to_overwrite(rtmap, model: Path, weights: Path) -> None:
    rtmap("export-model", weights, "-o", model, code=2)


def test_bad_weights(rtmap, tmp_path: Path, frames: Path, tiny: Path) -> None:
    missing = rtmap("export-model", tmp_path / "no.pt", "-o", tmp_path / "m.onnx", code=3)
    assert "no such file" in missing.err
    (tmp_path / "text.pt").write_text("hello")
    text = rtmap("export-model", tmp_path / "text.pt", "-o", tmp_path / "m.onnx", code=3).err
    assert "not a checkpoint: no file of plain tensors" in text and "weights_only" not in text
    torch.save({"a": 1}, tmp_path / "other.pt")
    other = rtmap("export-model", tmp_path / "other.pt", "-o", tmp_path / "m.onnx", code=3)
    assert "not a checkpoint" in other.err
    assert not (tmp_path / "m.onnx").exists()
    rtmap("train", "-o", tmp_path / "w.pt", code=2)
    rtmap("train", "-o", tmp_path / "w.pt", "--steps", 1, "--data", tmp_path / "none", code=3)
    (tmp_path / "bad.toml").write_text("name = 'x'")
    rtmap("train", "-o", tmp_path / "w.pt", "--steps", 1, "--config", tmp_path / "bad.toml", code=3)


def test_damaged_shard(tiny: Path, frames: Path, tmp_path: Path) -> None:
    for file in frames.iterdir():
        (tmp_path / file.name).write_bytes(
            file.read_bytes()[: 200 if file.suffix == ".npy" else None]
        )
    with pytest.raises(BadInput, match="unreadable shard"):
        Frames(tmp_path, load_config(tiny))


def test_zoo_needs_no_torch() -> None:
    code = (
        "import sys; import rtmap_models.zoo as z; print(z.names());"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    from rtmap_models import zoo

    with pytest.raises(FileNotFoundError, match="no model named"):
        zoo.model_path("no-such-model")


def test_train_renders_its_own_frames(rtmap, tiny: Path, tmp_path: Path) -> None:
    call = ("--config", tiny, "--seed", 3, "--threads", 1, "--batch", 2, "-q")
    rtmap("train", "-o", tmp_path / "a.pt", "--frames", 2, *call)
    assert not (tmp_path / "a.pt").exists()
    first = {p.name: p.read_bytes() for p in (tmp_path / "frames").iterdir()}
    assert len(first) == 3
    rtmap("train", "-o", tmp_path / "a.pt", "--frames", 2, "--steps", 2, *call)
    assert {p.name: p.read_bytes() for p in (tmp_path / "frames").iterdir()} == first
    again = ("--data", tmp_path / "again", "--frames", 2, "--steps", 1, "--keep-images")
    rtmap("train", "-o", tmp_path / "b.pt", *again, *call)
    for name, content in first.items():
        if not name.endswith(".npz"):  # archives carry the time of writing
            assert (tmp_path / "again" / name).read_bytes() == content
    (kept,) = (tmp_path / "again").glob("*.images.npy")
    images = np.load(kept)
    assert images.shape[0] == 2 and images.shape[1] >= 6 and images.std() > 10
    with np.load(kept.with_name(kept.name.replace(".images.npy", ".npz"))) as table:
        assert table["ego_to_image"].shape == (2, images.shape[1], 3, 4)
    rtmap("train", "-o", tmp_path / "b.pt", "--steps", 1, *call, code=2)


def test_calibration_makes_sigmas_honest(weights: Path, frames: Path) -> None:
    network, _ = load_network(weights)
    before = calibrate(network, Frames(frames, network.config))
    with torch.no_grad():
        for layer in network.decoder.layers:
            layer.move.bias[2:] += 0.5  # every scale is now e^0.5 times larger
    after = calibrate(network, Frames(frames, network.config))
    for name, value in before.items():
        if name.startswith("sigma") and value not in (0.2, 5.0, 1.0):
            assert after[name] == pytest.approx(value * np.exp(-0.5), rel=0.1)


def test_the_shipped_model_can_be_trained_on() -> None:
    """Its weights, as read back from the ONNX file, are the ones that training goes on from."""
    from rtmap_models.architecture import build_network
    from rtmap_models.config import load_config
    from rtmap_models.training.checkpoint import start_from

    network = build_network(load_config("rtmap-tiny"))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    assert start_from(network, "rtmap-tiny") == []
    after = network.state_dict()
    moved = [name for name, value in before.items() if not torch.equal(value, after[name])]
    assert len(moved) > 0.8 * len([n for n in before if n.endswith(("weight", "running_mean"))])
