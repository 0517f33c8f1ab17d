"""``rtmap infer`` on real files: native logs in, runs out, bad input named."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtmap_cli.geometry.poses import se3_from_xyyaw, transform
from rtmap_cli.logs.log import Camera, Frame, Occluder, Rig
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import MATCHED, NEW, OUTDATED
from rtmap_cli.logs.run_files import read_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.infer import find_model

CRS = "EPSG:32632"
ORIGIN = np.array([500_000.0, 5_400_000.0])
FRAMES = 5


def _rig(count: int) -> Rig:
    cameras = []
    for k in range(count):
        pose = np.eye(4)
        forward = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
        pose[:3, :3] = Rotation.from_euler("Z", 360 / count * k, degrees=True).as_matrix() @ forward
        pose[:3, 3] = [1.0, 0.0, 1.5]
        intrinsics = np.array([[200, 0, 159.5], [0, 200, 119.5], [0, 0, 1.0]])
        cameras.append(Camera(f"cam{k}", 320, 240, intrinsics, pose))
    return Rig(tuple(cameras))


def _jpeg(rng: np.random.Generator) -> bytes:
    from PIL import Image

    image = Image.fromarray(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=80)
    return buffer.getvalue()


def write_log(folder: Path, cameras: int = 3, missing: frozenset[int] = frozenset()) -> None:
    """A short straight drive; frames in ``missing`` lack their last camera."""
    rng = np.random.default_rng(0)
    rig = _rig(cameras)
    folder.mkdir()
    writer = NativeLogWriter(folder, folder.name, CRS, rig, ground_z=-0.3)
    for k in range(FRAMES):
        names = [c.name for c in rig][: -1 if k in missing else None]
        frame = Frame(
            index=k,
            timestamp_ns=1_767_600_000_000_000_000 + k * 500_000_000,
            map_SE3_ego=se3_from_xyyaw(ORIGIN[0] + 4.0 * k, ORIGIN[1], 0.0),
            sigma=np.array([1.0, 1.0, 0.02]),
            odometry=None if k == 0 else np.array([4.0, 0.0, 0.0]),
            odometry_sigma=None if k == 0 else np.array([0.04, 0.04, 0.003]),
            occluders=(Occluder(10.0, 3.5, 0.0, 4.5, 1.9),),
        )
        writer.add(frame, {name: _jpeg(rng) for name in names})
    writer.close()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write_log(tmp_path / "monday")
    return tmp_path / "monday"


@pytest.fixture
def prior(tmp_path: Path) -> Path:
    def line(y: float) -> np.ndarray:
        return ORIGIN + np.array([[-80.0, y], [120.0, y]])

    crossing = ORIGIN + np.array([[20, -6], [24, -6], [24, 6], [20, 6], [20, -6]], float)
    elements = [
        Element("left", "boundary", line(6.0)),
        Element("right", "boundary", line(-6.0)),
        Element("middle", "divider", line(0.1)),
        Element("zebra", "ped_crossing", crossing),
    ]
    write_new_map(VectorMap(elements, CRS), tmp_path / "map", "test")
    return tmp_path / "map"


def test_a_first_traversal_is_all_new(rtmap: Callable[..., Any], log: Path, tmp_path: Path) -> None:
    import json

    out = json.loads(rtmap("infer", log, "-o", tmp_path / "run", "--json", "-q").out)
    run = read_run(tmp_path / "run")
    assert out["frames"] == len(run.frames) == FRAMES
    assert run.info["model"] == "rtmap-tiny" and len(run.info["model_sha256"]) == 64
    assert (run.observations.state == NEW).all()
    assert np.isnan(run.observations.prior_points).all()
    assert (run.frames.camera_count == 3).all()
    assert run.occluders is not None and len(run.occluders) == FRAMES


def test_with_a_prior_every_slot_answers_and_pairs_are_exact(
    rtmap: Callable[..., Any], log: Path, prior: Path, tmp_path: Path
) -> None:
    rtmap("infer", log, "--map", prior, "-o", tmp_path / "run", "-q")
    run = read_run(tmp_path / "run")
    o = run.observations
    aided = o.state != NEW
    assert set(o.state[aided]) <= {MATCHED, OUTDATED}
    for k in range(FRAMES):
        ids = list(o.element_id[aided & (o.frame == k)])
        assert {"left", "right", "middle", "zebra"} == set(ids)
    # The prior vertices of a line stay on it, in the map frame.
    middle = o.prior_points[aided & (o.element_id == "middle")]
    np.testing.assert_allclose(middle[..., 1], ORIGIN[1] + 0.1, atol=1e-6)
    # T^E and the observations live near the initial poses.
    assert np.isfinite(run.frames.end_to_end).all()
    assert run.info["map_version"] == 0
    world = transform(run.frames.initial[0], o.points[o.frame == 0].astype(float))
    assert np.isfinite(world).all()


def test_the_same_log_gives_the_same_bytes_in_any_batching(
    rtmap: Callable[..., Any], log: Path, prior: Path, tmp_path: Path
) -> None:
    rtmap("infer", log, "--map", prior, "-o", tmp_path / "a", "-q", "--batch", 1, "--threads", 1)
    rtmap("infer", log, "--map", prior, "-o", tmp_path / "b", "-q", "--batch", 1, "--threads", 1)
    for name in ("frames.parquet", "observations.parquet", "occluders.parquet"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    rtmap("infer", log, "--map", prior, "-o", tmp_path / "c", "-q", "--batch", 5)
    first, batched = (read_run(tmp_path / n).observations for n in "ac")
    aided = np.isfinite(first.existence)
    matching = np.isfinite(batched.existence)
    np.testing.assert_allclose(first.points[aided], batched.points[matching], atol=2e-3)


def test_cameras_may_come_and_go(rtmap: Callable[..., Any], tmp_path: Path) -> None:
    write_log(tmp_path / "gaps", cameras=2, missing=frozenset({1, 3}))
    rtmap("infer", tmp_path / "gaps", "-o", tmp_path / "run", "-q")
    assert list(read_run(tmp_path / "run").frames.camera_count) == [2, 1, 2, 1, 2]


def test_parts_of_a_log(rtmap: Callable[..., Any], log: Path, tmp_path: Path) -> None:
    rtmap("infer", log, "-o", tmp_path / "run", "-q", "--every", 2, "--frames", 2)
    assert list(read_run(tmp_path / "run").frames.frame) == [0, 2]


def test_a_truncated_image_ends_it_or_is_skipped_and_counted(
    rtmap: Callable[..., Any], log: Path, tmp_path: Path
) -> None:
    broken = sorted((log / "images" / "cam1").glob("*.jpg"))[2]
    broken.write_bytes(broken.read_bytes()[:700])
    result = rtmap("infer", log, "-o", tmp_path / "run", "-q", code=3)
    assert broken.name in result.err and "Traceback" not in result.err
    assert len(result.err.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["monday"]
    rtmap("infer", log, "-o", tmp_path / "run", "-q", "--skip-bad-frames")
    run = read_run(tmp_path / "run")
    assert run.info["skipped_frames"] == 1 and list(run.frames.frame) == [0, 1, 3, 4]


def test_bad_models_are_named(rtmap: Callable[..., Any], log: Path, tmp_path: Path) -> None:
    run = ("-o", tmp_path / "run", "-q")
    assert "rtmap-tiny" in rtmap("infer", log, "--model", "nonsense", *run, code=3).err
    assert "no such" in rtmap("infer", log, "--model", tmp_path / "no.onnx", *run, code=3).err
    junk = tmp_path / "junk.onnx"
    junk.write_bytes(b"not a model at all")
    assert "junk.onnx" in rtmap("infer", log, "--model", junk, *run, code=3).err
    stranger = tmp_path / "stranger.onnx"
    # The same graph under another key: a model that does not describe itself.
    content = find_model("rtmap-tiny").read_bytes().replace(b"rtmap.units", b"other.units")
    stranger.write_bytes(content)
    assert "rtmap.units" in rtmap("infer", log, "--model", stranger, *run, code=3).err
    assert not (tmp_path / "run").exists()


def test_bad_logs_and_priors_are_named(
    rtmap: Callable[..., Any], log: Path, prior: Path, tmp_path: Path
) -> None:
    run = ("-o", tmp_path / "run", "-q")
    assert "no such" in rtmap("infer", tmp_path / "nowhere", *run, code=3).err
    (tmp_path / "empty").mkdir()
    assert "empty" in rtmap("infer", tmp_path / "empty", *run, code=3).err
    far = VectorMap([Element("d", "divider", ORIGIN + [[9e3, 0.0], [9.1e3, 0.0]])], CRS)
    write_new_map(far, tmp_path / "far", "test")
    assert "out of" in rtmap("infer", log, "--map", tmp_path / "far", *run, code=3).err
    other = VectorMap([Element("d", "divider", ORIGIN + [[0.0, 0], [9.0, 0]])], "EPSG:32633")
    write_new_map(other, tmp_path / "other", "test")
    assert "EPSG:3263" in rtmap("infer", log, "--map", tmp_path / "other", *run, code=3).err
    table = log / "frames.parquet"
    table.write_bytes(table.read_bytes()[:-40])
    assert "frames.parquet" in rtmap("infer", log, *run, code=3).err
    assert not (tmp_path / "run").exists()


def test_an_existing_output_is_kept_unless_told(
    rtmap: Callable[..., Any], log: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    rtmap("infer", log, "-o", out, "-q", "--frames", 1)
    before = (out / "observations.parquet").read_bytes()
    assert "--overwrite" in rtmap("infer", log, "-o", out, "-q", code=2).err
    assert (out / "observations.parquet").read_bytes() == before
    rtmap("infer", log, "-o", out, "-q", "--frames", 2, "--overwrite")
    assert len(read_run(out).frames) == 2
    shutil.rmtree(out)
