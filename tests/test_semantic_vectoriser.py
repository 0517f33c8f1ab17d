"""The vectoriser of semantic rasters: trained, exported and run on a simulated cart's log."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("cv2")

import torch
from rtmap_models.architecture import build_network
from rtmap_models.bev import normalize_picture
from rtmap_models.config import SemanticConfig, load_config
from rtmap_models.data.dataset import Frames, collate, make_sample
from rtmap_models.export.example import example_inputs
from rtmap_models.semantic.domains import DOMAINS
from rtmap_models.semantic.drives import _rasters
from rtmap_models.semantic.network import LOOKS, QUALITY, normalize_raster
from rtmap_models.semantic.picture import wide_picture
from rtmap_models.training.checkpoint import start_from
from training_frames import TINY

from rtmap_cli.cli import run
from rtmap_cli.logs.run import NEW
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.logs.semantic import CLASSES, SemanticMap
from rtmap_cli.maps.store import read_map
from rtmap_cli.steps.simulate.driving.drive import first_frames
from rtmap_cli.steps.simulate.driving.drive_source import Route, find_source
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey

Call = Callable[..., Any]
FRAMES = 6


def small_config(folder: Path) -> Path:
    """The vectoriser cut down to almost nothing."""
    text = (
        Path(__file__).parents[1] / "models/rtmap_models/configs/semantic-tiny.toml"
    ).read_text()
    for old, new in TINY.items():
        text = text.replace(old, new)
    path = folder / "small.toml"
    path.write_text(text.replace('name = "semantic-tiny"', 'name = "semantic-test"'))
    return path


def command(*words: object) -> None:
    assert run([str(w) for w in words]) == 0


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campus") / "map"
    command("simulate", "town", "--seed", 5, "--size", 200, "--style", "campus", "-o", folder)
    return folder


@pytest.fixture(scope="module")
def cart(town: Path) -> Path:
    """A log of a cart that carries its rasters."""
    log = town.parent / "cart"
    way = ("--length", 40, "--spacing", 4, "--route", "straight", "--frames", FRAMES)
    senses = ("--rig", "campus", "--lidar", "vlp16", "--masks", "--width", 384, "--quality", 40)
    command(
        "simulate", "images", "--map", town, "--log", "town:", "--seed", 5, "--world-seed", 5,
        *way, *senses, "-q", "-o", log,
    )  # fmt: skip
    command("semantic-map", log, "-o", log / "semantic", "-q")
    return log


@pytest.fixture(scope="module")
def model(town: Path, cart: Path) -> Path:
    """Trained for two steps on the log and exported."""
    folder = town.parent
    command(
        "train", "-o", folder / "w.pt", "--config", small_config(folder), "--data", cart,
        "--map", town, "--steps", 2, "--batch", 2, "--threads", 1, "--device", "cpu", "-q",
    )  # fmt: skip
    command("export-model", folder / "w.pt", "-o", folder / "model.onnx")
    return folder / "model.onnx"


def test_reads_a_log_with_rasters(rtmap: Call, cart: Path, town: Path, model: Path) -> None:
    out = model.parent / "run"
    rtmap("infer", cart, "--model", model, "--score-threshold", 0, "-o", out)
    found = read_run(out)
    assert len(found.frames) == FRAMES and (found.observations.state == NEW).all()
    assert found.info["model"] == "semantic-test" and (found.frames.camera_count == 0).all()
    assert np.abs(found.observations.points).max() < 60
    judged = rtmap(
        "evaluate", "map", out, "--truth", town, "--poses", cart, "--range", 60, 30, "--json"
    )
    assert json.loads(judged.out)["frames"] == FRAMES
    rtmap("infer", cart, "--model", model, "--map", town, "-o", model.parent / "aided")
    aided = read_run(model.parent / "aided")
    assert (
        np.isfinite(aided.frames.end_to_end).all() and len(set(aided.observations.element_id)) > 3
    )


def test_rasters_may_lie_elsewhere(rtmap: Call, cart: Path, model: Path, tmp_path: Path) -> None:
    bare = tmp_path / "cart"
    shutil.copytree(cart, bare, ignore=shutil.ignore_patterns("semantic"))
    said = rtmap("infer", bare, "--model", model, "-o", tmp_path / "run", code=3).err
    assert "carries no semantic rasters" in said and said.count("\n") == 1
    rtmap("infer", bare, "--model", model, "--semantic", cart / "semantic", "-o", tmp_path / "run")
    assert len(read_run(tmp_path / "run").frames) == FRAMES
    said = rtmap("infer", bare, "--semantic", cart / "semantic", "-o", tmp_path / "r", code=2).err
    assert "reads images" in said


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"classes": ["road", "crosswalk", "marking", "curb", "sidewalk", "water"]}, "planes"),
        ({"window": {"half_x": 36.0, "half_y": 18.0, "cell": 0.4}}, "--cell 0.2"),
        ({"log_id": "another"}, "another"),
        ({"schema": "else"}, "not a semantic map"),
    ],
)
def test_rasters_that_do_not_fit_are_refused(
    rtmap: Call, cart: Path, town: Path, model: Path, tmp_path: Path, change: Any, said: str
) -> None:
    other = tmp_path / "semantic"
    shutil.copytree(cart / "semantic", other)
    info = json.loads((other / "semantic.json").read_text())
    (other / "semantic.json").write_text(json.dumps(info | change))
    given = ("--semantic", other, "-o", tmp_path / "run")
    error = rtmap("infer", cart, "--model", model, *given, code=3).err
    assert said in error and error.count("\n") == 1 and not (tmp_path / "run").exists()


def test_a_model_of_other_classes_than_maps_have_is_refused(
    rtmap: Call, cart: Path, model: Path, tmp_path: Path
) -> None:
    content = model.read_bytes().replace(b'"divider"', b'"dividor"')
    (tmp_path / "other.onnx").write_bytes(content)
    out = ("-o", tmp_path / "run")
    said = rtmap("infer", cart, "--model", tmp_path / "other.onnx", *out, code=3).err
    assert "dividor" in said and "ped_crossing" in said and said.count("\n") == 1


def test_training_goes_on_from_a_model_on_another_log(
    rtmap: Call, cart: Path, town: Path, model: Path, tmp_path: Path
) -> None:
    """``train --init MODEL --data LOG``: the configuration is the model's."""
    more = ("--map", town, "--steps", 1, "--batch", 1, "--threads", 1, "--device", "cpu", "-q")
    rtmap("train", "-o", tmp_path / "w.pt", "--init", model, "--data", cart, *more)
    shards = list((tmp_path / "cache").glob("*/*.npy"))
    pictures = np.load(shards[0])
    assert pictures.shape == (FRAMES, 48, 96, 7)
    bare = tmp_path / "bare"
    shutil.copytree(cart, bare, ignore=shutil.ignore_patterns("semantic"))
    said = rtmap(
        "train", "-o", tmp_path / "v.pt", "--init", model, "--data", bare, *more, code=3
    ).err
    assert "carries no semantic rasters" in said


