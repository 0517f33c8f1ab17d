"""Tours: one long drive over the lanes of a town that comes back to places it knows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import NoAnswer
from rtmap_cli.geometry.polylines import arc_length
from rtmap_cli.steps.simulate.driving.routes import Lane, smoothed
from rtmap_cli.steps.simulate.perceiving.noise import generator

Array = NDArray[np.float64]


def tour_of(lanes: Sequence[Lane], length_m: float, world_seed: int, number: int) -> Array:
    """A drive of ``length_m`` over the lane graph: (n, 3) at 1 m steps, map frame.

    At every fork it takes the lane that was driven least, so that streets, turns and the
    roundabout come in turn and old places come again. Lanes from which the drive cannot go on for
    ever are left out; NoAnswer when none are left.
    """
    by_id = _endless({lane.lane_id: lane for lane in lanes})
    if not by_id:
        raise NoAnswer(f"no tour over the {len(lanes)} lanes of this map: every way has an end")
    rng = generator("tour", world_seed, number)
    names = sorted(by_id)
    name = names[int(rng.integers(len(names)))]
    driven = dict.fromkeys(names, 0)
    parts: list[Array] = []
    total = 0.0
    while total < length_m:
        lane = by_id[name]
        parts.append(lane.points)
        total += float(arc_length(lane.points)[-1])
        driven[name] += 1
        after = [s for s in lane.successors if s in by_id]
        fewest = min(_ahead(by_id, driven, s) for s in after)
        best = [s for s in after if _ahead(by_id, driven, s) == fewest]
        name = best[int(rng.integers(len(best)))]
    line = np.concatenate(parts)
    moved = np.hypot(*np.diff(line[:, :2], axis=0).T) > 0.05
    line = smoothed(line[np.concatenate([[True], moved])])
    s, at = arc_length(line), np.arange(int(length_m) + 1.0)
    return np.stack([np.interp(at, s, line[:, k]) for k in range(3)], axis=-1)


def _ahead(by_id: dict[str, Lane], driven: dict[str, int], name: str) -> int:
    """How often a lane was driven, and the least driven one after it."""
    after = [driven[s] for s in by_id[name].successors if s in by_id]
    return 2 * driven[name] + min(after)


def _endless(by_id: dict[str, Lane]) -> dict[str, Lane]:
    """The lanes from which a drive can go on for ever."""
    while True:
        kept = {k: v for k, v in by_id.items() if any(s in by_id for s in v.successors)}
        if len(kept) == len(by_id):
            return kept
        by_id = kept
