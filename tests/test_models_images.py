"""The image branch of the default network: nothing at the start, exact geometry, a whole life."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")
pytest.importorskip("onnxscript", reason="onnxscript is not installed (extra: train)")

from rtmap_models.architecture import build_network  # noqa: E402
from rtmap_models.cameras import camera_features, levelled  # noqa: E402
from rtmap_models.config import CONFIGS, TinyConfig, config_from_dict, load_config  # noqa: E402
from rtmap_models.data.dataset import (  # noqa: E402
    Augmentation,
    Frame,
    Frames,
    augment,
    collate,
    make_sample,
    window_size,
)
from rtmap_models.data.samples import Scene  # noqa: E402
from rtmap_models.data.views import LEFT_PLANE, Pictures, View  # noqa: E402
from rtmap_models.export.example import example_inputs  # noqa: E402
from rtmap_models.tiny.criterion import TILT_UNIT, tilt_loss  # noqa: E402
from rtmap_models.tiny.image_branch import (  # noqa: E402
    RIDGE,
    VOTE_CELLS,
    ImageBranch,
    TiltHead,
    Tilts,
)
from rtmap_models.training.checkpoint import load_network, start_from  # noqa: E402
from training_frames import tiny_config  # noqa: E402

from rtmap_cli.errors import BadInput  # noqa: E402
from rtmap_cli.geometry import cameras as numpy_cameras  # noqa: E402
from rtmap_cli.logs.run_files import read_run  # noqa: E402

BRANCH = "image_width = 8\nimage_heights_m = [0.0, 2.0]\ntilt_sigma = 0.02\n"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration file with a branch, every size cut down."""
    return tiny_config(tmp_path_factory.mktemp("config"), BRANCH)


@pytest.fixture(scope="module")
def config(small: Path) -> TinyConfig:
    """The same, read."""
    read = load_config(small)
    assert isinstance(read, TinyConfig) and read.needs_images
    return read


@pytest.fixture(scope="module")
def network(config: TinyConfig) -> Any:
    """A network whose every parameter is away from its start."""
    torch.manual_seed(0)
    made = build_network(config)
    with torch.no_grad():
        for p in made.parameters():
            p.add_(torch.randn(p.shape) * 0.05)
    return made.eval()


def painted_frame(config: TinyConfig, plane: np.ndarray | None = None) -> Frame:
    """The road of `example_inputs` as three cameras see it, and its middle line."""
    images, projections = (x[0].numpy() for x in example_inputs(config, 1, 3, 1)[:2])
    scene = Scene(np.array([[-30.0, 0.0], [30.0, 0.0]]), np.array([0, 2]), np.array([1]))
    picture = np.full((*window_size(config), 4), 60, np.uint8)
    return Frame(picture, scene, images, projections, plane)


# --- the configuration ----------------------------------------------------------------------


def test_the_shipped_configuration_is_the_default_with_a_branch() -> None:
    plain, branch = load_config().to_dict(), load_config("rtmap-tiny-images").to_dict()
    changed = {k for k in plain if plain[k] != branch[k]}
    assert changed == {"name", "image_width", "image_heights_m", "tilt_sigma"}
    assert branch["name"] == "rtmap-tiny-images" and not load_config().needs_images
    own = tomllib.loads((CONFIGS / "rtmap-tiny-images.toml").read_text(encoding="utf-8"))
    assert set(own) == changed | {"base"}


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"image_width": 0}, "image_width goes with"),
        ({"image_heights_m": [], "tilt_sigma": 0.0}, "image_width goes with"),
        ({"tilt_sigma": -0.1}, "negative"),
        ({"image_size": [30, 48]}, "multiples of 8"),
        ({"image_heights_m": ["a"]}, "wrong type"),
    ],
)
def test_bad_configurations(config: TinyConfig, change: dict[str, Any], what: str) -> None:
    with pytest.raises(BadInput, match=what):
        config_from_dict(config.to_dict() | change)


def test_a_base_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('base = "nothing"\n')
    with pytest.raises(BadInput, match="no such configuration"):
        load_config(tmp_path / "c.toml")


# --- nothing at the start -------------------------------------------------------------------


def test_with_the_shipped_weights_it_starts_at_the_shipped_answers() -> None:
    plain, branch = (build_network(load_config(n)) for n in ("rtmap-tiny", "rtmap-tiny-images"))
    assert start_from(plain, "rtmap-tiny") == []
    fresh = start_from(branch, "rtmap-tiny", partial=True)
    assert fresh and all(name.startswith("image_branch.") for name in fresh)
    inputs = example_inputs(plain.config, 1, 3, 2)
    with torch.no_grad():
        for a, b in zip(plain.eval()(*inputs), branch.eval()(*inputs), strict=True):
            assert torch.equal(a, b)


# --- any cameras in any order ---------------------------------------------------------------


