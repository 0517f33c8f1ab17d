"""Names everything that is wrong with a native log folder (docs/check-log.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.check_parts import (
    SHOWN,
    Limited,
    Report,
    check_camera,
    check_image,
    check_place,
    check_trajectory,
)
from rtmap_cli.logs.log import Camera, Rig
from rtmap_cli.logs.native import paths_inside, read_log_info
from rtmap_cli.logs.run_files import OCCLUDERS, read_poses
from rtmap_cli.logs.tables import (
    FRAMES,
    IMAGES,
    LIDAR,
    ODOMETRY,
    ODOMETRY_SIGMA,
    POSE,
    RIG,
    SIGMAS,
    SWEEP,
    load,
    numbers,
    rig_of_table,
)
from rtmap_cli.maps.crs import check_log_crs
from rtmap_cli.tables import TableSchema, read_json


def check_native(folder: Path, fast: bool = False) -> Report:
    """Check every file of a native log; ``fast`` does not decode images.

    BadInput only when there is no log at all; everything else is a finding.
    """
    report = Report(folder)
    if not (folder / "log.json").exists():
        raise BadInput(folder, "not a log (log.json is missing)", "see docs/log-format.md")
    crs = _check_info(report)
    rig = _check_rig(report)
    frames = _table(report, "frames.parquet", FRAMES, (*POSE, *SIGMAS, *ODOMETRY, *ODOMETRY_SIGMA))
    times = _check_frames(report, frames, crs) if frames is not None else None
    _check_images(report, rig, times, fast)
    _check_lidar(report, times)
    _check_masks(report, rig, fast)
    _check_occluders(report, times)
    _check_truth(report, times)
    return report


def _table(
    report: Report, name: str, schema: TableSchema, may_be_null: tuple[str, ...] = ()
) -> pa.Table | None:
    return report.attempt(lambda: load(report.folder / name, schema, may_be_null))


def _check_info(report: Report) -> str | None:
    """log.json; the CRS when it can carry the poses."""
    info = report.attempt(lambda: read_log_info(report.folder))
    if info is None:
        return None
    path = report.folder / "log.json"
    if not str(info["log_id"]).strip():
        report.error(path, "log_id is empty", "give the drive a name")
    if abs(info["ground_z"]) > 3:
        report.warning(
            path, f"the road lies {info['ground_z']:g} m above the ego origin", "is ground_z right?"
        )
    return report.attempt(lambda: check_log_crs(str(info["crs"]), path))


def _check_rig(report: Report) -> Rig | None:
    path = report.folder / "rig.parquet"
    if not path.exists():
        if (report.folder / "images.parquet").exists():
            report.error(path, "no such file", "images without calibration cannot be used")
        else:
            report.warning(path, "no calibration: the log has no cameras")
        return None
    rig = report.attempt(lambda: rig_of_table(load(path, RIG), path))
    for camera in rig or ():
        check_camera(report, path, camera)
    if rig is not None and not len(rig):
        report.error(path, "holds no camera")
    return rig


def _check_frames(report: Report, table: pa.Table, crs: str | None) -> dict[int, int]:
    """frames.parquet; frame → timestamp."""
    path = report.folder / "frames.parquet"
    index = table["frame"].to_numpy(zero_copy_only=False)
    times = table["timestamp_ns"].to_numpy(zero_copy_only=False)
    if not len(index):
        report.error(path, "holds no frame")
        return {}
    first = np.unique(index, return_index=True)[1]
    report.rows(path, ~np.isin(np.arange(len(index)), first), "frame numbers used twice")
    values = numbers(table, POSE)
    poses = check_trajectory(report, path, times, values[:, 3:], values[:, :3])
    sigma = numbers(table, SIGMAS)
    report.rows(
        path,
        ~(sigma > 0).all(axis=1),
        "sigmas that are not above zero",
        "state how rough the initial poses are, e.g. 1 m, 1 m, 0.02 rad",
    )
    if (sigma[:, 2] > np.pi).any():
        report.warning(path, "sigma_yaw above π", "is it in radians?")
    if poses is not None:
        if crs is not None:
            check_place(report, path, crs, poses[:, :2, 3])
        _check_odometry(report, path, table, poses)
    return dict(zip(index.tolist(), times.tolist(), strict=True))


def _check_odometry(report: Report, path: Path, table: pa.Table, poses: np.ndarray) -> None:
    """Odometry must be forward motion of about the length that the poses show."""
    odometry = numbers(table, ODOMETRY)
    known = np.isfinite(odometry).all(axis=1) & (np.arange(len(odometry)) > 0)
    if known.sum() < 3:
        return
    driven = np.concatenate([[0.0], np.hypot(*np.diff(poses[:, :2, 3], axis=0).T)])[known].sum()
    stated = odometry[known, 0].sum()
    if driven > 20 and not 0.5 < stated / driven < 1.5:
        report.warning(
            path,
            f"odometry adds up to {stated:.0f} m forward, the poses to {driven:.0f} m",
            "odometry is dx, dy, dyaw in the previous frame's ego frame",
        )
    sigma = numbers(table, ODOMETRY_SIGMA)
    report.rows(path, known & ~(sigma > 0).all(axis=1), "odometry without sigmas above zero")


def _check_images(
    report: Report, rig: Rig | None, times: dict[int, int] | None, fast: bool
) -> None:
    path = report.folder / "images.parquet"
    if not path.exists():
        report.warning(path, "no images: infer has nothing to read")
        return
    table = _table(report, "images.parquet", IMAGES)
    if table is None:
        return
    rows = table.to_pylist()
    first: dict[tuple[int, str], int] = {}
    for k, row in enumerate(rows):
        first.setdefault((row["frame"], row["camera"]), k)
    twice = ~np.isin(np.arange(len(rows)), list(first.values()))
    report.rows(path, twice, "images listed twice for one frame and camera")
    cameras: dict[str, Camera] = {c.name: c for c in rig or ()}
    for name in sorted({row["camera"] for row in rows} - set(cameras)) if rig else ():
        report.error(path, f"camera {name} is not in rig.parquet", "add its calibration")
    limited = Limited(report)
    for row in rows:
        try:
            (file,) = paths_inside(report.folder, [row["path"]], path)
        except BadInput as error:
            limited.add("paths that lead out", "error", path, error.what, error.todo)
            continue
        found = check_image(file, cameras.get(row["camera"]), fast)
        if found is not None:
            limited.add(found[0], "error", file, found[1], found[2])
    limited.close(path)
    if times is not None:
        _check_image_times(report, path, table, times)


def _check_image_times(report: Report, path: Path, table: pa.Table, times: dict[int, int]) -> None:
    frames = table["frame"].to_pylist()
    stamps = table["timestamp_ns"].to_pylist()
    _unknown_frames(report, path, frames, times)
    bare = sorted(set(times) - set(frames))
    if bare:
        first = ", ".join(map(str, bare[:SHOWN]))
        report.warning(path, f"{len(bare)} frames have no image (frame {first} …)")
    late = [abs(t - times[f]) for f, t in zip(frames, stamps, strict=True) if f in times]
    if late and max(late) > 100_000_000:
        report.warning(
            path, f"an image was taken {max(late) / 1e9:.3g} s away from the time of its frame"
        )


def _unknown_frames(report: Report, path: Path, frames: list[int], times: dict[int, int]) -> None:
    unknown = sorted(set(frames) - set(times))
    if unknown:
        first = ", ".join(map(str, unknown[:SHOWN]))
        report.error(path, f"{len(unknown)} frames are not in frames.parquet (frame {first} …)")


def _check_lidar(report: Report, times: dict[int, int] | None) -> None:
    path = report.folder / "lidar.parquet"
    if not path.exists():
        return
    table = _table(report, "lidar.parquet", LIDAR)
    if table is None:
        return
    if times is not None:
        _unknown_frames(report, path, table["frame"].to_pylist(), times)
    for name in table["path"].to_pylist():
        try:
            points = load(paths_inside(report.folder, [name], path)[0], SWEEP)
        except BadInput as error:
            report.bad(error)
            continue
        xyz = numbers(points, ("x", "y", "z"))
        if not len(xyz) or not np.isfinite(xyz).all():
            report.error(report.folder / name, "no points, or points that are not numbers")
        elif np.median(np.linalg.norm(xyz, axis=1)) > 300:
            report.warning(
                report.folder / name, "points lie hundreds of metres away", "use the ego frame"
            )


def _check_masks(report: Report, rig: Rig | None, fast: bool) -> None:
    folder = report.folder / "masks"
    if not folder.is_dir():
        return
    if not (folder / "labels.json").exists():
        report.error(folder, "has no labels.json", "say what the numbers in the masks mean")
    cameras = {c.name: c for c in rig or ()}
    limited = Limited(report)
    for path in sorted(folder.glob("*/*.png")):
        name = path.parent.name
        if rig and name not in cameras:
            limited.add("masks of unknown cameras", "error", path, f"{name} is not in rig.parquet")
            continue
        found = check_image(path, cameras.get(name), fast)
        if found is not None:
            limited.add(f"masks: {found[0]}", "error", path, found[1], found[2])
    limited.close(folder)


def _check_occluders(report: Report, times: dict[int, int] | None) -> None:
    path = report.folder / "occluders.parquet"
    table = _table(report, "occluders.parquet", OCCLUDERS) if path.exists() else None
    if table is None:
        return
    if times is not None:
        _unknown_frames(report, path, table["frame"].to_pylist(), times)
    values = numbers(table, OCCLUDERS.columns.names[1:])
    report.rows(path, ~np.isfinite(values).all(axis=1), "boxes that are not numbers")
    sizes = numbers(table, ("length", "width", "height"))
    report.rows(path, ~(sizes > 0).all(axis=1), "boxes without size")


def _check_truth(report: Report, times: dict[int, int] | None) -> None:
    folder = report.folder / "truth"
    if (folder / "changes.json").exists():
        report.attempt(lambda: read_json(folder / "changes.json"))
    path = folder / "poses.parquet"
    poses = report.attempt(lambda: read_poses(path)) if path.exists() else None
    if poses is not None and times is not None and set(poses.frame.tolist()) != set(times):
        report.warning(path, "its frames are not those of frames.parquet")
