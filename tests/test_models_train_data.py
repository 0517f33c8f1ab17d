"""Where training frames come from, and what happens to them on the way into a batch."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from sample_logs import write_av2_log, write_native_log
from sample_nuscenes import write_nuscenes

torch = pytest.importorskip("torch", reason="torch is not installed (extra: train)")
cv2 = pytest.importorskip("cv2", reason="opencv is not installed (extra: train)")

from rtmap_models.bev import BevWarp  # noqa: E402
from rtmap_models.config import ModelConfig, TinyConfig, load_config  # noqa: E402
from rtmap_models.data.dataset import (  # noqa: E402
    Augmentation,
    Frame,
    Frames,
    augment,
    collate,
    make_sample,
    recoloured,
    window_half,
    window_size,
    write_shard,
)
from rtmap_models.data.live import Window  # noqa: E402
from rtmap_models.data.samples import Scene  # noqa: E402
from rtmap_models.data.sources import gather, logs_in  # noqa: E402
from rtmap_models.training.recipe import Recipe, load_recipe  # noqa: E402
from training_frames import painted_frames, tiny_config  # noqa: E402

from rtmap_cli.errors import BadInput, UsageError  # noqa: E402
from rtmap_cli.maps.element import Element, VectorMap  # noqa: E402
from rtmap_cli.maps.store import write_new_map  # noqa: E402


@dataclass(frozen=True)
class Seeing(TinyConfig):
    """A configuration that wants camera images."""

    @property
    def needs_images(self) -> bool:
        return True


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_config(tmp_path_factory.mktemp("config"))


@pytest.fixture(scope="module")
def seeing(tiny: Path) -> Seeing:
    return Seeing(**load_config(tiny).to_dict())


VERTICES = np.array([[8.0, 1.0], [12.0, -2.0], [16.0, 3.0]])
"""Ego metres, in view of the camera of `dotted_frame`."""


def forward_camera(config: ModelConfig) -> np.ndarray:
    """(3, 4) projection of a camera 1.5 m above the road that looks ahead."""
    height, width = config.image_size
    k = np.array([[0.6 * width, 0, (width - 1) / 2], [0, 0.6 * width, height * 0.3], [0, 0, 1]])
    rows = np.array([[0, -1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])
    return k @ np.column_stack([rows, rows @ [0, 0, -1.5]])


def pixels(projection: np.ndarray, points: np.ndarray) -> np.ndarray:
    p = np.column_stack([points, np.zeros(len(points)), np.ones(len(points))]) @ projection.T
    assert (p[:, 2] > 0).all()
    return p[:, :2] / p[:, 2:]


def dotted_frame(config: ModelConfig, cameras: int = 1) -> Frame:
    """A line through `VERTICES`, each of them a white dot in the image and in the picture."""
    projection = forward_camera(config)
    image = np.full((*config.image_size, 3), 40, np.uint8)
    for u, v in pixels(projection, VERTICES).round().astype(int):
        image[v, u] = 255
    warp = BevWarp(*window_half(config), *window_size(config), config.supersample)
    images = np.stack([image] * cameras)
    projections = np.stack([projection] * cameras).astype(np.float32)
    picture = warp(torch.from_numpy(images)[None], torch.from_numpy(projections)[None])[0]
    scene = Scene(VERTICES, np.array([0, 3]), np.array([1]))
    shown = picture.to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return Frame(shown, scene, images, projections)


@pytest.mark.parametrize("seed", range(8))
def test_images_truth_and_projection_move_together(seeing: Seeing, seed: int) -> None:
    frame = dotted_frame(seeing)
    moved = augment(frame, seeing, np.random.default_rng(seed), Augmentation(still=0.2))
    assert moved.images is not None and moved.ego_to_image is not None
    assert not np.array_equal(moved.ego_to_image, frame.ego_to_image)
    at = pixels(moved.ego_to_image[0].astype(np.float64), moved.scene.points)
    for u, v in at.round().astype(int):
        assert moved.images[0][v, u].min() == 255
    # The picture that the moved cameras give is the moved picture.
    warp = BevWarp(*seeing.half_range, *seeing.picture_size, seeing.supersample)
    seen = warp(torch.from_numpy(moved.images)[None], torch.from_numpy(moved.ego_to_image)[None])
    both = (seen[0, 3].numpy() > 20) & (moved.picture[..., 3] > 20)
    assert both.sum() > 100
    difference = np.abs(seen[0].permute(1, 2, 0).numpy() - moved.picture)[both]
    assert np.median(difference) < 3


def test_mirrored_cameras_stay_cameras(seeing: Seeing) -> None:
    frame = dotted_frame(seeing)
    signs = set()
    for seed in range(12):
        moved = augment(frame, seeing, np.random.default_rng(seed), Augmentation())
        assert moved.ego_to_image is not None
        signs.add(float(np.sign(np.linalg.det(moved.ego_to_image[0, :, :3]))))
    assert len(signs) == 1


def test_colours_change_alike_and_black_stays() -> None:
    image = np.zeros((1, 4, 6, 3), np.uint8)
    image[0, 0] = 110
    out = recoloured(image, np.full(3, 1.2), np.array([5.0, 0.0, -5.0]))
    assert (out[0, 1:] == 0).all()
    assert out[0, 0, 0].tolist() == [115, 110, 105]


def test_batches_pad_absent_cameras(seeing: Seeing) -> None:
    rng = np.random.default_rng(0)
    samples = [make_sample(dotted_frame(seeing, n), seeing, rng, train=False) for n in (1, 3)]
    batch = collate(samples, seeing)
    assert batch.images is not None and batch.ego_to_image is not None
    assert batch.images.dtype == torch.uint8 and batch.images.shape[:2] == (2, 3)
    assert batch.ego_to_image.shape == (2, 3, 3, 4)
    assert (batch.images[0, 1:] == 0).all() and (batch.ego_to_image[0, 1:] == 0).all()
    assert (batch.ego_to_image[1] == batch.ego_to_image[0, 0]).all()
    warp = BevWarp(*seeing.half_range, *seeing.picture_size, seeing.supersample)
    shown = warp(batch.images, batch.ego_to_image)
    assert torch.allclose(shown[0], shown[1])


def test_shards_keep_images_for_networks_that_look(
    seeing: Seeing, tiny: Path, tmp_path: Path
) -> None:
    frame = dotted_frame(seeing, 2)
    assert frame.images is not None and frame.ego_to_image is not None
    cameras = (frame.images[None], frame.ego_to_image[None])
    write_shard(tmp_path / "a", "one", frame.picture[None], [frame.scene], {}, *cameras)
    read = Frames(tmp_path / "a", seeing)[0]
    assert read.images is not None and read.ego_to_image is not None
    np.testing.assert_array_equal(read.images, frame.images)
    np.testing.assert_array_equal(read.ego_to_image, frame.ego_to_image)
    plain = load_config(tiny)
    assert Frames(tmp_path / "a", plain)[0].images is None
    write_shard(tmp_path / "b", "one", frame.picture[None], [frame.scene], {})
    both = Frames([tmp_path / "a", tmp_path / "b"], plain)
    assert len(both) == 2 and both[1].scene.points.shape == (3, 2)
    with pytest.raises(BadInput, match="no camera images"):
        Frames(tmp_path / "b", seeing)


def truth_map(folder: Path) -> Path:
    """A map around the drive of `write_native_log`."""
    x, y = 583_000.0, 4_477_000.0
    side = np.array([[x, y + 2, 30.0], [x + 15, y + 3, 30.0], [x + 30, y + 4, 30.0]])
    ring = np.array([[x + a, y + b, 30.0] for a, b in ((8, 0), (11, 0), (11, 9), (8, 9), (8, 0))])
    elements = [Element("d", "divider", side), Element("c", "ped_crossing", ring)]
    write_new_map(VectorMap(elements, "EPSG:32617"), folder, "test")
    return folder


def test_a_native_log_becomes_frames(rtmap, tiny: Path, seeing: Seeing, tmp_path: Path) -> None:
    log, city = write_native_log(tmp_path / "log"), truth_map(tmp_path / "map")
    call = ("--config", tiny, "--data", log, "--threads", 1, "--keep-images")
    lacking = rtmap("train", "-o", tmp_path / "w.pt", *call, code=3)
    assert "pass --map" in lacking.err and not (tmp_path / "cache").exists()
    said = rtmap("train", "-o", tmp_path / "w.pt", *call, "--map", city)
    assert "4 training frames" in said.err
    (cache,) = (tmp_path / "cache").iterdir()
    frames = Frames(cache, seeing)
    assert len(frames) == 4
    pose = np.array([583_000.0, 4_477_000.0])
    c, s = np.cos(0.1), np.sin(0.1)
    expected = (np.array([583_000.0, 4_477_002.0]) - pose) @ np.array([[c, -s], [s, c]])
    near = np.hypot(*(frames[0].scene.points - expected).T).min()
    assert near < 1e-3
    # Frame 1 lacks a camera: zero in images and projections.
    assert frames[1].images is not None and frames[1].ego_to_image is not None
    assert (frames[1].images[1] == 0).all() and (frames[1].ego_to_image[1] == 0).all()
    assert (frames[0].ego_to_image[1] != 0).any()
    before = {p.name: p.stat().st_mtime_ns for p in cache.iterdir()}
    said = rtmap("train", "-o", tmp_path / "w.pt", *call, "--map", city)
    assert "training frames" not in said.err
    assert {p.name: p.stat().st_mtime_ns for p in cache.iterdir()} == before


def test_logs_of_a_folder_with_their_own_maps(rtmap, tiny: Path, tmp_path: Path) -> None:
    for name in ("first", "second"):
        write_av2_log(tmp_path / "logs" / name)
    call = ("train", "-o", tmp_path / "w.pt", "--config", tiny, "--data", tmp_path / "logs")
    rtmap(*call, "--threads", 1)
    assert len(list((tmp_path / "cache").iterdir())) == 2
    trained = rtmap(*call, "--threads", 1, "--steps", 1, "--batch", 1, "--device", "cpu")
    assert "written" in trained.err and "cells of about 100 m" in trained.err


def test_every_scene_of_a_nuscenes_folder(tiny: Path, tmp_path: Path) -> None:
    folder, config = write_nuscenes(tmp_path / "nuscenes"), load_config(tiny)
    scenes = logs_in(str(folder))
    assert len(scenes) > 1
    made = gather([scenes[0]], config, tmp_path / "cache", spacing_m=0.1)
    assert len(Frames(made, config)) > 1
    assert len(Frames(made, config)[0].scene.classes)
    footprint = Frames(made, config).footprint()
    assert footprint.known and footprint.cells


def test_what_is_no_data(tmp_path: Path, tiny: Path) -> None:
    config = load_config(tiny)
    with pytest.raises(BadInput, match="no such folder"):
        gather([tmp_path / "none"], config, tmp_path / "cache")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "readme.txt").write_text("hello")
    with pytest.raises(BadInput, match="is not a log"):
        gather([tmp_path / "odd"], config, tmp_path / "cache")
    log = write_native_log(tmp_path / "log")
    assert logs_in(str(log)) == [str(log)]
    (log / "images" / "cam_0" / "000002.jpg").write_bytes(b"broken")
    with pytest.raises(BadInput, match="cannot be read as an image"):
        gather([log], config, tmp_path / "cache", truth_map(tmp_path / "map"))
    assert not list((tmp_path / "cache").iterdir())


def test_recipes_come_from_the_file_and_the_command_line(tmp_path: Path) -> None:
    path = tiny_config(tmp_path, "\n[training]\nrate = 1e-4\n[training.noise]\nsigma_m = 2\n")
    load_config(path)
    recipe = load_recipe(path, ["noise.drop=0.3", "augmentation.shift_m=[0.5, 0.5]", "batch=2"])
    assert (recipe.rate, recipe.noise.sigma_m, recipe.noise.drop, recipe.batch) == (1e-4, 2, 0.3, 2)
    assert recipe.augmentation.shift_m == (0.5, 0.5)
    assert recipe.warmup == Recipe().warmup and load_recipe("rtmap-tiny") == Recipe()
    for wrong in ("noise.none=1", "batch=two", "rate=-1", "noise=3", "batch", "precision=fp8"):
        with pytest.raises(UsageError, match="--set"):
            load_recipe(path, [wrong])
    with pytest.raises(BadInput, match=r"\[training\] rate must be"):
        load_recipe(tiny_config(tmp_path, "\n[training]\nrate = 'fast'\n"))


def test_a_live_window_lets_the_oldest_towns_go(tmp_path: Path, tiny: Path) -> None:
    config = load_config(tiny)
    source = painted_frames(tmp_path / "source", tiny, 2)
    window = Window(tmp_path, 48, 3)

    def appear() -> None:
        name = f"town-{window.take():07d}"
        for file in source.iterdir():
            (tmp_path / file.name.replace("painted", name)).write_bytes(file.read_bytes())
        window.add(name)

    appear()
    frames = Frames(tmp_path, config)
    for _ in range(4):
        appear()
        frames.refresh()
    assert [name for _, name in frames.shards] == ["town-0300003", "town-0300004"]
    left = {p.stem for p in tmp_path.glob("town-*")}
    assert left == {"town-0300002", "town-0300003", "town-0300004"}
    assert json.loads((tmp_path / "town-0300004.json").read_text())["frames"] == 2
    assert len(frames) == 4 and frames[3].scene.classes.size