def test_cameras_come_in_any_order_and_absent_ones_change_nothing(network: Any) -> None:
    images, projections, *prior = example_inputs(network.config, 2, 4, 3)
    order = torch.tensor([2, 0, 3, 1])
    absent = torch.full_like(images[:, :1], 200)
    more_images = torch.cat([images, absent], dim=1)
    more = torch.cat([projections, torch.zeros_like(projections[:, :1])], dim=1)
    branch = network.image_branch
    with torch.no_grad():
        looked = branch(images, projections)
        assert (looked.ego_to_image - projections).abs().max() > 1e-3  # it does correct
        assert looked.coarse.abs().max() > 1e-2
        turned = branch(images[:, order], projections[:, order])
        padded = branch(more_images, more)
        assert torch.allclose(turned.ego_to_image, looked.ego_to_image[:, order], atol=1e-4)
        assert torch.allclose(turned.coarse, looked.coarse, atol=1e-4)
        assert torch.allclose(padded.ego_to_image[:, :4], looked.ego_to_image, atol=1e-4)
        assert (padded.ego_to_image[:, 4] == 0).all()
        assert torch.allclose(padded.coarse, looked.coarse, atol=1e-4)
        for a, b in zip(network(images, projections, *prior), network(more_images, more, *prior),
                        strict=True):  # fmt: skip
            assert torch.allclose(a, b, atol=1e-3)


def test_absent_cameras_do_not_reach_the_statistics(config: TinyConfig) -> None:
    images, projections, *_ = example_inputs(config, 2, 3, 1)
    projections[0, 1] = 0.0
    black = images.clone()
    black[0, 1] = 0
    torch.manual_seed(0)
    branch = ImageBranch(config).train()
    a, b = (camera_features(branch._features, x, projections, True) for x in (images, black))
    assert torch.equal(a, b) and (a[0, 1] == 0).all()


# --- geometry -------------------------------------------------------------------------------

SLOPES = np.array([0.03, -0.02])


def test_the_true_plane_undoes_a_tilt(network: Any) -> None:
    images, straight, *_ = example_inputs(network.config, 1, 4, 1)
    plane = np.array([*SLOPES, 0.0])
    slopes = torch.from_numpy(SLOPES)[None].float()
    tilted = levelled(straight, -slopes)
    expected = numpy_cameras.levelled(straight.numpy(), -plane)
    np.testing.assert_allclose(tilted.numpy(), expected, atol=1e-4)
    back = levelled(tilted, slopes)
    assert torch.allclose(back, straight, atol=1e-4)
    shown, wrong, mended = (network.warp(images, e) for e in (straight, tilted, back))
    assert (wrong - shown).abs().mean() > 20 * (mended - shown).abs().mean()


