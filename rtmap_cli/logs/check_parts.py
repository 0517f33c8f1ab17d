"""What the checks of all log formats share: findings, trajectories, cameras, images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.geometry.poses import se3_from_quaternion, wrap_angle, yaw_of
from rtmap_cli.logs.log import Camera

Array = NDArray[np.float64]

SHOWN = 5
"""Findings of one kind and file that are listed; further ones are counted."""
MAX_SPEED = 60.0
"""m/s beyond which a step of the poses is a jump (216 km/h)."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: ``level`` error (the log cannot be used as it is) or warning."""

    level: str
    file: str
    what: str
    todo: str = ""

    def line(self) -> str:
        """The finding as one line."""
        return f"{self.level}: {self.file}: {self.what}" + (f"; {self.todo}" if self.todo else "")

    def as_dict(self) -> dict[str, str]:
        """The finding as a plain object."""
        return asdict(self)


T = TypeVar("T")


@dataclass
class Report:
    """Collects findings about the log in ``folder``."""

    folder: Path
    findings: list[Finding] = field(default_factory=list)

    def add(self, level: str, file: str | Path, what: str, todo: str = "") -> None:
        """Add one finding; paths inside the folder become relative to it."""
        path = Path(file)
        name = str(path.relative_to(self.folder)) if path.is_relative_to(self.folder) else str(file)
        self.findings.append(Finding(level, name, what, todo))

    def error(self, file: str | Path, what: str, todo: str = "") -> None:
        """Something that makes the log unusable as it is."""
        self.add("error", file, what, todo)

    def warning(self, file: str | Path, what: str, todo: str = "") -> None:
        """Something odd that rtmap can live with."""
        self.add("warning", file, what, todo)

    def bad(self, error: BadInput) -> None:
        """What a reader refused."""
        self.error(error.where, error.what, error.todo)

    def attempt(self, call: Callable[[], T]) -> T | None:
        """The result of a reader, or None after its BadInput became a finding."""
        try:
            return call()
        except BadInput as error:
            self.bad(error)
            return None

    def rows(self, file: Path, bad: Any, what: str, todo: str = "", name: str = "row") -> None:
        """An error with the first rows of a mask, and how many there are."""
        found = np.flatnonzero(bad)
        if len(found):
            first = ", ".join(map(str, found[:SHOWN].tolist()))
            more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
            self.error(file, f"{what} ({name} {first}{more})", todo)

    @property
    def errors(self) -> int:
        """Number of errors."""
        return sum(f.level == "error" for f in self.findings)

    @property
    def warnings(self) -> int:
        """Number of warnings."""
        return len(self.findings) - self.errors


@dataclass
class Limited:
    """Passes the first findings of each kind to a report, counts the others, says so at the end."""

    report: Report
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, kind: str, level: str, file: Path, what: str, todo: str = "") -> None:
        """One finding of a kind of which there may be thousands."""
        self.counts[level, kind] += 1
        if self.counts[level, kind] <= SHOWN:
            self.report.add(level, file, what, todo)

    def close(self, where: Path) -> None:
        """Say how many of each kind were not listed."""
        for (level, kind), count in self.counts.items():
            if count > SHOWN:
                self.report.add(level, where, f"{count - SHOWN} more: {kind}")


def check_trajectory(
    report: Report, file: Path, times: NDArray[np.int64], quaternion: Array, position: Array
) -> Array | None:
    """Check times (n,), quaternions (n, 4) and positions (n, 3); the poses when they are usable."""
    before = len(report.findings)
    finite = np.isfinite(quaternion).all(axis=1) & np.isfinite(position).all(axis=1)
    report.rows(file, ~finite, "poses that are not numbers", "drop or repair these rows")
    norm = np.linalg.norm(quaternion, axis=1)
    report.rows(
        file, finite & (np.abs(norm - 1) > 1e-3), "quaternions not of length 1", "normalise them"
    )
    step = np.diff(times, prepend=times[:1])
    step[:1] = 1
    report.rows(file, step < 0, "timestamps go backwards", "sort the rows by time")
    report.rows(file, step == 0, "timestamps repeated", "drop duplicates")
    if len(report.findings) > before:
        return None
    poses = se3_from_quaternion(quaternion, position)
    _check_motion(report, file, times, poses)
    return poses


def _check_motion(report: Report, file: Path, times: NDArray[np.int64], poses: Array) -> None:
    """Jumps, gaps, units of time, and whether the vehicle drives where it looks."""
    tilt = np.degrees(np.arccos(np.clip(poses[:, 2, 2], -1, 1)))
    if np.median(tilt) > 20:
        report.warning(
            file,
            f"the vehicle is tilted by {np.median(tilt):.0f}° all the time",
            "is z of the ego frame up, and are quaternions w, x, y, z?",
        )
    if len(times) < 2:
        return
    seconds = np.diff(times) / 1e9
    move = np.diff(poses[:, :3, 3], axis=0)
    distance = np.linalg.norm(move, axis=1)
    limited = Limited(report)
    for row in np.flatnonzero(distance > MAX_SPEED * seconds + 10.0).tolist():
        what = f"the pose jumps by {distance[row]:.0f} m in {seconds[row]:.3g} s after row {row}"
        limited.add("jumps", "error", file, what, "repair the poses, or cut the log there")
    limited.close(file)
    usual = float(np.median(seconds))
    if not 1e-5 < usual < 60:
        report.warning(file, f"rows lie {usual:.3g} s apart", "are the timestamps in nanoseconds?")
    gap = int(seconds.argmax())
    if seconds[gap] > max(10 * usual, 1.0):
        report.warning(file, f"{seconds[gap]:.1f} s without a row after row {gap}")
    _check_heading(report, file, poses)


