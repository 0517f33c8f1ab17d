"""Info files of mmdetection3d for nuScenes (``.pkl``, format 1.1): keyframes beside their images.

Such a file knows calibration, images and LiDAR of single keyframes, but neither scenes nor the name
of the map: poses lie in a frame without a place on earth (docs/formats/nuscenes.md).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.nuscenes.sweep import read_sweep_file
from rtmap_cli.formats.pickles import read_plain_pickle
from rtmap_cli.formats.records import array, intrinsics_of, matrix_of, need
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, yaw_of
from rtmap_cli.logs.frames import POSE_SIGMA, FrameLog
from rtmap_cli.logs.log import Camera, Frame, Rig
from rtmap_cli.logs.native import paths_inside
from rtmap_cli.maps.crs import local_crs

Array = NDArray[np.float64]

CAMERAS = (
    "CAM_FRONT",
    "CAM_FRONT_LEFT",
    "CAM_FRONT_RIGHT",
    "CAM_BACK_LEFT",
    "CAM_BACK_RIGHT",
    "CAM_BACK",
)
"""The six cameras, front to rear: the order in which a network sees them."""


def flat(map_SE3_ego: Array) -> Array:
    """A pose (4, 4) of nuScenes without its tilt.

    nuScenes localizes in the plane: heights are 0 everywhere while roll and pitch follow the road.
    Together they would tell of a level road under a tilted vehicle, which is wrong.
    """
    return se3_from_xyyaw(map_SE3_ego[0, 3], map_SE3_ego[1, 3], yaw_of(map_SE3_ego))


class NuscenesInfoLog(FrameLog):
    """The keyframes of one info file as a log; satisfies ``Log``.

    The ego frame stands at the LiDAR's time; images are moved to it by what ``lidar2cam`` knows of
    the vehicle's motion between both exposures. Image files are looked for beside the info file
    and, as in the data set, in ``samples/CAMERA`` there.
    """

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        content = read_plain_pickle(path)
        samples = content.get("data_list") if isinstance(content, dict) else None
        if not isinstance(samples, list) or not samples:
            raise BadInput(path, "not an info file of nuScenes keyframes (no data_list)")
        self._sweeps: dict[int, tuple[int, Array]] = {}
        ordered = sorted(
            samples,
            key=lambda s: float(array(need(s, "timestamp", path, "a sample"), (), path, "time")),
        )
        rig = _rig(path, ordered[0])
        frames = [self._frame(path, k, sample, rig) for k, sample in enumerate(ordered)]
        notes = ["an info file names no map: poses are in a frame without a place on earth"]
        if not any(f.images for f in frames):
            notes.append("no images")
        if not any(f.lidar for f in frames):
            notes.append("no LiDAR sweeps")
        crs = local_crs("nuScenes map frame, map unknown")
        super().__init__(path, path.stem, crs, rig, frames, notes=notes)

    def read_sweep(self, frame: Frame) -> Array | None:
        """(n, 4) x, y, z (ego frame of the frame, metres) and intensity in [0, 1], or None."""
        if frame.lidar is None:
            return None
        features, ego_SE3_lidar = self._sweeps[frame.index]
        return read_sweep_file(frame.lidar, ego_SE3_lidar, features)

    def _frame(self, path: Path, index: int, sample: Any, rig: Rig | None) -> Frame:
        what = f"sample {index}"
        lidar = need(sample, "lidar_points", path, what)
        ego_SE3_lidar = matrix_of(need(lidar, "lidar2ego", path, what), path, "lidar2ego")
        sweep = _file(path, str(need(lidar, "lidar_path", path, what)), "LIDAR_TOP")
        self._sweeps[index] = (int(lidar.get("num_pts_feats") or 5), ego_SE3_lidar)
        images, motion, times = {}, {}, {}
        for camera in rig or ():
            record = sample.get("images", {}).get(camera.name)
            if record is None or not record.get("img_path"):
                continue
            _check_same_camera(path, what, record, camera)
            images[camera.name] = _image(path, str(record["img_path"]), camera.name)
            if "lidar2cam" in record:
                camera_SE3_lidar = matrix_of(record["lidar2cam"], path, f"lidar2cam of {what}")
                exposure_SE3_ego = camera.ego_SE3_camera @ camera_SE3_lidar @ invert(ego_SE3_lidar)
                motion[camera.name] = invert(exposure_SE3_ego)
            if "timestamp" in record:
                exposed = array(record["timestamp"], (), path, f"a timestamp of {what}")
                times[camera.name] = round(float(exposed) * 1e6) * 1000
        seconds = float(array(sample["timestamp"], (), path, f"the timestamp of {what}"))
        return Frame(
            index=index,
            timestamp_ns=round(seconds * 1e6) * 1000,
            map_SE3_ego=flat(matrix_of(need(sample, "ego2global", path, what), path, "ego2global")),
            sigma=POSE_SIGMA.copy(),
            images=images,
            lidar=sweep,
            ego_SE3_exposure=motion,
            image_time_ns=times,
        )


def _rig(path: Path, sample: Any) -> Rig | None:
    """The cameras of the first keyframe; sizes are those of its image files."""
    from PIL import Image

    records = need(sample, "images", path, "sample 0")
    cameras = []
    for name in CAMERAS:
        if name not in records:
            continue
        record, what = records[name], f"{name} of sample 0"
        pose = matrix_of(need(record, "cam2ego", path, what), path, f"cam2ego of {what}")
        intrinsics = intrinsics_of(need(record, "cam2img", path, what), path, what)
        file = _image(path, str(need(record, "img_path", path, what)), name)
        try:
            with Image.open(file) as image:
                width, height = image.size
        except OSError as error:
            text = "no such image" if not file.exists() else f"cannot be read as an image ({error})"
            raise BadInput(file, text, "put the images beside the info file") from None
        cameras.append(Camera(name, width, height, intrinsics, pose))
    return Rig(tuple(cameras)) if cameras else None


def _check_same_camera(path: Path, what: str, record: Any, camera: Camera) -> None:
    """One log has one rig: a keyframe of another vehicle is refused."""
    where = f"{camera.name} of {what}"
    pose = matrix_of(need(record, "cam2ego", path, where), path, f"cam2ego of {where}")
    intrinsics = intrinsics_of(need(record, "cam2img", path, where), path, where)
    if not (
        np.allclose(pose, camera.ego_SE3_camera, atol=1e-3)
        and np.allclose(intrinsics, camera.intrinsics, atol=0.1)
    ):
        raise BadInput(path, f"{where} has another calibration than that of sample 0", "split it")


def _image(path: Path, name: str, camera: str) -> Path:
    """Where an image is, or where it should be."""
    return _file(path, name, camera) or paths_inside(path.parent, [name], path)[0]


def _file(path: Path, name: str, channel: str) -> Path | None:
    """A file beside the info file, or in samples/CHANNEL there; None when it is in neither."""
    candidates = paths_inside(path.parent, [name, f"samples/{channel}/{name}"], path)
    return next((file for file in candidates if file.exists()), None)
