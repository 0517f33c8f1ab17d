"""Routes over a lane graph: drives longer than a recorded log, found by their shape.

``straight``: the heading changes by less than 25° within any 40 m; ``turning``: by more than 60°
somewhere within 40 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from rtmap_cli.errors import NoAnswer
from rtmap_cli.formats.av2.vector_map import Av2Map
from rtmap_cli.geometry.polylines import arc_length, resample, resample_step
from rtmap_cli.steps.simulate.perceiving.noise import generator

Array = NDArray[np.float64]

KINDS = ("straight", "turning")
WINDOW = 40.0
STRAIGHT_TURN = np.radians(25.0)
TURNING_TURN = np.radians(60.0)
MAX_ROUTES = 400
"""Routes of a kind that are kept; lane graphs of a few hundred metres have about as many."""
MAX_COMPARED = 60


@dataclass(frozen=True)
class Lane:
    """Centre line (n, 3) of a lane in its driving direction, map frame, metres; what follows."""

    lane_id: str
    points: Array
    successors: tuple[str, ...]


def centre_line(left: Array, right: Array, step: float = 2.0) -> Array:
    """Centre line (n, 3) between the boundaries of a lane, each (k, 3) in driving direction."""
    longest = max(arc_length(left)[-1], arc_length(right)[-1])
    count = max(2, int(np.ceil(longest / step)) + 1)
    return (resample(left, count) + resample(right, count)) / 2


def turn(points: Array, window: float = WINDOW) -> float:
    """Largest change of heading within ``window`` metres of a line with 1 m steps, radians."""
    headings = np.unwrap(np.arctan2(*np.diff(points[:, :2], axis=0).T[::-1]))
    width = min(len(headings), int(window))
    windows = np.lib.stride_tricks.sliding_window_view(headings, width)
    return float((windows.max(axis=1) - windows.min(axis=1)).max())


def smoothed(points: Array, sigma: float = 3.0) -> Array:
    """A line at 1 m steps without the kinks where lanes meet (Gaussian, ``sigma`` metres)."""
    dense = resample_step(points, 1.0)
    pad = min(len(dense) - 1, int(4 * sigma))
    # Continued by point reflection, so that the ends stay where they are.
    head = 2 * dense[:1] - dense[pad:0:-1]
    tail = 2 * dense[-1:] - dense[-2 : -pad - 2 : -1]
    return gaussian_filter1d(np.concatenate([head, dense, tail]), sigma, axis=0)[pad:-pad]


def matches(kind: str, points: Array) -> bool:
    """True when a route (1 m steps) is of the kind."""
    change = turn(points)
    return change < STRAIGHT_TURN if kind == "straight" else change > TURNING_TURN


def find_routes(lanes: Sequence[Lane], kind: str, length_m: float) -> list[Array]:
    """Every route of a kind and length over the lane graph: (n, 3) at 1 m steps, map frame.

    Lanes are followed through their successors (those outside the map are left out), none twice.
    The order depends on the lanes alone.
    """
    by_id = {lane.lane_id: lane for lane in lanes}
    routes: list[Array] = []
    for lane in sorted(lanes, key=lambda lane: lane.lane_id):
        stack: list[tuple[tuple[str, ...], float]] = []
        stack.append(((lane.lane_id,), float(arc_length(lane.points)[-1])))
        while stack and len(routes) < MAX_ROUTES:
            path, travelled = stack.pop()
            if travelled >= length_m:
                line = np.concatenate([by_id[i].points for i in path])
                line = smoothed(_without_repeats(line))
                line = _at_steps(line, length_m)
                if matches(kind, line):
                    routes.append(line)
                continue
            for after in sorted(by_id[path[-1]].successors, reverse=True):
                if after in by_id and after not in path:
                    more = float(arc_length(by_id[after].points)[-1])
                    stack.append(((*path, after), travelled + more))
    return routes


def _at_steps(line: Array, length_m: float) -> Array:
    """The first ``length_m`` metres of a line at 1 m steps."""
    s, at = arc_length(line), np.arange(int(length_m) + 1.0)
    return np.stack([np.interp(at, s, line[:, k]) for k in range(line.shape[1])], axis=-1)


def _without_repeats(line: Array) -> Array:
    moved = np.hypot(*np.diff(line[:, :2], axis=0).T) > 0.05
    return line[np.concatenate([[True], moved])]


def corridor(routes: Sequence[Array], world_seed: int, share: float = 0.5) -> list[Array]:
    """Routes that share a corridor: at least ``share`` of each within 15 m of the first.

    The first one is drawn with ``world_seed`` among those with plenty of company, the others
    follow in an order drawn with it.
    """
    rng = generator("corridor", world_seed)
    # Enough of them for a fleet; comparing each with each grows with the square.
    chosen = rng.permutation(len(routes))[:MAX_COMPARED]
    routes = [routes[i] for i in chosen]
    trees = [cKDTree(route[:, :2]) for route in routes]
    near = np.array(
        [
            [(tree.query(r[::5, :2], distance_upper_bound=15.0)[0] < np.inf).mean() for r in routes]
            for tree in trees
        ]
    )
    company = (near >= share).sum(axis=1)
    first = int(rng.choice(np.flatnonzero(company >= 0.6 * company.max())))
    others = [i for i in rng.permutation(len(routes)) if i != first and near[first, i] >= share]
    return [routes[first]] + [routes[i] for i in others]


def route_of(
    lanes: Sequence[Lane], kind: str, length_m: float, world_seed: int, number: int
) -> Array:
    """The route of drive ``number`` through a world: (n, 3) at 1 m steps in the map frame.

    Drives take the routes of one corridor in turn: other lanes and directions where the map has
    them. NoAnswer when the map holds no route of the kind and length.
    """
    routes = find_routes(lanes, kind, length_m)
    if not routes:
        raise NoAnswer(f"no {kind} route of {length_m:g} m over the {len(lanes)} lanes of this map")
    shared = corridor(routes, world_seed)
    return shared[number % len(shared)]


def lanes_of_av2(av2_map: Av2Map) -> list[Lane]:
    """The lanes for motor vehicles of an Argoverse 2 map with their centre lines.

    Heights that are unknown become 0 here: a route's height moves nothing in the plane.
    """
    return [
        Lane(
            str(lane.lane_id),
            np.nan_to_num(centre_line(lane.left, lane.right)),
            tuple(str(i) for i in lane.successors),
        )
        for lane in av2_map.lanes.values()
        if lane.lane_type != "BIKE" and len(lane.left) > 1 and len(lane.right) > 1
    ]
