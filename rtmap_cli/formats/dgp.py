"""DGP scenes (Toyota Research Institute's dataset format) as they lie on disk, by JSON alone.

``scene_dataset*.json`` names scenes; ``scene_*.json`` of a scene lists samples, and for every
image and sweep its file, time and pose; ``calibration/KEY.json`` holds intrinsics and extrinsics.
The pose of an image is world_SE3_camera, extrinsics included (docs/formats/dgp.md).
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.records import array, count_of, intrinsics_of, need, pose_of
from rtmap_cli.geometry.poses import invert, yaw_of
from rtmap_cli.logs.frames import POSE_SIGMA, FrameLog
from rtmap_cli.logs.log import Camera, Frame, Rig
from rtmap_cli.logs.native import paths_inside
from rtmap_cli.maps.crs import local_crs
from rtmap_cli.tables import read_json

Array = NDArray[np.float64]

GREGORIAN_CYCLE = timedelta(days=146_097)
"""400 years, after which dates and weekdays repeat."""
LAST_NS = 2**63 - 1
GROUND_SWEEPS = 5
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TIME = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?Z")
_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
_OTHER_LENSES = ("fov", "xi", "alpha", "beta", "s1", "s2", "s3", "s4", "taux", "tauy")


class DgpLog(FrameLog):
    """One DGP scene: ``dgp:DIR`` for its folder, ``dgp:DIR#SCENE`` for one of a data set.

    A frame stands at the time and pose of its LiDAR sweep (without one, of its first camera);
    images are moved to it by their own poses. Satisfies ``Log``.
    """

    def __init__(self, path: str | Path) -> None:
        self.folder, scene_file = _find_scene(Path(path))
        scene = read_json(scene_file)
        samples = need(scene, "samples", scene_file, "the scene")
        data = {
            str(need(d, "key", scene_file, "a datum")): d
            for d in need(scene, "data", scene_file, "the scene")
        }
        self._file = scene_file
        self._shift = timedelta(0)
        self._extrinsics: dict[str, Array] = {}
        self._sweeps: dict[int, Array] = {}
        rig: Rig | None = None
        frames: list[Frame] = []
        calibration = None
        for sample in samples:
            key = str(need(sample, "calibration_key", scene_file, "a sample"))
            found = {}
            for name in need(sample, "datum_keys", scene_file, "a sample"):
                datum = need(data, str(name), scene_file, "the list of data")
                found[_sensor(datum, scene_file)] = datum
            if calibration is None:
                calibration, rig = key, self._read_rig(key, found)
            if key != calibration:
                raise BadInput(scene_file, "its calibration changes within the scene", "split it")
            frames.append(self._frame(len(frames), found, rig))
        notes = ["poses are in the scene's own frame, without a place on earth"]
        if self._shift:
            notes.append("times lie beyond 2262, where 64-bit nanoseconds end: 400 years taken off")
        if rig is None:
            notes.append("no cameras")
        name = self.folder.resolve().name
        super().__init__(
            self.folder, name, local_crs(f"DGP scene {name}"), rig, frames, notes=notes
        )
        self.ground_z = self._ground_z()
        if not self._sweeps:
            self.notes.append("no LiDAR sweeps: the road is taken to lie at z = 0")

    def _ground_z(self) -> float:
        """Height of the road in the ego frame, which DGP does not state: the median over the first
        sweeps of low points on the road ahead and behind; 0 without LiDAR."""
        heights = []
        for frame in [f for f in self._frames if f.lidar][:GROUND_SWEEPS]:
            points = self.read_sweep(frame)
            if points is None:
                continue
            x, y, z = points[:, 0], points[:, 1], points[:, 2]
            road = (np.abs(x) > 4) & (np.abs(x) < 20) & (np.abs(y) < 2) & (np.abs(z) < 0.5)
            if road.sum() >= 20:
                heights.append(float(np.median(z[road])))
        return float(np.median(heights)) if heights else 0.0

    def read_sweep(self, frame: Frame) -> Array | None:
        """(n, 4) x, y, z (ego frame of the frame, metres) and intensity in [0, 1], or None."""
        if frame.lidar is None:
            return None
        points = _read_points(frame.lidar)
        pose = self._sweeps[frame.index]
        xyz = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        return np.column_stack([xyz, np.clip(points[:, 3], 0.0, 1.0)])

    def _read_rig(self, key: str, found: dict[str, Any]) -> Rig | None:
        """The cameras of a calibration that took an image in the first sample, front to rear."""
        path = paths_inside(self.folder, [f"calibration/{key}.json"], self._file)[0]
        content = read_json(path)
        names = need(content, "names", path, "the calibration")
        cameras = []
        for k, name in enumerate(names):
            try:
                extrinsic = content["extrinsics"][k]
                intrinsic = content["intrinsics"][k]
            except (KeyError, IndexError, TypeError):
                raise BadInput(path, f"has no extrinsics or intrinsics of {name}") from None
            self._extrinsics[name] = _pose(extrinsic, path, f"sensor {name}")
            image = found.get(name, {}).get("datum", {}).get("image")
            if image is not None:
                cameras.append(self._camera(name, image, intrinsic, path))
        cameras.sort(key=lambda c: _bearing(c.ego_SE3_camera))
        return Rig(tuple(cameras)) if cameras else None

    def _camera(self, name: str, image: Any, intrinsic: Any, path: Path) -> Camera:
        if not isinstance(intrinsic, dict):
            raise BadInput(path, f"the intrinsics of {name} are not an object")
        values = {k: intrinsic.get(k) or 0.0 for k in ("fx", "fy", "cx", "cy", "skew", *_RADIAL)}
        matrix = [
            [values["fx"], values["skew"], values["cx"]],
            [0.0, values["fy"], values["cy"]],
            [0.0, 0.0, 1.0],
        ]
        if other := [k for k in _OTHER_LENSES if intrinsic.get(k)]:
            raise BadInput(path, f"{name} has a lens that is not read ({', '.join(other)})")
        radial = array([values[k] for k in _RADIAL], (6,), path, f"the distortion of {name}")
        shift = [intrinsic.get(k) or 0.0 for k in ("p1", "p2")]
        tangential = array(shift, (2,), path, f"the distortion of {name}").tolist()
        return Camera(
            name=name,
            width=count_of(image.get("width"), self._file, f"the width of {name}"),
            height=count_of(image.get("height"), self._file, f"the height of {name}"),
            intrinsics=intrinsics_of(matrix, path, name),
            ego_SE3_camera=self._extrinsics[name],
            distortion=tuple(radial.tolist() if radial[3:].any() else radial[:3].tolist()),
            tangential=(tangential[0], tangential[1]),
        )

    def _frame(self, index: int, found: dict[str, Any], rig: Rig | None) -> Frame:
        """One sample; ``found`` are its data by the names of their sensors."""
        poses = {}
        for name, datum in found.items():
            record = _content(datum, self._file)
            if name not in self._extrinsics:
                raise BadInput(self._file, f"sensor {name} is not in the calibration")
            world_SE3_sensor = _pose(record.get("pose"), self._file, f"{name} of sample {index}")
            poses[name] = world_SE3_sensor @ invert(self._extrinsics[name])
        sweeps = [n for n, d in found.items() if "point_cloud" in d["datum"]]
        cameras = [c.name for c in rig or () if c.name in found]
        if not poses:
            raise BadInput(self._file, f"sample {index} has no data")
        first = (sweeps + cameras + sorted(found))[0]
        here = poses[first]
        if sweeps:
            self._sweeps[index] = self._extrinsics[first]
        files = {
            n: paths_inside(
                self.folder, [str(_content(found[n], self._file).get("filename"))], self._file
            )[0]
            for n in (*cameras, *sweeps[:1])
        }
        return Frame(
            index=index,
            timestamp_ns=self._time(found[first]),
            map_SE3_ego=here,
            sigma=POSE_SIGMA.copy(),
            images={n: files[n] for n in cameras},
            lidar=files[first] if sweeps else None,
            ego_SE3_exposure={n: invert(here) @ poses[n] for n in cameras},
            image_time_ns={n: self._time(found[n]) for n in cameras},
        )

    def _time(self, datum: Any) -> int:
        """Nanoseconds since 1970; times that do not fit are moved by whole Gregorian cycles."""
        text = str(
            need(need(datum, "id", self._file, "a datum"), "timestamp", self._file, "a datum")
        )
        found = _TIME.fullmatch(text)
        if not found:
            raise BadInput(self._file, f"{text!r} is not a time as 2018-07-24T11:22:45.123456Z")
        try:
            moment = datetime.fromisoformat(found.group(1)).replace(tzinfo=UTC) - _EPOCH
        except ValueError:
            raise BadInput(self._file, f"{text!r} is not a time") from None
        fraction = int((found.group(2) or "").ljust(9, "0"))

        def nanoseconds() -> int:
            seconds = round((moment - self._shift) / timedelta(seconds=1))
            return seconds * 1_000_000_000 + fraction

        while nanoseconds() > LAST_NS:
            self._shift += GREGORIAN_CYCLE
        return nanoseconds()


def _find_scene(path: Path) -> tuple[Path, Path]:
    """Folder and scene file of DIR, or of DIR#SCENE where DIR is a data set."""
    folder, name = path, None
    if not path.is_dir() and "#" in str(path):
        text, _, name = str(path).rpartition("#")
        folder = Path(text)
    if not folder.is_dir():
        raise BadInput(folder, "no such folder")
    own = sorted(p for p in folder.glob("scene_*.json") if not p.name.startswith("scene_dataset"))
    if own and name is None:
        if len(own) > 1:
            raise BadInput(folder, f"holds {len(own)} scene files", "keep one")
        return folder, own[0]
    scenes = dgp_scenes(folder)
    known = ", ".join(sorted(scenes)[:10]) or "none"
    if name is None and len(scenes) == 1:
        name = next(iter(scenes))
    if name is None:
        raise BadInput(folder, f"holds the scenes {known}", f"choose one: dgp:{folder}#SCENE")
    if name not in scenes:
        raise BadInput(folder, f"has no scene {name} (it has {known})")
    return scenes[name].parent, scenes[name]


