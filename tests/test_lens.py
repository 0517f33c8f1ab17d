"""Lens models: against OpenCV's, where they end, and straightened images."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.lens import Lens
from rtmap_cli.logs.check_parts import Report, check_camera
from rtmap_cli.logs.log import Camera, Rig
from rtmap_cli.logs.tables import RIG, load, rig_of_table, rig_table
from rtmap_cli.steps.infer.images import FittedCamera
from rtmap_cli.tables import write_table

FORWARD = np.array([[0, 0, 1, 1.6], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1.0]])
LENSES = {
    "k1-k3": Lens("pinhole", (-0.28, 0.09, -0.012)),
    "tangential": Lens("pinhole", (-0.25, 0.06, 0.0), (0.004, -0.003)),
    "rational": Lens("pinhole", (1.2, 0.3, 0.01, 1.55, 0.55, 0.05), (1e-3, 2e-3)),
    "fisheye": Lens("fisheye", (0.03, -0.012, 0.004, -0.0008)),
}


def _camera(lens: Lens, width: int = 480, height: int = 300, focal: float = 250.0) -> Camera:
    k = np.array([[focal, 0, width / 2 - 2.0], [0, focal, height / 2 + 3.0], [0, 0, 1]])
    return Camera("c", width, height, k, FORWARD, lens.radial, lens.model, lens.tangential)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_models_are_opencvs(lens: Lens) -> None:
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.7, -0.7, 1], [0.7, 0.7, 1], (50, 3)) * rng.uniform(1, 9, (50, 1))
    camera = _camera(lens)
    zero = np.zeros(3)
    if lens.model == "fisheye":
        args = (points[:, None], zero, zero, camera.intrinsics, np.array(lens.radial))
        expected = cv2.fisheye.projectPoints(*args)[0]
    else:
        (k1, k2, k3, *more), (p1, p2) = lens.radial, lens.tangential
        terms = np.array([k1, k2, p1, p2, k3, *more])
        expected = cv2.projectPoints(points, zero, zero, camera.intrinsics, terms)[0]
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-6)


def _undistort(lens: Lens, xy: np.ndarray) -> np.ndarray:
    """(..., 2) image coordinates → straight ones, interpolated between bent ones; NaN outside."""
    from scipy.interpolate import CloughTocher2DInterpolator

    reach = min(lens.reach, 2.5)
    angle = np.linspace(-1, 1, 121) * np.arctan(reach)
    grid = np.stack(np.meshgrid(np.tan(angle), np.tan(angle)), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) <= reach]
    return np.asarray(CloughTocher2DInterpolator(lens.distort(grid), grid)(xy))


def test_where_a_model_folds_nothing_is_seen() -> None:
    lens = Lens("pinhole", (-0.3, 0.0, 0.0))
    # r (1 - 0.3 r²) rises up to r = 1 / √0.9.
    assert lens.reach == pytest.approx(1 / np.sqrt(0.9), rel=0.01)
    camera = _camera(lens)
    beyond = np.array([[2.0, 0.0, 1.0], [0.5, 0.0, -1.0], [0.2, 0.1, 1.0]])
    assert np.isnan(camera.project(beyond)).all(axis=1).tolist() == [True, True, False]
    report = Report(Path("log"))
    check_camera(report, Path("rig"), _camera(lens, focal=250.0))
    assert [f.level for f in report.findings] == ["warning"] and "folds" in report.findings[0].what


def test_wide_fisheyes_reach_beside_the_camera() -> None:
    assert LENSES["fisheye"].reach > 50
    report = Report(Path("log"))
    check_camera(report, Path("rig"), _camera(LENSES["fisheye"], 1280, 800, 400.0))
    assert not report.findings


def _checkerboard(rays: np.ndarray) -> np.ndarray:
    """Squares of 0.1 on the plane z = 1 in front of the camera, softened edges."""
    wave = np.sin(np.pi * rays[..., 0] / 0.1) * np.sin(np.pi * rays[..., 1] / 0.1)
    return 127.5 + 127.5 * np.clip(wave * 3, -1, 1)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_images_are_straightened(lens: Lens, tmp_path: Path) -> None:
    """The image of a grid, made with the inverse of the lens, comes out straight."""
    from PIL import Image

    camera = _camera(lens)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    k = camera.intrinsics
    bent = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1]], axis=-1)
    rays = _undistort(lens, bent)
    grey = np.where(np.isnan(rays[..., 0]), 0, _checkerboard(np.nan_to_num(rays)))
    image = Image.fromarray(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    (tmp_path / "0.png").write_bytes(buffer.getvalue())

    fitted = FittedCamera(camera, (180, 480), 0.4, 0.0)
    got = fitted.load(tmp_path / "0.png")[..., 0].astype(float)
    fu, fv = np.meshgrid(np.arange(480), np.arange(180))
    straight = np.linalg.solve(
        fitted.intrinsics, np.stack([fu, fv, np.ones_like(fu)], -1).reshape(-1, 3).T
    ).T.reshape(180, 480, 3)
    expected = _checkerboard(straight[..., :2])
    # Inside the stored image, by a margin for the interpolation.
    at = camera.project(straight)
    inside = (at > 2).all(-1) & (at[..., 0] < camera.width - 3) & (at[..., 1] < camera.height - 3)
    assert inside.mean() > 0.5
    assert np.abs(got - expected)[inside].mean() < 6.0
    if lens.model == "fisheye":
        pinhole = FittedCamera(_camera(Lens()), (180, 480), 0.4, 0.0).load(tmp_path / "0.png")
        assert np.abs(pinhole[..., 0] - expected)[inside].mean() > 30.0


def test_rigs_keep_every_lens_and_old_rigs_are_read(tmp_path: Path) -> None:
    from dataclasses import replace

    import pyarrow as pa

    cameras = [replace(_camera(lens), name=name) for name, lens in LENSES.items()]
    path = tmp_path / "rig.parquet"
    write_table(rig_table(Rig(tuple(cameras))), path, RIG)
    read = rig_of_table(load(path, RIG), path)
    assert [c.lens for c in read] == [c.lens for c in cameras]

    table = pq.read_table(path)
    old = table.select([n for n in table.schema.names if n not in RIG.defaults])
    metadata = {**table.schema.metadata, b"rtmap.schema_version": b"1.0"}
    pq.write_table(old.replace_schema_metadata(metadata), path)
    assert [c.model for c in rig_of_table(load(path, RIG), path)] == ["pinhole"] * len(LENSES)

    for name, value in (("model", "mirror"), ("k5", 0.1)):
        k = table.schema.get_field_index(name)
        bad = table.set_column(k, table.schema.field(k), pa.array([value] * len(table)))
        pq.write_table(bad.slice(3), path)
        with pytest.raises(BadInput, match=r"camera fisheye: .*(mirror|k5)"):
            rig_of_table(load(path, RIG), path)


def test_lenses_that_cannot_be_are_refused() -> None:
    for args in (("pinhole", (0.1,)), ("fisheye", (0.0,) * 3), ("mirror", (0.0,) * 3)):
        with pytest.raises(ValueError):
            Lens(*args)
    with pytest.raises(ValueError):
        Lens("fisheye", (0.0,) * 4, (0.1, 0.0))