def test_votes_of_all_cameras_make_the_plane(config: TinyConfig) -> None:
    """A head that passes on how much higher the horizon lies in the direction of every cell."""
    h, w = (size // 8 for size in config.image_size)
    _, e, *_ = example_inputs(config, 1, 5, 1)
    e = levelled(e, torch.tensor([[0.05, 0.03]]))  # any cameras, not only level ones
    inverse = np.linalg.inv(e[0, :, :, :3].double().numpy())
    v, u = np.meshgrid(8.0 * np.arange(h), 8.0 * np.arange(w), indexing="ij")
    rays = np.einsum("nij,jhw->nihw", inverse, np.stack([u, v, np.ones_like(u)]))
    phi = np.arctan2(rays[:, 1], rays[:, 0])
    higher = SLOPES[0] * np.cos(phi) + SLOPES[1] * np.sin(phi)
    cells = higher / (8.0 * np.linalg.norm(inverse[:, :, 1], axis=1))[:, None, None]
    features = torch.zeros(1, 5, 2, h, w)
    features[0, :, 0] = torch.from_numpy(cells / VOTE_CELLS)
    head = TiltHead(2)
    with torch.no_grad():
        head.place.weight.zero_()
        head.look.weight.copy_(torch.tensor([[1.0, 0.0], [-1.0, 0.0]])[..., None, None])
        head.look.bias.zero_()
        head.vote.weight.copy_(torch.tensor([[1.0, -1.0], [0.0, 0.0]])[..., None, None])
        head.vote.bias.copy_(torch.tensor([0.0, 30.0]))  # every cell is sure
        found = head(features, e)[0].numpy()
    # Five cameras weigh two each, half along either axis; the ridge pulls a little to zero.
    np.testing.assert_allclose(found, SLOPES / (1 + RIDGE / 5.0), rtol=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_the_plane_moves_with_the_frame(config: TinyConfig, seed: int) -> None:
    plane = np.array([0.04, -0.03, 0.1])
    frame = painted_frame(config, plane)
    moved = augment(frame, config, np.random.default_rng(seed), Augmentation(still=0.2))
    assert moved.plane is not None and not np.allclose(moved.plane, plane)
    columns = []
    for f in (frame, moved):
        assert f.ego_to_image is not None and f.plane is not None
        points = f.scene.points
        z = points @ f.plane[:2] + f.plane[2]
        p = np.column_stack([points, z, np.ones(2)]) @ f.ego_to_image[0].T.astype(np.float64)
        columns.append(p[:, :2] / p[:, 2:])
    before, after = columns
    if np.abs(after[:, 0] - before[:, 0]).max() > 1e-2:  # mirrored, as the image is
        before[:, 0] = config.image_size[1] - 1 - before[:, 0]
    np.testing.assert_allclose(after, before, atol=1e-2)


# --- what the head is taught ----------------------------------------------------------------


def write_frames(folder: Path, config: TinyConfig) -> View:
    """Two painted frames with images, the plane of the road known in the first; returns it."""
    frame = painted_frame(config)
    assert frame.images is not None and frame.ego_to_image is not None
    road = np.array([0.02, -0.01, 0.1])
    view = View(frame.images, frame.ego_to_image, frame.scene, np.eye(4), road)
    pictures = Pictures(config, np.random.default_rng(0), keep_images=True)
    pictures.add(view)
    pictures.add(replace(view, plane=None))
    pictures.write(folder, "painted", {})
    return view


def test_frames_keep_what_levelling_left(config: TinyConfig, tmp_path: Path) -> None:
    view = write_frames(tmp_path, config)
    frames, rng = Frames(tmp_path, config), np.random.default_rng(0)
    batch = collate([make_sample(frames[k], config, rng, train=False) for k in (0, 1)], config)
    assert batch.plane is not None and batch.ego_to_image is not None and view.plane is not None
    left = batch.plane[0].numpy()
    assert 0 < np.abs(left / LEFT_PLANE).max() < 5
    np.testing.assert_allclose(
        numpy_cameras.levelled(batch.ego_to_image[0].numpy(), left),
        numpy_cameras.levelled(view.ego_to_image, view.plane),
        atol=1e-3,
    )
    assert batch.plane[1].isnan().all()


def test_tilt_loss() -> None:
    true = torch.tensor([[[0.02, 0.0], [float("nan")] * 2]])
    off = torch.tensor([[[TILT_UNIT, -TILT_UNIT], [3.0, 3.0]]])
    guess = (true.nan_to_num() + off).requires_grad_()
    loss = tilt_loss(Tilts(guess, true))
    assert float(loss.detach()) == pytest.approx(0.5)
    loss.backward()
    assert guess.grad is not None and (guess.grad[0, 1] == 0).all()
    assert float(tilt_loss(Tilts(true.nan_to_num(), true))) == 0.0
    unknown = torch.full_like(true, float("nan"))
    assert float(tilt_loss(Tilts(off, unknown))) == 0.0


def test_the_head_learns_to_see_a_tilt(config: TinyConfig) -> None:
    """Six painted roads whose cameras lean by known slopes, ever other ones."""
    images, projections, *_ = example_inputs(config, 6, 4, 1)
    plane = torch.zeros(6, 3)
    torch.manual_seed(0)
    branch = ImageBranch(config).train()
    optimizer = torch.optim.Adam(branch.parameters(), lr=5e-3)
    losses = []
    for _ in range(120):
        tilts = branch.learn(images, projections, plane)[1]
        assert tilts is not None
        loss = tilt_loss(tilts)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])


# --- a whole life ---------------------------------------------------------------------------


def test_train_export_infer(rtmap: Any, small: Path, tmp_path: Path) -> None:
    from rtmap_models.training.checkpoint import save_checkpoint
    from sample_logs import write_native_log

    plain = load_config(tiny_config(tmp_path))
    torch.manual_seed(0)
    state = build_network(plain).state_dict()
    save_checkpoint(tmp_path / "plain.pt", plain, {"average": state})
    weights, model = tmp_path / "w.pt", tmp_path / "m.onnx"
    write_frames(tmp_path / "frames", load_config(small))
    call = ("--config", small, "--data", tmp_path / "frames", "--batch", 2)
    first = ("--init", tmp_path / "plain.pt", "--init-partial", "--steps", 2, "--threads", 1)
    said = rtmap("train", "-o", weights, *call, *first, "--set", "warmup=1", "--device", "cpu")
    assert "start fresh, e.g. image_branch." in said.err
    trained, _ = load_network(weights)
    assert trained.image_branch.tilt.vote.weight[0].abs().max() > 0
    assert trained.image_branch.lift.join.weight.abs().max() > 0
    rtmap("export-model", weights, "-o", model, "--report", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())["parity"]
    assert report["within"] and len({r["cameras"] for r in report["rows"]}) == 2
    assert max(v for r in report["rows"] for v in r["differences"].values()) < 1e-3
    log = write_native_log(tmp_path / "log")  # one frame lacks a camera
    rtmap("infer", log, "--model", model, "-o", tmp_path / "run", "-q")
    run = read_run(tmp_path / "run")
    assert list(run.frames.camera_count) == [2, 1, 2, 2]
    assert np.isfinite(run.observations.points).all()