def dgp_scenes(folder: Path) -> dict[str, Path]:
    """Scene files of a data set by the names of their folders; those that are not there are left
    out. BadInput when there is no ``scene_dataset*.json``."""
    files = sorted(folder.glob("scene_dataset*.json"))
    if not files:
        raise BadInput(folder, "no scene_dataset*.json and no scene_*.json in it")
    out = {}
    for path in files:
        splits = need(read_json(path), "scene_splits", path, "the data set")
        if not isinstance(splits, dict):
            raise BadInput(path, "scene_splits is not an object")
        names = [str(n) for split in splits.values() for n in split.get("filenames", ())]
        for file in paths_inside(folder, names, path):
            if file.exists():
                out[file.parent.name] = file
    return out


def _content(datum: Any, path: Path) -> dict[str, Any]:
    """The image or point cloud of a datum."""
    kinds = need(datum, "datum", path, "a datum")
    for kind in ("image", "point_cloud"):
        if isinstance(kinds, dict) and isinstance(kinds.get(kind), dict):
            record: dict[str, Any] = kinds[kind]
            return record
    raise BadInput(path, "a datum is neither an image nor a point cloud")


def _sensor(datum: Any, path: Path) -> str:
    return str(need(need(datum, "id", path, "a datum"), "name", path, "the id of a datum"))