def _check_heading(report: Report, file: Path, poses: Array) -> None:
    """Median angle between heading and motion over steps of at least 2 m."""
    xy = poses[:, :2, 3]
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    if travelled[-1] < 20:
        return
    rows = np.unique(np.searchsorted(travelled, np.arange(0, travelled[-1], 5.0)))
    move = np.diff(xy[rows], axis=0)
    far = np.hypot(*move.T) > 2.0
    if far.sum() < 3:
        return
    course = np.arctan2(move[far, 1], move[far, 0])
    angle = np.degrees(np.median(np.abs(wrap_angle(course - yaw_of(poses[rows[:-1]])[far]))))
    if angle > 30:
        report.warning(
            file,
            f"the vehicle moves {angle:.0f}° away from where it looks",
            "ego x is forward, yaw counter-clockwise from grid east, quaternions w, x, y, z",
        )


def check_camera(report: Report, file: Path, camera: Camera) -> None:
    """Whether the calibration of a camera can be meant."""
    name, k = camera.name, camera.intrinsics
    if camera.width <= 0 or camera.height <= 0:
        report.error(file, f"{name}: size {camera.width} × {camera.height}")
        return
    if k[0, 0] <= 0 or k[1, 1] <= 0:
        report.error(file, f"{name}: focal length {k[0, 0]:g}, {k[1, 1]:g} px", "give pixels")
        return
    if not (0 <= k[0, 2] <= camera.width and 0 <= k[1, 2] <= camera.height):
        where = f"({k[0, 2]:.0f}, {k[1, 2]:.0f})"
        report.error(
            file,
            f"{name}: principal point {where} outside {camera.width} × {camera.height}",
            "intrinsics belong to the size of the stored images",
        )
    if not 0.2 < k[0, 0] / camera.width < 10:
        report.warning(file, f"{name}: focal length {k[0, 0]:g} px for {camera.width} px of width")
    if not 0.8 < k[0, 0] / k[1, 1] < 1.25:
        report.warning(file, f"{name}: fx {k[0, 0]:g} and fy {k[1, 1]:g} differ")
    pose = camera.ego_SE3_camera
    if np.hypot(*pose[:2, 3]) > 15 or not -3 < pose[2, 3] < 6:
        at = ", ".join(f"{v:.1f}" for v in pose[:3, 3])
        report.warning(file, f"{name}: sits at ({at}) m in the ego frame", "is it in metres?")
    if abs(pose[2, 2]) > 0.8 or pose[2, 1] > 0:
        report.warning(
            file,
            f"{name}: looks up or down, or stands on its head",
            "the pose takes camera axes (x right, y down, z forward) to ego axes",
        )
    _check_distortion(report, file, camera)


def _check_distortion(report: Report, file: Path, camera: Camera) -> None:
    """The image radius must rise with the angle of the ray, up to the side of the image."""
    k, lens = camera.intrinsics, camera.lens
    side = max(k[0, 2], camera.width - k[0, 2]) / k[0, 0]
    farthest = float(np.hypot(*lens.distort(np.array([lens.reach, 0.0]))))
    if farthest < side and lens.reach < 50:
        report.warning(
            file,
            f"{camera.name}: the distortion folds the image",
            "are k1 … k6 in the order of rtmap, and is it a pinhole or a fisheye lens?",
        )


def check_image(path: Path, camera: Camera | None, fast: bool) -> tuple[str, str, str] | None:
    """(kind, what, todo) when an image is missing, broken or of another size than its camera.

    ``fast`` reads header and end marker only; otherwise the image is decoded too (a JPEG at an
    eighth of its size, which still reads all of it).
    """
    from PIL import Image

    from rtmap_cli.logs.native import decode_image

    if not path.exists():
        return "missing images", "no such image", "copy it, or drop its row"
    try:
        with Image.open(path) as image:
            size, kind = image.size, image.format
    except (OSError, SyntaxError, Image.DecompressionBombError):
        return "unreadable images", "not an image", "copy it again"
    if camera is not None and size != (camera.width, camera.height):
        return (
            "images of another size",
            f"is {size[0]} × {size[1]}, the calibration of {camera.name} says "
            f"{camera.width} × {camera.height}",
            "scale images and intrinsics together",
        )
    if kind == "JPEG" and b"\xff\xd9" not in _tail(path):
        return "truncated images", "truncated (no end marker)", "copy it again"
    if not fast:
        try:
            decode_image(path, (1, 1))
        except BadInput as error:
            return "unreadable images", error.what, "copy it again"
    return None


def _tail(path: Path, count: int = 64) -> bytes:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - count))
        return file.read()


def check_place(report: Report, file: Path, crs: str, xy: Array) -> None:
    """Whether (n, 2) positions lie where their CRS is meant to be used (with a degree to spare)."""
    from rtmap_cli.maps.crs import is_local, parse_crs, to_lonlat

    if is_local(crs):
        return
    area = parse_crs(crs, file).area_of_use
    try:
        lonlat = to_lonlat(crs, xy)
    except BadInput:
        report.error(file, f"positions lie outside {crs}", "check the CRS in the log")
        return
    if area is None:
        return
    west, south, east, north = area.bounds
    x, y = np.median(lonlat, axis=0)
    inside_x = (x - west + 1) % 360 <= (east - west) % 360 + 2
    if not (inside_x and south - 1 <= y <= north + 1):
        report.error(
            file,
            f"positions (about {x:.3f}°, {y:.3f}°) lie outside {crs} ({area.name})",
            "the CRS is wrong, or the positions are in another frame",
        )
