"""Small logs for tests, written anew in a temporary folder: one native, one as Argoverse 2."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq

from rtmap_cli.geometry.poses import quaternion_from_se3, se3_from_xyyaw
from rtmap_cli.logs.log import Camera, Frame, Occluder, Rig
from rtmap_cli.logs.native import NativeLogWriter
from rtmap_cli.logs.run import true_poses
from rtmap_cli.tables import whole_folder

FORWARD = np.array([[0, 0, 1, 1.6], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1.0]])
"""ego_SE3_camera of a camera that looks forward."""


def small_rig(count: int = 2) -> Rig:
    """Cameras of 64 × 48 pixels turned by 0.9 rad from one to the next."""
    k = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    turn = [se3_from_xyyaw(0.0, 0.0, a) for a in np.arange(count) * 0.9]
    return Rig(
        tuple(Camera(f"cam_{i}", 64, 48, k, t @ FORWARD, (0.1, 0, 0)) for i, t in enumerate(turn))
    )


def jpeg(value: int, size: tuple[int, int] = (64, 48)) -> bytes:
    """A JPEG of one grey; size is (width, height)."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.full((size[1], size[0], 3), value, np.uint8)).save(buffer, "JPEG")
    return buffer.getvalue()


def write_native_log(folder: Path, frames: int = 4, cameras: int = 2) -> Path:
    """A native log at 2 Hz: frame 1 lacks all cameras but one, frame 0 has occluder and sweep."""
    pose = se3_from_xyyaw(583_000.0 + 2.5 * np.arange(frames), 4_477_000.0, 0.1, 30.0)
    times = 1_700_000_000_000_000_000 + 500_000_000 * np.arange(frames)
    with whole_folder(folder) as temporary:
        writer = NativeLogWriter(temporary, "drive-1", "EPSG:32617", small_rig(cameras), -0.3)
        for i in range(frames):
            frame = Frame(
                index=i,
                timestamp_ns=int(times[i]),
                map_SE3_ego=pose[i],
                sigma=np.array([0.8, 0.8, 0.02]),
                odometry=None if i == 0 else np.array([2.5, 0.0, 0.0]),
                odometry_sigma=None if i == 0 else np.array([0.02, 0.01, 0.001]),
                occluders=(Occluder(9.0, 2.0, 0.1, 4.5, 1.8),) if i == 0 else (),
            )
            names = [f"cam_{k}" for k in range(1 if i == 1 else cameras)]
            sweep = np.arange(12, dtype=float).reshape(3, 4) / 12 if i == 0 else None
            writer.add(frame, {n: jpeg((40 * i + 10) % 250) for n in names}, sweep=sweep)
        writer.write_truth(true_poses(np.arange(frames), times, pose), {"changes": []})
        writer.close()
    return folder


def rewrite(path: Path, /, **columns: Any) -> None:
    """Replace columns of a Parquet or feather table; metadata and other columns are kept."""
    is_feather = path.suffix == ".feather"
    table = feather.read_table(path) if is_feather else pq.read_table(path)
    for name, values in columns.items():
        k = table.schema.names.index(name)
        table = table.set_column(k, table.schema.field(k), pa.array(values, table.schema.types[k]))
    if is_feather:
        feather.write_feather(table, path)
    else:
        pq.write_table(table, path)


def truncate(path: Path, count: int = 40) -> None:
    """Cut the last bytes off a file."""
    path.write_bytes(path.read_bytes()[:-count])


def _pose_table(pose: np.ndarray) -> dict[str, Any]:
    q = quaternion_from_se3(pose)
    columns = {n: q[:, k] for k, n in enumerate(("qw", "qx", "qy", "qz"))}
    return columns | {n: pose[:, k, 3] for k, n in enumerate(("tx_m", "ty_m", "tz_m"))}


def _xyz(points: Any) -> list[dict[str, float]]:
    return [dict(zip("xyz", map(float, p), strict=True)) for p in points]


def av2_archive() -> dict[str, Any]:
    """A street along x with two lanes, one painted line shared by both, one crossing, an island.

    City coordinates; the road rises by 1 in 100 from z = 20 at x = 0.
    """

    def line(y: float, xs: Any) -> list[dict[str, float]]:
        return _xyz([(x, y, 20 + x / 100) for x in xs])

    forward, backward = [0, 10, 40], [40, 10, 0]
    empty = {"left_neighbor_id": None, "right_neighbor_id": None, "lane_type": "VEHICLE"}
    lanes = {
        "11": {
            "id": 11,
            "left_lane_boundary": line(0, forward),
            "left_lane_mark_type": "DOUBLE_SOLID_YELLOW",
            "right_lane_boundary": line(-3.5, forward),
            "right_lane_mark_type": "NONE",
            "successors": [13],
            "predecessors": [99],
            "is_intersection": False,
        },
        "12": {
            "id": 12,
            "left_lane_boundary": line(0, backward),
            "left_lane_mark_type": "DOUBLE_SOLID_YELLOW",
            "right_lane_boundary": line(3.5, backward),
            "right_lane_mark_type": "SOLID_WHITE",
            "successors": [],
            "predecessors": [],
            "is_intersection": False,
        },
        "13": {
            "id": 13,
            "left_lane_boundary": line(0, [40, 60]),
            "left_lane_mark_type": "DOUBLE_SOLID_YELLOW",
            "right_lane_boundary": line(-3.5, [40, 60]),
            "right_lane_mark_type": "UNKNOWN",
            "successors": [],
            "predecessors": [11],
            "is_intersection": False,
        },
    }
    ring = [(0, -4, 20), (60, -4, 20.6), (60, 4, 20.6), (0, 4, 20)]
    far = [(60, -4, 20.6), (80, -4, 20.8), (80, 4, 20.8), (60, 4, 20.6)]
    return {
        "pedestrian_crossings": {
            "7": {
                "id": 7,
                "edge1": _xyz([(50, -4, 20.5), (50, 4, 20.5)]),
                "edge2": _xyz([(53, -4, 20.53), (53, 4, 20.53)]),
            }
        },
        "lane_segments": {k: v | empty for k, v in lanes.items()},
        "drivable_areas": {
            "2": {"id": 2, "area_boundary": _xyz(far)},
            "1": {"id": 1, "area_boundary": _xyz(ring)},
        },
    }


