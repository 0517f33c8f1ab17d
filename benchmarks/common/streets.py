"""An endless street that bends, with lanes, side streets and crossings, and drives along it.

One period of it is seen by the simulator; longer drives are made of copies of that period.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtmap_cli.logs.run import Observations, Poses, Run, RunFrames
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.simulate.driving.drives import drive_over_route, with_traffic
from rtmap_cli.steps.simulate.perceiving.observations import observe
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey
from rtmap_cli.steps.simulate.perceiving.presets import PRESETS

Array = NDArray[np.float64]

CRS = "EPSG:32632"
ORIGIN = np.array([480_000.0, 5_400_000.0])
PERIOD, SWAY = 400.0, 12.0
"""The street repeats after so many metres, and swings so far to either side."""
SPACING = 2.5
ROOM = 80.0
"""The street goes on so far (m) beyond the period that is driven."""
LANES = (-5.0, -1.75, 1.75, 5.0)
SIDE_STREET, MOUTH = 200.0, 9.0


def _along(x: Array, side: float) -> Array:
    """(n, 3) places ``side`` metres to the left of the middle of the street."""
    phase = 2 * np.pi * x / PERIOD
    slope = SWAY * 2 * np.pi / PERIOD * np.cos(phase)
    normal = np.stack([-slope, np.ones_like(x)], -1) / np.hypot(1, slope)[:, None]
    xy = ORIGIN + np.stack([x, SWAY * np.sin(phase)], axis=-1) + side * normal
    return np.column_stack([xy, np.zeros(len(x))])


def street() -> VectorMap:
    """A bit more than one period of the street."""
    low, high = -ROOM, PERIOD + ROOM
    out = []

    def add(name: str, class_name: str, x0: float, x1: float, side: float) -> None:
        x = np.linspace(x0, x1, max(2, round((x1 - x0) / 4)))
        out.append(Element(name, class_name, _along(x, side)))

    for side in (-3.5, 0.0, 3.5):
        add(f"lane{side}", "divider", low, high, side)
    for side in (-7.0, 7.0):
        mouth = SIDE_STREET - MOUTH, SIDE_STREET + MOUTH
        add(f"west{side}", "boundary", low, mouth[0], side)
        add(f"east{side}", "boundary", mouth[1], high, side)
        for k, x in enumerate(mouth):
            corner = _along(np.full(1, x), side)
            far = corner + [0.0, np.sign(side) * 25.0, 0.0]
            out.append(Element(f"mouth{side}.{k}", "boundary", np.concatenate([corner, far])))
    for x in (60.0, 320.0):
        x4 = np.array([x, x + 4.0])
        left, right = _along(x4, 6.5), _along(x4, -6.5)
        ring = np.concatenate([left, right[::-1], left[:1]])
        out.append(Element(f"crossing{x}", "ped_crossing", ring))
    return VectorMap(out, CRS)


def one_period(traversal: int) -> Run:
    """One drive over one period, with poses as localization gives them."""
    preset, key = PRESETS["rtmap-straight"], DriveKey(0, 1, traversal)
    x = np.arange(-10.0, PERIOD + 10.0, 1.0)
    line = _along(x, LANES[traversal % len(LANES)])
    drive = drive_over_route("street", CRS, line, SPACING, 2.0, 0.0, key)
    keep = (drive.pose[:, 0, 3] >= ORIGIN[0]) & (drive.pose[:, 0, 3] < ORIGIN[0] + PERIOD)
    drive = replace(drive, timestamp_ns=drive.timestamp_ns[keep], pose=drive.pose[keep])
    run, truth = observe(street(), with_traffic(drive, preset, key), preset, key, "street")
    rng = np.random.default_rng(traversal)
    pose = truth.pose.copy()
    pose[:, :2, 3] += rng.normal(0, 0.1, 2)
    spread = np.array([0.1, 0.1, 0, 0, 0, np.radians(0.1)]) ** 2
    covariance = np.tile(np.diag(spread), (len(pose), 1, 1))
    return replace(run, poses=replace(truth, pose=pose, covariance=covariance, method="simulated"))


def _shifted(pose: Array, shift: Array) -> Array:
    """Poses (n, 4, 4) in every copy (k, 2)."""
    out = np.tile(pose, (len(shift), 1, 1))
    out[:, :2, 3] += np.repeat(shift, len(pose), axis=0)
    return out


def long_drive(base: Run, shift: Array, name: str) -> Run:
    """The drive in every copy of the street, one after the other."""
    n, k = len(base.frames), len(shift)
    step = int(base.frames.timestamp_ns[-1] - base.frames.timestamp_ns[0]) + 500_000_000
    later = np.repeat(np.arange(k, dtype=np.int64) * step, n)

    def tiled(part: Any) -> Any:
        return np.tile(part, (k, *[1] * (part.ndim - 1)))

    def frames_of(number: Any, rows: int) -> Any:
        return (np.tile(number, k) + np.repeat(np.arange(k) * n, rows)).astype(np.int32)

    f, o, p = base.frames, base.observations, base.poses
    assert p is not None and base.occluders is not None
    frames = RunFrames(**{m: tiled(getattr(f, m)) for m in RunFrames.__dataclass_fields__})
    frame = np.arange(n * k, dtype=np.int32)
    time_ns = tiled(f.timestamp_ns) + later
    frames = replace(frames, frame=frame, timestamp_ns=time_ns, initial=_shifted(f.initial, shift))
    seen = {m: tiled(getattr(o, m)) for m in Observations.__dataclass_fields__}
    seen["frame"] = frames_of(o.frame, len(o))
    placed = {
        m: tiled(getattr(p, m))
        for m in Poses.__dataclass_fields__
        if m not in ("method", "frame", "timestamp_ns", "pose")
    }
    poses = Poses(
        frame=frame, timestamp_ns=time_ns, method=p.method, pose=_shifted(p.pose, shift), **placed
    )
    boxes = pa.concat_tables([base.occluders] * k)
    number = frames_of(base.occluders["frame"].to_numpy(), len(base.occluders))
    boxes = boxes.set_column(boxes.schema.get_field_index("frame"), "frame", pa.array(number))
    return Run({**base.info, "log_id": name}, frames, Observations(**seen), boxes, poses)
