"""nuScenes v1.0 folders as they lie on disk, by JSON alone: one log per scene.

Frames are the keyframes (2 Hz), at the time and pose of the LiDAR; every image is moved to it by
its own ego pose. Poses lie in the map frame of the scene's location (docs/formats/nuscenes.md).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.nuscenes.info import CAMERAS, NuscenesInfoLog, flat
from rtmap_cli.formats.nuscenes.sweep import read_sweep_file
from rtmap_cli.formats.nuscenes.tables import Record, Tables, location_crs, read_tables
from rtmap_cli.formats.records import count_of, intrinsics_of, pose_of
from rtmap_cli.geometry.poses import invert
from rtmap_cli.logs.frames import POSE_SIGMA, FrameLog
from rtmap_cli.logs.log import Camera, Frame, Rig
from rtmap_cli.logs.native import paths_inside

Array = NDArray[np.float64]

LIDAR = "LIDAR_TOP"


def open_nuscenes(path: str | Path) -> FrameLog:
    """``DIR`` or ``DIR#scene-0001`` of a nuScenes folder, or an info file (``.pkl``)."""
    path = Path(path)
    return NuscenesInfoLog(path) if path.suffix == ".pkl" else NuscenesLog(path)


def nuscenes_scenes(folder: str | Path) -> list[str]:
    """Names of the scenes of a nuScenes folder, sorted."""
    return sorted(read_tables(Path(folder)).scenes())


class NuscenesLog(FrameLog):
    """One scene of a nuScenes folder; satisfies ``Log``.

    ``path`` is DIR#SCENE (or ``scene`` names it; a folder with one scene needs neither), DIR
    holding ``v1.0-*`` or being it. ``location`` is the name of its map.
    """

    def __init__(self, path: str | Path, scene: str | None = None) -> None:
        folder = Path(path)
        if scene is None and not folder.is_dir() and "#" in str(path):
            text, _, scene = str(path).rpartition("#")
            folder = Path(text)
        self._tables = tables = read_tables(folder)
        record = _scene(tables, folder, scene)
        log = tables.get("log", tables.field("scene", record, "log_token"))
        self.location = str(tables.field("log", log, "location"))
        self._sweeps: dict[int, Array] = {}
        self._rig: dict[str, tuple[str, Camera]] = {}
        samples = tables.samples_of(record)
        data = [tables.data_of(sample) for sample in samples]
        for channel in CAMERAS:
            first = next((d[channel] for d in data if channel in d), None)
            if first is not None:
                self._rig[channel] = self._camera(channel, first)
        frames = [self._frame(k, d) for k, d in enumerate(data)]
        rig = Rig(tuple(c for _, c in self._rig.values())) if self._rig else None
        notes = []
        if rig is None:
            notes.append("no cameras: the log has no rig")
        if not any(f.lidar for f in frames):
            notes.append("no LiDAR sweeps")
        crs = location_crs(self.location)
        super().__init__(folder, str(record["name"]), crs, rig, frames, notes=notes)

    def read_sweep(self, frame: Frame) -> Array | None:
        """(n, 4) x, y, z (ego frame of the frame, metres) and intensity in [0, 1], or None."""
        if frame.lidar is None:
            return None
        return read_sweep_file(frame.lidar, self._sweeps[frame.index])

    def _frame(self, index: int, data: dict[str, Record]) -> Frame:
        tables = self._tables
        lead = next((c for c in (LIDAR, *CAMERAS) if c in data), None)
        if lead is None:
            raise BadInput(
                tables.path("sample_data"), f"keyframe {index} has no image and no sweep"
            )
        here = self._pose(data[lead])
        if LIDAR in data:
            self._sweeps[index] = self._extrinsics(data[LIDAR])
        images, motion, times = {}, {}, {}
        for channel, (calibration, _) in self._rig.items():
            record = data.get(channel)
            if record is None:
                continue
            if record["calibrated_sensor_token"] != calibration:
                raise BadInput(
                    tables.path("sample_data"), f"the calibration of {channel} changes in the scene"
                )
            images[channel] = self._file(record)
            motion[channel] = invert(here) @ self._pose(record)
            times[channel] = self._microseconds(record) * 1000
        return Frame(
            index=index,
            timestamp_ns=self._microseconds(data[lead]) * 1000,
            map_SE3_ego=flat(here),
            sigma=POSE_SIGMA.copy(),
            images=images,
            lidar=self._file(data[LIDAR]) if LIDAR in data else None,
            ego_SE3_exposure=motion,
            image_time_ns=times,
        )

    def _camera(self, channel: str, record: Record) -> tuple[str, Camera]:
        """The token of a calibration and its camera."""
        tables = self._tables
        token = str(record["calibrated_sensor_token"])
        path = tables.path("calibrated_sensor")
        matrix = tables.field(
            "calibrated_sensor", tables.get("calibrated_sensor", token), "camera_intrinsic"
        )
        width, height = (
            count_of(record.get(k), tables.path("sample_data"), f"the {k} of {channel}")
            for k in ("width", "height")
        )
        intrinsics = intrinsics_of(matrix, path, channel)
        return token, Camera(channel, width, height, intrinsics, self._extrinsics(record))

    def _extrinsics(self, record: Record) -> Array:
        """ego_SE3_sensor of a datum."""
        token = record["calibrated_sensor_token"]
        return self._transform("calibrated_sensor", self._tables.get("calibrated_sensor", token))

    def _pose(self, record: Record) -> Array:
        """map_SE3_ego at the time of a datum."""
        token = self._tables.field("sample_data", record, "ego_pose_token")
        return self._transform("ego_pose", self._tables.get("ego_pose", token))

    def _transform(self, table: str, record: Record) -> Array:
        rotation, translation = (
            self._tables.field(table, record, key) for key in ("rotation", "translation")
        )
        path = self._tables.path(table)
        return pose_of(rotation, translation, path, f"record {record['token']}")

    def _file(self, record: Record) -> Path:
        name = str(self._tables.field("sample_data", record, "filename"))
        return paths_inside(self._tables.root, [name], self._tables.path("sample_data"))[0]

    def _microseconds(self, record: Record) -> int:
        time: Any = self._tables.field("sample_data", record, "timestamp")
        return count_of(time, self._tables.path("sample_data"), "a timestamp")


def _scene(tables: Tables, folder: Path, name: str | None) -> Record:
    """The scene of that name, or the only one; BadInput lists the first ones."""
    scenes = tables.scenes()
    known = ", ".join(sorted(scenes)[:5]) + (f" … ({len(scenes)})" if len(scenes) > 5 else "")
    if name is None and len(scenes) == 1:
        return next(iter(scenes.values()))
    if name is None:
        raise BadInput(folder, f"holds the scenes {known}", f"choose one: nuscenes:{folder}#SCENE")
    if name not in scenes:
        raise BadInput(folder, f"has no scene {name} (it has {known})")
    return scenes[name]
