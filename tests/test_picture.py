"""rtmap picture: lines lie on the pixels of the road that they stand for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_logs import FORWARD, jpeg, write_native_log

from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform
from rtmap_cli.logs.log import Camera, Frame, Rig
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import MATCHED, NEW, OUTDATED, Observations, Run, RunFrames, run_info
from rtmap_cli.logs.run_files import write_run
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.picture import (
    Entry,
    GroundLine,
    Mark,
    Panel,
    View,
    draw_panels,
    draw_views,
    element_lines,
    grid_lines,
)
from rtmap_cli.steps.picture.grid import EDGES, legend_entries
from rtmap_cli.steps.picture.grid import FORWARD as RED
from rtmap_cli.steps.picture.grid import RANGE as YELLOW
from rtmap_cli.steps.picture.legend import SAMPLE, rows_of

Call = Callable[..., Any]
CRS = "EPSG:32632"
GROUND = -0.3
HEAD, GAP = 52, 6
"""Where the first image begins in a picture: below two lines of text, right of the margin."""


def _camera(model: str, radial: tuple[float, ...]) -> Camera:
    # Looks 20° down, so that the axes under the vehicle are seen too.
    tilt = np.eye(4)
    a = np.radians(20)
    tilt[1:3, 1:3] = [[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]
    k = np.array([[260.0, 0, 319.5], [0, 260, 199.5], [0, 0, 1]])
    return Camera("front", 640, 400, k, FORWARD @ tilt, radial, model)


def _write(folder: Path, camera: Camera) -> Path:
    folder.mkdir()
    writer = NativeLogWriter(folder, folder.name, CRS, Rig((camera,)), ground_z=GROUND)
    pose = se3_from_xyyaw(500_000.0, 5_400_000.0, 0.5)
    for k in range(2):
        writer.add(Frame(k, 10**18 + k, pose, np.ones(3)), {"front": jpeg(20, (640, 400))})
    writer.close()
    return folder


def _pixels(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def _coloured(pixels: np.ndarray, at: np.ndarray, colour: tuple[int, ...]) -> bool:
    """Whether a pixel of about this colour lies within 2 pixels of ``at`` (x, y)."""
    x, y = np.round(at).astype(int) + [GAP, HEAD]
    part = pixels[y - 2 : y + 3, x - 2 : x + 3]
    return bool((np.abs(part - np.array(colour)).sum(axis=-1) < 60).any())


LENSES = {
    "straight": ("pinhole", (0.0, 0.0, 0.0)),
    "barrel": ("pinhole", (-0.2, 0.03, 0.0)),
    "fisheye": ("fisheye", (0.02, 0.0, 0.0, 0.0)),
}


@pytest.mark.parametrize(("model", "radial"), LENSES.values(), ids=LENSES)
def test_the_grid_lies_on_the_road(
    rtmap: Call, tmp_path: Path, model: str, radial: tuple[float, ...]
) -> None:
    camera = _camera(model, radial)
    log = _write(tmp_path / "log", camera)
    rtmap("picture", log, "--frame", 1, "--grid", "-o", tmp_path / "g.png", "--width", 640)
    pixels = _pixels(tmp_path / "g.png")
    road = np.array([[4.5, 0.0, GROUND], [36.0, 0.0, GROUND], [36.0, 9.0, GROUND]])
    at = camera.project(transform(invert(camera.ego_SE3_camera), road))
    assert _coloured(pixels, at[0], RED)
    assert _coloured(pixels, at[1], YELLOW) and _coloured(pixels, at[2], YELLOW)
    # Nothing red where the axis would end were the road at the height of the ego origin.
    above = camera.project(transform(invert(camera.ego_SE3_camera), np.array([5.0, 0.0, 0.0])))
    assert not _coloured(pixels, above, RED)


def test_as_seen_shows_what_the_network_gets(rtmap: Call, tmp_path: Path) -> None:
    from rtmap_cli.steps.infer import MapModel
    from rtmap_cli.steps.infer.images import FittedCamera

    camera = _camera("fisheye", (0.02, 0.0, 0.0, 0.0))
    log = _write(tmp_path / "log", camera)
    command = ("picture", log, "--grid", "-o", tmp_path / "g.png", "--as-seen", "rtmap-tiny")
    rtmap(*command, "--width", 640)
    info = MapModel("rtmap-tiny", 1).info
    fitted = FittedCamera(camera, info.image_size, info.horizon, GROUND)
    u = fitted.ego_to_image.astype(float) @ [info.range_m[2], 9.0, 0.0, 1.0]
    at = (u[:2] / u[2] + 0.5) * 640 / info.image_size[1] - 0.5
    assert _coloured(_pixels(tmp_path / "g.png"), at, YELLOW)


def test_lines_move_with_the_vehicle_between_image_and_frame() -> None:
    from dataclasses import replace

    from rtmap_cli.commands.picture import _stored
    from rtmap_cli.logs.native import NativeLog

    class Log(NativeLog):
        def __init__(self) -> None:
            self.ground_z = GROUND

    camera = _camera("pinhole", (0.0, 0.0, 0.0))
    back = se3_from_xyyaw(-1.0, 0.0, 0.0)
    frame = Frame(0, 0, np.eye(4), np.ones(3), images={"front": Path(__file__)})
    moved = replace(frame, ego_SE3_exposure={"front": back})
    views = []
    for f in (frame, moved):
        from unittest import mock

        blank = np.zeros((400, 640, 3), np.uint8)
        with mock.patch("rtmap_cli.logs.native.decode_image", return_value=blank):
            views.append(_stored(Log(), f, np.zeros(3), camera))
    # Seen from a metre farther back, a point looks as one a metre farther ahead.
    near, far = np.array([[10.0, 2.0, 0.0]]), np.array([[11.0, 2.0, 0.0]])
    np.testing.assert_allclose(views[1].project(near), views[0].project(far), atol=1e-9)


def test_runs_and_maps_are_drawn(rtmap: Call, tmp_path: Path) -> None:
    camera = _camera("pinhole", (0.0, 0.0, 0.0))
    log = _write(tmp_path / "log", camera)
    rtmap("infer", log, "-o", tmp_path / "run", "-q", "--threads", 1)
    out = tmp_path / "seen.jpg"
    rtmap("picture", log, "--run", tmp_path / "run", "-o", out, "--score-threshold", 0.0)
    ahead = se3_from_xyyaw(500_000.0, 5_400_000.0, 0.5)
    line = transform(ahead, np.array([[3.0, 1.0], [20.0, 1.0]]))
    write_new_map(VectorMap([Element("d", "divider", line)], CRS), tmp_path / "map", "test")
    out = tmp_path / "map.png"
    rtmap("picture", log, "--map", tmp_path / "map", "-o", out, "--width", 640)
    road = np.array([[8.0, 1.0, GROUND]])
    at = camera.project(transform(invert(camera.ego_SE3_camera), road))[0]
    assert _coloured(_pixels(out), at, (214, 120, 0))


def _run(log: Path, folder: Path) -> Path:
    """One element of each state, 1 m wide apart, along the first frame's way ahead."""
    line = np.column_stack([np.linspace(4.0, 20.0, 20), np.zeros(20)])
    places = [line + [0.0, y] for y in (2.0, 0.0, -2.0)]
    states = np.array([MATCHED, NEW, OUTDATED], np.int8)
    pose = se3_from_xyyaw(500_000.0, 5_400_000.0, 0.5)
    prior = np.full((3, 20, 2), np.nan)
    prior[0], prior[2] = (transform(pose, places[k]) for k in (0, 2))
    # The network's own vertices of an outdated element mean nothing.
    points = np.array([*places[:2], places[2] + 8.0], np.float32)
    seen = Observations(
        np.zeros(3, np.int32), np.arange(3, dtype=np.int32), states,
        np.array(["divider"] * 3, object), np.full(3, 0.9, np.float32),
        np.array([0.9, np.nan, 0.1], np.float32), np.array(["a", None, "c"], object), points,
        np.full((3, 20, 2), 0.1, np.float32), prior,
    )  # fmt: skip
    unknown = np.full((1, 3), np.nan)
    frames = RunFrames(
        np.zeros(1, np.int32), np.array([10**18]), pose[None], np.ones((1, 3)), unknown, unknown,
        unknown, np.full((1, 3, 3), np.nan), np.ones(1, np.int32),
    )  # fmt: skip
    folder.mkdir()
    info = run_info(log.name, CRS, ["divider"], {"x": [-36, 36], "y": [-18, 18]})
    write_run(Run(info, frames, seen), folder)
    return folder


