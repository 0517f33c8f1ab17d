"""How do time and memory of the whole-log solver grow with the drive?

    python -m benchmarks.localize.growth                some 1,000 to 10,000 frames

One simulated drive through a town, again and again through copies of the town side by side, with
odometry unknown where one drive follows the other: everything that `rtmap localize --smooth`
solves for after the single frames, map residuals and field included. CPU seconds of one core and
peak memory of a second run of it, and the power of the number of frames with which both grow.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import time
import tracemalloc
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.places import town_places
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.localize.drive.motion import Motion, motion_of
from rtmap_cli.steps.localize.drive.smooth import solve_smooth
from rtmap_cli.steps.localize.frame.single import Solution, solve_single
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections, read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.simulate.perceiving.perception import DriveKey

Array = NDArray[np.float64]

MODEL, SETTINGS = ErrorModel(), Settings()
APART = 1000.0
"""Metres between the copies of a town."""


@dataclass(frozen=True)
class Drive:
    """A drive on a map, with the answers of its single frames."""

    world: VectorMap
    classes: list[str]
    origin: Array
    seen: Detections
    motion: Motion
    start: Solution

    def lines(self, times: int) -> MapLines:
        """So many copies of the map."""
        copies = [
            replace(e, element_id=f"{e.element_id}/{k}", points=e.points + [k * APART, 0.0, 0.0])
            for k in range(times)
            for e in self.world
        ]
        world = VectorMap(copies, self.world.crs)
        return MapLines(world, self.classes, self.origin, SETTINGS.heading_weight_m)

    def repeated(self, times: int) -> tuple[Detections, Motion, Solution]:
        """The drive in every copy."""
        shift = np.zeros((times * len(self.seen), 3))
        shift[:, 0] = np.repeat(np.arange(times), len(self.seen)) * APART
        seen, parts = self.seen.repeated(times), {}
        for name in Motion.__dataclass_fields__:
            part = getattr(self.motion, name)
            parts[name] = np.tile(part, (times, *[1] * (part.ndim - 1)))
        motion = Motion(**parts | {"gnss": parts["gnss"] + shift})
        start = Solution(
            *(
                np.concatenate([getattr(self.start, name)] * times)
                for name in Solution.__dataclass_fields__
            )
        )
        start = replace(start, pose=start.pose + shift)
        return replace(seen, pose=seen.pose + shift), motion, start


def one_drive(town: int, seed: int) -> Drive:
    """A simulated drive, its frames solved one by one."""
    place, key = town_places((town,))[0], DriveKey(0, seed, 0)
    run = place.observe(place.drive("straight", key, 2.5, 2.0), "straight", key)
    classes = list(run.info["classes"])
    origin = np.round(run.frames.initial[:, :2, 3].mean(axis=0))
    lines = MapLines(place.world, classes, origin, SETTINGS.heading_weight_m)
    seen = read_detections(run, lines, SETTINGS, False)
    motion = motion_of(run.frames, seen.pose, MODEL, SETTINGS)
    start = solve_single(lines, seen, MODEL, SETTINGS)
    return Drive(place.world, classes, origin, seen, motion, start)


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--town", type=int, default=700)
    parser.add_argument("--copies", type=int, nargs="+", default=[14, 42, 137])
    a = parser.parse_args()
    drive = one_drive(a.town, 1)
    frames, seconds, megabytes = [], [], []
    for times in a.copies:
        seen, motion, start = drive.repeated(times)
        solve = partial(solve_smooth, drive.lines(times), seen, motion, start, MODEL, SETTINGS)
        begin = time.process_time()
        solve()
        seconds.append(time.process_time() - begin)
        tracemalloc.start()
        solve()
        megabytes.append(tracemalloc.get_traced_memory()[1] / 1e6)
        tracemalloc.stop()
        frames.append(len(seen))
    powers = [float(np.polyfit(np.log(frames), np.log(v), 1)[0]) for v in (seconds, megabytes)]
    report = {
        "frames": frames,
        "seconds": [round(s, 2) for s in seconds],
        "peak megabytes": [round(m) for m in megabytes],
        "exponent of time": round(powers[0], 3),
        "exponent of memory": round(powers[1], 3),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
