"""A nuScenes folder of a few kilobytes, written anew: two scenes, three cameras, LiDAR, a map."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from sample_logs import FORWARD, jpeg

from rtmap_cli.geometry.poses import invert, quaternion_from_se3, se3_from_xyyaw

CHANNELS = ("CAM_BACK", "CAM_FRONT", "CAM_FRONT_LEFT", "LIDAR_TOP")
YAW = {"CAM_FRONT": 0.0, "CAM_FRONT_LEFT": 0.9, "CAM_BACK": np.pi}
EARLY = {"CAM_FRONT": 40_000, "CAM_FRONT_LEFT": 30_000, "CAM_BACK": 10_000, "LIDAR_TOP": 0}
"""µs before the LiDAR at which a camera exposes."""
K = [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]
EGO_SE3_LIDAR = se3_from_xyyaw(0.9, 0.0, -np.pi / 2, 1.8)
SPEED = 10.0
START = (400.0, 1100.0)
T0 = 1_532_402_927_000_000
POINTS = np.array([[0.0, 8.0, -1.8, 51.0, 3.0], [2.0, 4.0, -1.7, 255.0, 4.0]], np.float32)


def pose_at(scene: int, microseconds: int) -> np.ndarray:
    """map_SE3_ego of a straight drive at 10 m/s; scene 1 runs 50 m beside scene 0."""
    yaw = 0.3
    driven = SPEED * microseconds / 1e6
    x, y = START[0] + driven * np.cos(yaw), START[1] + driven * np.sin(yaw) + 50 * scene
    return se3_from_xyyaw(x, y, yaw)


def camera_pose(channel: str) -> np.ndarray:
    """ego_SE3_camera of a channel."""
    return se3_from_xyyaw(0.0, 0.0, YAW[channel]) @ FORWARD


def _record(pose: np.ndarray) -> dict[str, Any]:
    return {"rotation": quaternion_from_se3(pose).tolist(), "translation": pose[:3, 3].tolist()}


def write_nuscenes(root: Path, frames: int = 3, location: str = "singapore-onenorth") -> Path:
    """Scenes scene-0001 and scene-0002 at 2 Hz; sweeps and poses between the keyframes too."""
    tables: dict[str, list[dict[str, Any]]] = {
        "log": [{"token": "log-a", "logfile": "x", "vehicle": "v", "location": location}],
        "sensor": [{"token": f"s-{c}", "channel": c, "modality": "x"} for c in CHANNELS],
        "calibrated_sensor": [
            {"token": f"c-{c}", "sensor_token": f"s-{c}"}
            | _record(EGO_SE3_LIDAR if c == "LIDAR_TOP" else camera_pose(c))
            | {"camera_intrinsic": [] if c == "LIDAR_TOP" else K}
            for c in CHANNELS
        ],
        "scene": [],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "map": [{"token": "m", "log_tokens": ["log-a"], "filename": "maps/m.png"}],
    }
    for s in range(2):
        name = f"scene-000{s + 1}"
        samples = [f"{name}-{k}" for k in range(frames)]
        tables["scene"].append(
            {"token": name, "name": name, "log_token": "log-a", "nbr_samples": frames}
            | {"first_sample_token": samples[0], "last_sample_token": samples[-1]}
        )
        # Listed backwards: only their times order samples.
        for k in reversed(range(frames)):
            time = T0 + s * 10**8 + 500_000 * k
            tables["sample"].append({"token": samples[k], "timestamp": time, "scene_token": name})
            for channel in CHANNELS:
                _add(tables, root, channel, samples[k], s, k * 500_000 - EARLY[channel], True)
            _add(tables, root, "CAM_FRONT", samples[k], s, k * 500_000 + 60_000, False)
    folder = root / "v1.0-mini"
    folder.mkdir(parents=True)
    for table, records in tables.items():
        (folder / f"{table}.json").write_text(json.dumps(records))
    write_expansion(root / "maps" / "expansion" / f"{location}.json")
    return root


def _add(
    tables: dict[str, Any], root: Path, channel: str, sample: str, scene: int, at: int, key: bool
) -> None:
    time = T0 + scene * 10**8 + at
    token = f"d-{channel}-{time}"
    camera = channel != "LIDAR_TOP"
    name = f"{'samples' if key else 'sweeps'}/{channel}/{time}.{'jpg' if camera else 'pcd.bin'}"
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(jpeg(120) if camera else POINTS.tobytes())
    tables["ego_pose"].append({"token": token, "timestamp": time} | _record(pose_at(scene, at)))
    tables["sample_data"].append(
        {"token": token, "sample_token": sample, "ego_pose_token": token, "timestamp": time}
        | {"calibrated_sensor_token": f"c-{channel}", "filename": name, "is_key_frame": key}
        | {"width": 64 if camera else 0, "height": 48 if camera else 0}
    )


class _Geometry:
    """Collects nodes, lines and polygons of a map expansion."""

    def __init__(self) -> None:
        self.tables: dict[str, list[dict[str, Any]]] = {"node": [], "line": [], "polygon": []}

    def nodes(self, points: Any) -> list[str]:
        out = []
        for x, y in points:
            token = f"n{len(self.tables['node'])}"
            self.tables["node"].append({"token": token, "x": float(x), "y": float(y)})
            out.append(token)
        return out

    def line(self, points: Any) -> str:
        token = f"l{len(self.tables['line'])}"
        self.tables["line"].append({"token": token, "node_tokens": self.nodes(points)})
        return token

    def box(self, x0: float, y0: float, x1: float, y1: float, hole: Any = None) -> str:
        token = f"p{len(self.tables['polygon'])}"
        outside = self.nodes([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        holes = [] if hole is None else [{"node_tokens": self.nodes(hole)}]
        self.tables["polygon"].append(
            {"token": token, "exterior_node_tokens": outside, "holes": holes}
        )
        return token


def write_expansion(path: Path) -> None:
    """A street 400 ≤ x ≤ 500 with an island, a lane that widens it, two crossings that touch and
    one apart, a lane divider that comes twice and a road divider."""
    g = _Geometry()
    island = [(440, 1096), (450, 1096), (450, 1098), (440, 1098)]
    street = g.box(400, 1090, 500, 1104, island)
    lane = g.box(460, 1100, 500, 1108)
    layers: dict[str, Any] = {
        "road_segment": [{"token": "road-b", "polygon_token": street}],
        "lane": [{"token": "lane-a", "polygon_token": lane, "lane_type": "CAR"}],
        "ped_crossing": [
            {"token": "cross-b", "polygon_token": g.box(410, 1090, 414, 1097)},
            {"token": "cross-a", "polygon_token": g.box(410, 1097, 414, 1104)},
            {"token": "cross-c", "polygon_token": g.box(480, 1090, 484, 1108)},
        ],
        "lane_divider": [
            {"token": t, "line_token": g.line(points), "lane_divider_segments": marks}
            for t, points, marks in (
                ("ld-a", [(400, 1094), (440, 1094), (500, 1094)], [{"segment_type": "DASHED"}]),
                ("ld-b", [(500, 1094), (440, 1094), (400, 1094)], []),
                ("ld-c", [(400, 1100), (400, 1100)], []),
            )
        ],
        "road_divider": [{"token": "rd-a", "line_token": g.line([(400, 1097), (440, 1097)])}],
        "drivable_area": [{"token": "da", "polygon_tokens": [street]}],
        "walkway": [{"token": "w", "polygon_token": lane}],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"version": "1.3"} | layers | g.tables))


def write_info(root: Path, **changes: Any) -> Path:
    """An info file of one keyframe with its images beside it; ``changes`` replace its keys."""
    root.mkdir(parents=True, exist_ok=True)
    here = pose_at(0, 0)
    images = {}
    for channel in CHANNELS[:3]:
        (root / f"{channel}.jpg").write_bytes(jpeg(90))
        there = pose_at(0, -EARLY[channel])
        camera_SE3_ego = invert(camera_pose(channel)) @ invert(there) @ here
        images[channel] = {
            "img_path": f"{channel}.jpg",
            "cam2img": K,
            "cam2ego": camera_pose(channel).tolist(),
            "lidar2cam": (camera_SE3_ego @ EGO_SE3_LIDAR).tolist(),
            "timestamp": (T0 - EARLY[channel]) / 1e6,
        }
    (root / "sweep.pcd.bin").write_bytes(POINTS.tobytes())
    sample = {
        "token": "a",
        "timestamp": T0 / 1e6,
        "ego2global": here,
        "images": images,
        "lidar_points": {
            "lidar_path": "sweep.pcd.bin",
            "num_pts_feats": np.int64(5),
            "lidar2ego": EGO_SE3_LIDAR.astype(np.float32),
        },
        "instances": [{"bbox_3d": (1.0, 2.0), "velocity": [np.nan, 0.0]}],
    } | changes
    path = root / "info.pkl"
    path.write_bytes(pickle.dumps({"metainfo": {}, "data_list": [sample]}))
    return path