def test_states_have_edges_and_the_legend_names_them(rtmap: Call, tmp_path: Path) -> None:
    camera = _camera("pinhole", (0.0, 0.0, 0.0))
    log = _write(tmp_path / "log", camera)
    out = ("-o", tmp_path / "p.png", "--width", 640, "--overwrite")
    rtmap("picture", log, *out)
    bare = _pixels(tmp_path / "p.png")
    rtmap("picture", log, "--run", _run(log, tmp_path / "run"), *out)
    pixels = _pixels(tmp_path / "p.png")
    legend = pixels[len(bare) :, GAP:-GAP]
    assert len(legend) > 10 and pixels.shape[1] == bare.shape[1]
    orange = (214, 120, 0)
    for y, state in ((2.0, "confirmed"), (0.0, "new"), (-2.0, "outdated")):
        road = np.array([[8.0, y, GROUND]])
        at = camera.project(transform(invert(camera.ego_SE3_camera), road))[0]
        assert _coloured(pixels, at, orange)
        # The edge lies on both sides of a line that is 3 pixels wide.
        beside = [at + [3, 0], at - [3, 0]]
        assert all(_coloured(pixels, b, EDGES[state]) for b in beside), state
        assert (legend == EDGES[state]).all(axis=-1).any(), state
    assert (legend == orange).all(axis=-1).any()


