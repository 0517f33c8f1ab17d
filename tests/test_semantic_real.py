"""Semantic maps of real sensors: a DGP scene and a nuScenes keyframe, masks by a stated rule.

Pictures are written beside the test's other files; with RTMAP_ARTEFACTS=DIR they are kept there.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from semantic_samples import write_paint_masks

from rtmap_cli.cli import run
from rtmap_cli.formats.pickles import read_plain_pickle
from rtmap_cli.geometry.poses import invert, se3_from_quaternion, se3_from_xyyaw, transform
from rtmap_cli.logs.log import Camera, Frame, Log
from rtmap_cli.logs.open import open_log
from rtmap_cli.logs.semantic import CLASSES, COLOURS, SemanticMap
from rtmap_cli.steps.semantic.project import View

Call = Any
Array = NDArray[np.float64]
SLACK = 3.0
"""Pixels by which a point may leave the picture of its box."""


@pytest.fixture(scope="module")
def dgp(rtmap_data: Path) -> str:
    folder = rtmap_data / "dgp" / "test_scene"
    if not folder.is_dir():
        pytest.skip("dgp/test_scene not found in RTMAP_DATA")
    return f"dgp:{folder}#scene_02"


@pytest.fixture(scope="module")
def nuscenes(rtmap_data: Path) -> str:
    found = sorted((rtmap_data / "nuscenes" / "demo").glob("*.pkl"))
    if not found:
        pytest.skip("nuscenes/demo not found in RTMAP_DATA")
    return str(found[0])


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pictures go."""
    folder = Path(os.environ.get("RTMAP_ARTEFACTS") or tmp_path_factory.mktemp("artefacts"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def dgp_masks(dgp: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dgp") / "masks"
    write_paint_masks(open_log(dgp), folder)
    return folder


@pytest.fixture(scope="module")
def nuscenes_masks(nuscenes: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nuscenes") / "masks"
    write_paint_masks(open_log(nuscenes), folder)
    return folder


def semantic_map(log: str, masks: Path, out: Path, *more: object) -> SemanticMap:
    """The semantic map of a log by the command line."""
    words = ["semantic-map", log, "--masks", masks, "-o", out, "-q", *more]
    assert run([str(w) for w in words]) == 0
    return SemanticMap(out)


@pytest.fixture(scope="module")
def dgp_map(dgp: str, dgp_masks: Path) -> SemanticMap:
    return semantic_map(dgp, dgp_masks, dgp_masks.parent / "out")


def views(log: Log, frame: Frame) -> Iterator[tuple[Camera, View]]:
    """Every camera of a frame where it stood at its exposure."""
    for camera in log.rig or ():
        pose = frame.ego_SE3_exposure.get(camera.name, np.eye(4)) @ camera.ego_SE3_camera
        yield camera, View(camera, pose, np.zeros((camera.height, camera.width), np.uint8))


def pixels(view: View, points: Array) -> Array:
    """(n, 2) column and row of points (ego frame) as the product projects them; those ahead."""
    local = transform(view.into_camera.astype(np.float64), points)
    local = local[local[:, 2] > 1]
    row, column = view.pixels((local[:, :2] / local[:, 2:]).astype(np.float32))
    return np.stack([column, row], axis=-1).astype(np.float64)


def inside_box(points: Array, ego_SE3_box: Array, size: Array) -> Array:
    """The points (n, 3) in a box."""
    local = transform(invert(ego_SE3_box), points)
    return points[(np.abs(local) < size / 2).all(axis=1)]


def dgp_boxes(path: Path) -> dict[int, tuple[Array, Array]]:
    """Pose and length, width, height of every box, by instance."""
    out = {}
    for record in json.loads(path.read_text())["annotations"]:
        box = record["box"]
        q = np.array([box["pose"]["rotation"][k] for k in ("qw", "qx", "qy", "qz")])
        t = np.array([box["pose"]["translation"][k] for k in "xyz"])
        size = np.array([box[k] for k in ("length", "width", "height")])
        out[record["instance_id"]] = (se3_from_quaternion(q, t), size)
    return out


def test_dgp_points_in_cuboids_fall_into_their_boxes_in_the_images(dgp: str) -> None:
    """Boxes are annotated once in the sweep and once in each image, 0.09 s earlier."""
    log: Any = open_log(dgp)
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, 8).T
    tried, hit = 0, 0
    for frame in log.frames():
        points = log.read_sweep(frame)[:, :3]
        folder = log.folder / "bounding_box_3d"
        boxes = dgp_boxes(folder / "LIDAR" / f"{frame.lidar.stem}.json")
        for camera, view in views(log, frame):
            seen = dgp_boxes(folder / camera.name / f"{frame.images[camera.name].stem}.json")
            for instance, (pose, size) in seen.items():
                inner = inside_box(points, *boxes[instance]) if instance in boxes else points[:0]
                if len(inner) < 10:
                    continue
                outline = camera.project(transform(pose, corners * size))
                low, high = outline.min(axis=0) - SLACK, outline.max(axis=0) + SLACK
                at = pixels(view, inner)
                tried += len(at)
                hit += int(((at > low) & (at < high)).all(axis=1).sum())
    assert tried > 2000 and hit / tried > 0.99


def test_nuscenes_points_in_cuboids_fall_into_their_boxes_in_the_images(nuscenes: str) -> None:
    log: Any = open_log(nuscenes)
    frame = next(log.frames())
    sample = read_plain_pickle(Path(nuscenes))["data_list"][0]
    ego_SE3_lidar = np.array(sample["lidar_points"]["lidar2ego"], np.float64)
    points = log.read_sweep(frame)[:, :3]
    tried, hit = 0, 0
    for camera, view in views(log, frame):
        camera_SE3_lidar = view.into_camera.astype(np.float64) @ ego_SE3_lidar
        for record in sample["cam_instances"][camera.name]:
            x, y, z, length, height, width = record["bbox_3d"][:6]
            for other in sample["instances"]:
                box = np.array(other["bbox_3d"], np.float64)
                there = transform(camera_SE3_lidar, box[None, :3])[0]
                same_size = np.allclose(box[3:6], [length, width, height], atol=1e-3)
                if not same_size or np.hypot(*(there - (x, y, z))[[0, 2]]) > 0.6:
                    continue
                pose = se3_from_xyyaw(box[0], box[1], box[6], box[2])
                at = pixels(view, inside_box(points, ego_SE3_lidar @ pose, box[3:6]))
                size = np.array([camera.width, camera.height])
                at = at[((at >= 0) & (at < size)).all(axis=1)]
                if len(at) < 10:
                    continue
                corner = np.array(record["bbox"], np.float64)
                tried += len(at)
                inside = (at > corner[:2] - SLACK) & (at < corner[2:] + SLACK)
                hit += int(inside.all(axis=1).sum())
    assert tried > 250 and hit / tried > 0.97


def picture_of(planes: NDArray[np.uint8]) -> Image.Image:
    """An ego window as people look at it: forward to the right, left up."""
    palette = np.array([COLOURS[n] for n in CLASSES], np.uint8)
    image = palette[planes[:-1].argmax(axis=0)] * (planes[-1:] > 0).transpose(1, 2, 0)
    return Image.fromarray(image[::-1].astype(np.uint8)).resize((1440, 720), 0)


def marked(semantic: SemanticMap, frame: int, evidence: int = 40) -> Array:
    """(n, 2) ego x, y of cells that are likelier paint than anything else, well observed."""
    planes = semantic.read_window(frame)
    paint = (planes[:-1].argmax(axis=0) == CLASSES.index("marking")) & (planes[-1] > evidence)
    return semantic.window.centres()[paint]


def test_dgp_raster_shows_straight_lane_lines(dgp_map: SemanticMap, kept: Path) -> None:
    """The double yellow line to the left and the edge line to the right, straight ahead."""
    picture_of(dgp_map.read_window(2)).save(kept / "semantic_dgp.png")
    Image.open(dgp_map.path / "overview.png").save(kept / "semantic_dgp_map.png")
    points = marked(dgp_map, 2)
    ahead = points[(points[:, 0] > 3) & (points[:, 0] < 25) & (np.abs(points[:, 1]) < 3)]
    for side in (1, -1):
        line = ahead[np.sign(ahead[:, 1]) == side]
        middle = np.median(line[:, 1])
        near = line[np.abs(line[:, 1] - middle) < 0.6]
        slope, offset = np.polyfit(near[:, 0], near[:, 1], 1)
        assert len(near) > 40 and len(near) / len(line) > 0.7
        assert abs(slope) < 0.03
        assert np.abs(near[:, 1] - slope * near[:, 0] - offset).mean() < 0.2
        assert np.ptp(near[:, 0]) > 15


def test_frames_of_dgp_lie_on_each_other(dgp_map: SemanticMap) -> None:
    """Three frames see a line where one frame sees it: motion and poses agree."""
    last = invert(dgp_map.map_SE3_ego[2])
    places = []
    for frame in range(3):
        points = marked(dgp_map, frame)
        edge = points[(points[:, 0] > 5) & (points[:, 0] < 20)]
        edge = edge[(edge[:, 1] < -0.8) & (edge[:, 1] > -2.4)]
        there = np.column_stack([edge, np.zeros(len(edge))])
        places.append(np.median(transform(last @ dgp_map.map_SE3_ego[frame], there)[:, 1]))
    assert np.ptp(places) < 0.25


def test_dgp_without_lidar_on_the_ground_plane(dgp: str, dgp_masks: Path, kept: Path) -> None:
    out = dgp_masks.parent / "plane"
    semantic = semantic_map(dgp, dgp_masks, out, "--ground-plane", "--windows", "all")
    picture_of(semantic.read_window(2)).save(kept / "semantic_dgp_plane.png")
    points = marked(semantic, 2)
    edge = points[(points[:, 0] > 6) & (points[:, 0] < 18) & (points[:, 1] < -0.8)]
    edge = edge[edge[:, 1] > -2.4]
    slope, _ = np.polyfit(edge[:, 0], edge[:, 1], 1)
    assert len(edge) > 50 and abs(slope) < 0.05


def test_nuscenes_rasters_show_the_dashed_line_straight(
    nuscenes: str, nuscenes_masks: Path, kept: Path
) -> None:
    """One sparse sweep: the line beside the car is hit once per ring, the plane shows it whole."""
    found = []
    for name, more in (("", ()), ("_plane", ("--ground-plane",))):
        semantic = semantic_map(nuscenes, nuscenes_masks, nuscenes_masks.parent / f"o{name}", *more)
        picture_of(semantic.read_window(0)).save(kept / f"semantic_nuscenes{name}.png")
        points = marked(semantic, 0, 15)
        line = points[(points[:, 0] > 6) & (points[:, 0] < 20) & (np.abs(points[:, 1]) < 1.2)]
        slope, offset = np.polyfit(line[:, 0], line[:, 1], 1)
        assert len(line) > 8 and np.ptp(line[:, 0]) > 8 and abs(slope) < 0.08
        assert np.abs(line[:, 1] - slope * line[:, 0] - offset).mean() < 0.3
        found.append(np.median(line[:, 1]))
    assert abs(found[0] - found[1]) < 0.35
