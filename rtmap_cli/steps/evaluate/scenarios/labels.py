"""Scenarios of frames: straight, turning, intersection, loop, roundabout, multi-lane.

They follow from the drive and the true map alone; docs/evaluate-map.md has the definitions. The
names are those by which the campus mapping paper (arXiv 2509.25542, Tab. 3) breaks its AP down,
with ``turning`` of the RTMap paper's Tab. 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.evaluate.drives import Drive
from rtmap_cli.steps.evaluate.scenarios.junctions import RoadMap
from rtmap_cli.steps.evaluate.scenarios.trajectory import STEP, Trajectory

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

SCENARIOS = ("straight", "turning", "intersection", "loop", "roundabout", "multi-lane")

MULTI_LANE = 3
"""Lanes across the road, both directions together, from which it is multi-lane."""
ISLAND_AREA = (10.0, 1500.0)
"""Central islands of roundabouts have an area between these (m²) …"""
ISLAND_ROUNDNESS = 0.75
"""… and 4πA/L² of at least this (circle 1, square 0.785)."""
RING_WIDTH = 15.0
"""The path runs within this distance (m) of the island's mean radius …"""
TANGENTIAL = 0.8
"""… across the line to its centre (sine of the angle to it) …"""
RING_BEND = np.radians(30.0)
"""… and turns by this the way it goes round."""
FREE_BEND, FREE_RADIUS = np.radians(225.0), (5.0, 40.0)
"""Without an island: bent to one side by this, with a mean radius (m) between these."""


def scenarios_of(
    drive: Drive, vector_map: VectorMap, timestamp_ns: NDArray[np.int64]
) -> dict[str, Bools]:
    """Which of ``SCENARIOS`` (n,) hold at some times of a drive.

    The map is in the CRS of the drive. Every frame is either straight or turning; the others come
    in addition.
    """
    path = Trajectory.of(drive)
    road = RoadMap(vector_map, path.xy)
    turning = path.turning()
    found = {
        "straight": ~turning,
        "turning": turning,
        "intersection": road.at_junction(),
        "loop": path.looping(),
        "roundabout": _round_islands(path, road) | _full_circles(path),
        "multi-lane": road.lanes(path.yaw) >= MULTI_LANE,
    }
    station = path.at(timestamp_ns)
    return {name: found[name][station] for name in SCENARIOS}


def _runs(mask: Bools) -> list[tuple[int, int]]:
    """Half-open ranges of consecutive True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _round_islands(path: Trajectory, road: RoadMap) -> Bools:
    out = np.zeros(len(path), dtype=bool)
    ahead = np.column_stack([np.cos(path.yaw), np.sin(path.yaw)])
    for island in road.islands():
        low, high = ISLAND_AREA
        if not low <= island.area <= high or island.roundness < ISLAND_ROUNDNESS:
            continue
        offset = path.xy - island.centre
        distance = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-9)
        round_it = (offset[:, 0] * ahead[:, 1] - offset[:, 1] * ahead[:, 0]) / distance
        close = distance <= np.sqrt(island.area / np.pi) + RING_WIDTH
        for sense in (1.0, -1.0):
            for a, b in _runs(close & (sense * round_it >= TANGENTIAL)):
                if sense * (path.yaw[b - 1] - path.yaw[a]) >= RING_BEND:
                    out[a:b] = True
    return out


def _full_circles(path: Trajectory) -> Bools:
    """Stretches that bend to one side all the time, by most of a circle, on a small radius."""
    out = np.zeros(len(path), dtype=bool)
    behind, ahead = path.bends()
    bend = (behind + ahead) / 2
    for sense in (1.0, -1.0):
        for a, b in _runs(np.asarray(sense * bend >= 1 / (2 * FREE_RADIUS[1]))):
            change, way = sense * (path.yaw[b - 1] - path.yaw[a]), path.s[b - 1] - path.s[a]
            if change >= FREE_BEND and FREE_RADIUS[0] <= max(way, STEP) / change <= FREE_RADIUS[1]:
                out[a:b] = True
    return out