def test_the_legend_names_what_is_there_and_nothing_else() -> None:
    def names(lines: list[GroundLine]) -> list[str]:
        return [entry.text for entry in legend_entries(lines)]

    grid = ["every 1 m", "every 5 m", "range (numbers: m ahead)", "5 m forward", "5 m left"]
    assert names(grid_lines((-36, -18, 36, 18))) == grid
    line = np.array([[0.0, 0.0], [5.0, 0.0]])
    drawn = element_lines(["divider", "boundary"], [line, line])
    drawn += element_lines(["divider"], [line], "new")
    assert names(drawn) == ["divider", "boundary", "on the map (initial pose)", "new"]


def test_a_legend_too_wide_takes_more_rows() -> None:
    from PIL import ImageFont

    font = ImageFont.load_default(size=14)
    entries = [Entry("a word that is long", (0, 0, 0))] * 7
    rows = rows_of(entries, 500, font)
    assert sum(map(len, rows)) == 7 and len(rows) > 1
    for row in rows:
        x, entry = row[-1]
        assert x + SAMPLE + font.getlength(entry.text) <= 500


def test_maps_side_by_side_have_a_scale_a_legend_and_labels() -> None:
    red, place = (255, 0, 0), np.array([[10.0, 20.0], [10.0, 30.0]])
    town = VectorMap([Element("d", "divider", np.array([[0.0, 0.0], [50.0, 50.0]]))], CRS)

    def draw(label: str, at: np.ndarray) -> np.ndarray:
        panel = Panel("town", town, [Mark(at, red, 5, label)])
        legend = [Entry("gone", red)]
        return np.asarray(draw_panels([panel], (0, 0, 100, 100), 300, legend)).astype(int)

    bare, told = draw("", place), draw("0.97", place)
    assert bare.shape == told.shape
    changed = np.argwhere((bare != told).any(axis=-1))
    # 3 pixels a metre, below the title, right of the margin: beside the mark's easternmost point.
    y, x = changed.min(axis=0)
    assert x > 12 + 10 * 3 and abs(changed[:, 0].mean() - (40 + 80 * 3)) < 8 and y > 40
    border = np.array([[98.0, 20.0], [98.0, 30.0]])
    changed = np.argwhere((draw("", border) != draw("0.97", border)).any(axis=-1))
    assert changed[:, 1].min() > 12 and changed[:, 1].max() < 12 + 98 * 3 + 3
    foot = bare[40 + 300 :]
    for colour in (red, (214, 120, 0), (70, 70, 78), (30, 110, 190)):
        assert (foot == colour).all(axis=-1).any(), colour
    # The largest round length in a fifth of the panel is 20 m, of 3 pixels each.
    bar = (foot[6 + 12] == (30, 30, 34)).all(axis=-1)
    assert bar[12 : 12 + 60].all() and not bar[12 + 64 : 12 + 67].any()


