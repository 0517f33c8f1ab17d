"""Names everything that is wrong with an Argoverse 2 sensor log (docs/check-log.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.av2.files import (
    POSES_FILE,
    RING_CAMERAS,
    find_city,
    read_cuboids,
    read_poses_raw,
    read_rig,
    read_sweep,
    timed_files,
)
from rtmap_cli.formats.av2.ground import read_ground
from rtmap_cli.formats.av2.log import GROUND_Z
from rtmap_cli.formats.av2.vector_map import read_av2_archive, vector_map_of
from rtmap_cli.logs.check_parts import (
    Limited,
    Report,
    check_camera,
    check_image,
    check_trajectory,
)
from rtmap_cli.logs.log import Rig
from rtmap_cli.maps.crs import city_crs

Array = NDArray[np.float64]
Times = NDArray[np.int64]


def check_av2(folder: Path, fast: bool = False) -> Report:
    """Check every file of an Argoverse 2 sensor log; ``fast`` does not decode images.

    BadInput only when there is no log at all. References to lanes outside the clipped map and
    unknown heights are usual and no finding.
    """
    report = Report(folder)
    if not folder.is_dir():
        raise BadInput(folder, "no such log folder")
    times, poses = _check_poses(report)
    rig = _check_rig(report)
    _check_images(report, rig, times, fast)
    _check_annotations(report, times)
    _check_sweeps(report, times)
    _check_map(report, times, poses)
    return report


def _check_poses(report: Report) -> tuple[Times | None, Array | None]:
    path = report.folder / POSES_FILE
    raw = report.attempt(lambda: read_poses_raw(report.folder))
    if raw is None:
        return None, None
    times, quaternion, position = raw
    if not len(times):
        report.error(path, "holds no pose")
        return None, None
    return times, check_trajectory(report, path, times, quaternion, position)


def _check_rig(report: Report) -> Rig | None:
    folder = report.folder / "calibration"
    found = len(report.findings)
    rig = report.attempt(lambda: read_rig(report.folder))
    if rig is None and len(report.findings) == found:
        report.warning(folder, "no calibration of ring cameras: the log has no rig")
    for camera in rig or ():
        check_camera(report, folder / "intrinsics.feather", camera)
    return rig


def _check_images(report: Report, rig: Rig | None, times: Times | None, fast: bool) -> None:
    folder = report.folder / "sensors" / "cameras"
    present = {name: timed_files(folder / name, ".jpg") for name in RING_CAMERAS}
    if not any(present.values()):
        report.warning(folder, "no images of ring cameras: infer has nothing to read")
        return
    cameras = {c.name: c for c in rig or ()}
    limited = Limited(report)
    for name, files in present.items():
        if name in cameras and not files:
            report.warning(folder / name, "no images of this camera")
        if files and rig is not None and name not in cameras:
            report.error(folder / name, "images of a camera without calibration")
        for path in files.values():
            found = check_image(path, cameras.get(name), fast)
            if found is not None:
                limited.add(found[0], "error", path, found[1], found[2])
        _check_times(report, folder / name, np.array(list(files), np.int64), times, "images")
    limited.close(folder)


def _check_annotations(report: Report, times: Times | None) -> None:
    before = len(report.findings)
    cuboids = report.attempt(lambda: read_cuboids(report.folder))
    path = report.folder / "annotations.feather"
    if cuboids is None:
        if len(report.findings) == before:
            report.warning(path, "no annotations: nothing is known of occluders")
        return
    report.rows(path, ~(cuboids.size > 0).all(axis=1), "cuboids without size")
    _check_times(report, path, np.unique(cuboids.timestamp_ns), times, "annotated moments")


def _check_sweeps(report: Report, times: Times | None) -> None:
    files = timed_files(report.folder / "sensors" / "lidar", ".feather")
    for path in files.values():
        try:
            if not len(read_sweep(path).xyz):
                report.error(path, "holds no point")
        except BadInput as error:
            report.bad(error)
    _check_times(
        report,
        report.folder / "sensors" / "lidar",
        np.array(list(files), np.int64),
        times,
        "sweeps",
    )


def _check_map(report: Report, times: Times | None, poses: Array | None) -> None:
    """Vector map and raster, and whether the vehicle drives on them."""
    folder = report.folder / "map"
    before = len(report.findings)
    city = report.attempt(lambda: find_city(report.folder))
    if city is None:
        if len(report.findings) == before:
            report.error(folder, "no map file names the city", "keep the map folder of the log")
        return
    if not list(folder.glob("log_map_archive_*.json")):
        report.warning(folder, "no vector map: import av2 has nothing to read")
    else:
        archive = report.attempt(lambda: read_av2_archive(report.folder))
        if archive is not None and not len(vector_map_of(archive)):
            report.warning(archive.path, "holds no crossing, painted line or drivable area")
    origin = city_crs(city)[1]
    ground = report.attempt(lambda: read_ground(report.folder, origin))
    if ground is None or poses is None:
        return
    height = ground.at(poses[:, :2, 3] + origin) - poses[:, 2, 3]
    if np.isnan(height).all():
        report.error(folder, "the poses lie outside the ground raster", "is it of this log?")
    elif abs(np.nanmedian(height) - GROUND_Z) > 1.0:
        report.warning(
            folder,
            f"the ground lies {np.nanmedian(height):.2f} m above the ego origin "
            f"(usual: {GROUND_Z})",
        )


def _check_times(report: Report, path: Path, found: Times, times: Times | None, what: str) -> None:
    if times is None or not len(found):
        return
    outside = (found < times.min()) | (found > times.max())
    if outside.all():
        report.error(path, f"all {what} lie outside the time of the poses", "is it of this log?")
    elif outside.any():
        report.warning(path, f"{outside.sum()} {what} lie outside the time of the poses")