def write_archive(folder: Path, archive: dict[str, Any], city: str = "PIT") -> Path:
    """Write a vector map into ``folder``/map as AV2 names it."""
    path = folder / "map" / f"log_map_archive_{folder.name}____{city}_city_1.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(archive))
    return path


def write_av2_log(folder: Path, images: bool = True) -> Path:
    """A 2 s drive along the street of ``av2_archive`` at 10 m/s: all the files of a sensor log."""
    folder.mkdir(parents=True)
    write_archive(folder, av2_archive())
    start = 315_966_253_000_000_000
    times = start + np.arange(0, 2_000_000_001, 10_000_000)
    x = (times - start) / 1e8
    pose = se3_from_xyyaw(x, -1.75, 0.0, 20.32 + x / 100)
    feather.write_feather(
        pa.table({"timestamp_ns": times} | _pose_table(pose)),
        folder / "city_SE3_egovehicle.feather",
    )
    _write_calibration(folder / "calibration")
    boxes = start + np.repeat(np.arange(0, 2_000_000_001, 100_000_000), 3)
    n = len(boxes)
    at = np.tile(
        se3_from_xyyaw(np.array([12.0, 8.0, 0.0]), np.array([3.5, -4, 0]), 0.1, 0.5), (n // 3, 1, 1)
    )
    kinds = ["REGULAR_VEHICLE", "BOLLARD", "EGO_VEHICLE"] * (n // 3)
    sizes = {"length_m": [4.5] * n, "width_m": [1.9] * n, "height_m": [1.6] * n}
    feather.write_feather(
        pa.table(
            {"timestamp_ns": boxes, "track_uuid": ["a", "b", "c"] * (n // 3), "category": kinds}
            | sizes
            | _pose_table(at)
            | {"num_interior_pts": [9] * n}
        ),
        folder / "annotations.feather",
    )
    _write_sweep(folder / "sensors" / "lidar" / f"{start + 500_000_000}.feather")
    _write_ground(folder / "map" / folder.name)
    for camera in ("ring_front_center", "ring_front_left") if images else ():
        shift = 0 if camera.endswith("center") else 12_000_000
        target = folder / "sensors" / "cameras" / camera
        target.mkdir(parents=True)
        for time in start + np.arange(0, 1_900_000_001, 50_000_000) + shift:
            (target / f"{time}.jpg").write_bytes(jpeg(120))
    return folder


def _write_calibration(folder: Path) -> None:
    folder.mkdir(parents=True)
    # As in real logs: not in the order in which a network sees them, LiDARs among the sensors.
    names = ["ring_front_left", "ring_front_center", "stereo_front_left"]
    pose = np.stack([se3_from_xyyaw(0, 0, a) @ FORWARD for a in (0.8, 0.0, 0.0, 0.0)])
    feather.write_feather(
        pa.table({"sensor_name": [*names, "up_lidar"]} | _pose_table(pose)),
        folder / "egovehicle_SE3_sensor.feather",
    )
    values = {"fx_px": 60.0, "fy_px": 60.0, "cx_px": 31.5, "cy_px": 23.5, "k1": -0.2}
    columns = {k: [v] * 3 for k, v in (values | {"k2": 0.0, "k3": 0.0}).items()}
    size = {
        "height_px": pa.array([48] * 3, pa.uint16()),
        "width_px": pa.array([64] * 3, pa.uint16()),
    }
    feather.write_feather(
        pa.table({"sensor_name": names} | columns | size), folder / "intrinsics.feather"
    )


def _write_sweep(path: Path) -> None:
    path.parent.mkdir(parents=True)
    xyz = np.array([[5, 1, -0.32], [70.04, 0, 1], [-3, 2, 0.5], [np.nan, 0, 0]], np.float16)
    columns = {n: pa.array(xyz[:, k]) for k, n in enumerate("xyz")}
    columns |= {
        "intensity": pa.array([0, 51, 255, 3], pa.uint8()),
        "laser_number": pa.array([1, 2, 3, 4], pa.uint8()),
        "offset_ns": pa.array([0, 10, 20, 30], pa.int32()),
    }
    feather.write_feather(pa.table(columns), path)


def _write_ground(stem: Path) -> None:
    """Heights 20 + x / 100 on a raster from (-10, -10), 0.5 m a cell; unknown for y > 8."""
    row, column = np.mgrid[0:41, 0:201]
    cells = 20 + (-10 + column * 0.5) / 100
    cells[-10 + row * 0.5 > 8] = np.nan
    np.save(f"{stem}_ground_height_surface____PIT.npy", cells.astype(np.float32))
    sim2 = {"R": [1.0, 0.0, 0.0, 1.0], "t": [10.0, 10.0], "s": 2.0}
    Path(f"{stem}___img_Sim2_city.json").write_text(json.dumps(sim2))