def test_bad_input_is_one_line(rtmap: Call, tmp_path: Path) -> None:
    log = write_native_log(tmp_path / "log")
    out = ("-o", tmp_path / "p.png")
    other = VectorMap([Element("d", "divider", np.array([[5e5, 0], [5e5 + 9, 0]]))], CRS)
    write_new_map(other, tmp_path / "map", "test")
    cases: list[tuple[tuple[object, ...], str]] = [
        (("--frame", 99, *out), "no frame 99"),
        (("-o", tmp_path / "p.gif"), ".png"),
        (("-o", log / "p.png"), "inside the input"),
        (("--map", tmp_path / "map", *out), "EPSG"),
        (("--run", tmp_path / "map", *out), "run.json"),
        (("--as-seen", "nonsense", *out), "rtmap-tiny"),
    ]
    for arguments, told in cases:
        result = rtmap("picture", log, *arguments, code=3)
        assert told in result.err and len(result.err.strip().splitlines()) == 1
    rtmap("picture", log, *out)
    assert "--overwrite" in rtmap("picture", log, *out, code=2).err
    rtmap("picture", log, *out, "--overwrite")
    (log / "images.parquet").unlink()
    assert "no images" in rtmap("picture", log, *out, "--overwrite", code=3).err


def test_lines_follow_the_slope_of_the_path(rtmap: Call, tmp_path: Path) -> None:
    camera = _camera("pinhole", (0.0, 0.0, 0.0))
    folder = tmp_path / "log"
    folder.mkdir()
    writer = NativeLogWriter(folder, "hill", CRS, Rig((camera,)), ground_z=GROUND)
    # Level vehicle, road that rises by 5 % along the drive: a slope begins here.
    for k, x in enumerate(np.arange(0.0, 60.0, 2.0)):
        pose = se3_from_xyyaw(500_000.0 + x, 5_400_000.0, 0.0, 0.05 * x)
        writer.add(Frame(k, 10**18 + k, pose, np.ones(3)), {"front": jpeg(20, (640, 400))})
    writer.close()
    rtmap("picture", folder, "--grid", "-o", tmp_path / "g.png", "--width", 640)
    pixels = _pixels(tmp_path / "g.png")
    road = np.array([[36.0, 4.0, GROUND], [36.0, 4.0, GROUND + 36.0 * 0.05]])
    at = camera.project(transform(invert(camera.ego_SE3_camera), road))
    assert at[0][1] - at[1][1] > 10
    assert _coloured(pixels, at[1], YELLOW) and not _coloured(pixels, at[0], YELLOW)


def test_lines_behind_the_camera_are_left_out() -> None:
    from PIL import Image

    view = View("blind", Image.new("RGB", (50, 40)), lambda p: np.full((len(p), 2), np.nan))
    picture = np.asarray(draw_views([view], grid_lines((-36, -18, 36, 18))))
    assert (picture[HEAD : HEAD + 40, GAP : GAP + 50] == 0).all()