def test_frames_of_a_domain_are_simulated(
    rtmap: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(DOMAINS, "campus", replace(DOMAINS["campus"], length=48.0))
    small = small_config(tmp_path)
    given = ("--config", small, "--domain", "campus", "--frames", 3, "--threads", 1, "-q")
    rtmap("train", "-o", tmp_path / "w.pt", *given)
    config = load_config(small)
    frames = Frames(tmp_path / "frames", config)
    assert len(frames) >= 3 and frames.footprint().text() == "procedural towns"
    picture = frames[len(frames) - 1].picture
    assert picture[..., 6].max() > 150 and (picture[..., 6] == 0).mean() > 0.2
    assert picture[..., :6].sum(axis=-1, dtype=int).max() < 260
    sample = make_sample(frames[0], config, np.random.default_rng(0))
    batch = collate([sample, sample], config)
    assert batch.picture.shape == (2, 7, 40, 80)
    rtmap("train", "-o", tmp_path / "w.pt", *given, "--live", "--steps", 1, code=2)


def test_simulated_rasters_are_those_of_the_commands(cart: Path, town: Path) -> None:
    """The short cut past images draws what simulate images and semantic-map give."""
    config = load_config("semantic-tiny")
    assert isinstance(config, SemanticConfig)
    vector_map, key = read_map(town), DriveKey(5, 5, 0)
    source = find_source("town:", town, vector_map, key, Route("straight", 40, 4))
    source = replace(source, drive=first_frames(source.drive, None, None, FRAMES))
    domain = replace(DOMAINS["campus"], errors=0.0, taken_for={})
    made = [s.raster for s in _rasters(config, domain, source, vector_map, key, 1)]
    real = SemanticMap(cart / "semantic")
    for k in range(1, FRAMES):
        a, b = made[k].astype(float), real.read_window(k).astype(float)
        seen = np.minimum(a[6], b[6]) > 60
        # Masks also have vehicles and houses, whose rims take some points away.
        assert abs((a[6] > 0).mean() / (b[6] > 0).mean() - 1) < 0.2
        same = a[:6].argmax(axis=0)[seen] == b[:6].argmax(axis=0)[seen]
        assert seen.sum() > 2000 and same.mean() > 0.9
        for c in range(6):
            assert abs((a[c] > 128).mean() - (b[c] > 128).mean()) < 0.01, CLASSES[c]


def test_the_graph_cuts_the_same_picture_as_training() -> None:
    config = load_config("semantic-tiny")
    assert isinstance(config, SemanticConfig)
    network = build_network(config).eval()
    raster, *prior = example_inputs(config, 2, 1, 4)
    wide = [wide_picture(r.numpy(), config) for r in raster]
    left, top = (round(m / config.cell_m) for m in config.margin_m)
    rows, columns = config.picture_size
    cut = np.stack([w[top : top + rows, left : left + columns] for w in wide])
    with torch.no_grad():
        graph = network(raster, *prior)
        picture = normalize_raster(torch.from_numpy(cut).permute(0, 3, 1, 2).float())
        kept = network.answer(network.predict(picture, *prior), *prior)
    assert float((graph.points[:, 50:] - kept.points[:, 50:]).abs().max()) < 0.05
    assert float((graph.prior_score - kept.prior_score).abs().max()) < 0.02


def test_classes_stand_for_the_colours_that_the_camera_network_knows() -> None:
    """From the weights of rtmap-tiny, a raster is read like a picture of the same ground."""
    config = load_config("semantic-tiny")
    network = build_network(config).eval()
    assert start_from(network, "rtmap-tiny", partial=True) == []
    camera = build_network(load_config("rtmap-tiny")).eval()
    start_from(camera, "rtmap-tiny")
    rows, columns = config.picture_size
    place = network.picture_net.position.expand(1, -1, -1, -1)
    raster, picture = torch.zeros(1, 7, rows, columns), torch.zeros(1, 4, rows, columns)
    raster[:, 2], raster[:, 6] = 255.0, 255.0
    picture[:, :3] = torch.tensor(LOOKS["marking"]).float()[None, :, None, None]
    picture[:, 3] = QUALITY
    with torch.no_grad():
        a = network.picture_net.down2(torch.cat([normalize_raster(raster), place], dim=1))
        b = camera.picture_net.down2(torch.cat([normalize_picture(picture), place], dim=1))
    assert float(b.abs().max()) > 0.1
    assert float((a - b).abs().max()) < 1e-4
    fresh = build_network(config)
    named = start_from(fresh, "rtmap-tiny", partial=True)
    assert named == []