def _pose(record: Any, path: Path, what: str) -> Array:
    """(4, 4) of {rotation: {qw …}, translation: {x …}}."""
    rotation = need(record, "rotation", path, f"the pose of {what}")
    translation = need(record, "translation", path, f"the pose of {what}")
    q = [need(rotation, k, path, what) for k in ("qw", "qx", "qy", "qz")]
    t = [need(translation, k, path, what) for k in "xyz"]
    return pose_of(q, t, path, what)


def _bearing(ego_SE3_camera: Array) -> tuple[float, float]:
    """Sorts cameras front to rear, the left one of a pair first."""
    forward = np.eye(4)
    forward[:3, 0] = ego_SE3_camera[:3, 2]
    angle = float(yaw_of(forward))
    return round(abs(angle), 1), -angle


def _read_points(path: Path) -> Array:
    """(n, 4) x, y, z in the sensor's frame and intensity of one ``.npz``; never unpickled."""
    if not path.exists():
        raise BadInput(path, "no such sweep")
    try:
        with np.load(path, allow_pickle=False) as content:
            points = np.asarray(content["data"], np.float64)
    except Exception as error:  # zipfile, zlib and numpy raise their own kinds
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise BadInput(path, f"cannot be read as a sweep ({text})", "copy it again") from None
    if points.ndim != 2 or points.shape[1] < 4:
        raise BadInput(path, "is not x, y, z, intensity per point")
    return points[np.isfinite(points[:, :4]).all(axis=1), :4]
