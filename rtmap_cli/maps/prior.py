"""The prior of one frame as a network sees it: elements in range, V vertices each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring, resample
from rtmap_cli.geometry.poses import transform
from rtmap_cli.maps.crop import LocalElement

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PriorSlots:
    """P prior queries: ``points`` (P, V, 2) in the (noisy) ego frame, metres; ``class_index``
    (P,) into the model's classes; ``map_points`` (P, V, 2) the same vertices in the map frame;
    ``element_ids``; ``dropped``: how many elements found no slot."""

    points: Array
    class_index: NDArray[np.int64]
    map_points: Array
    element_ids: list[str]
    dropped: int = 0

    def __len__(self) -> int:
        return len(self.element_ids)


def prior_slots(
    local: list[LocalElement],
    map_SE3_ego: Array,
    classes: list[str],
    vertex_count: int,
    max_slots: int,
) -> PriorSlots:
    """Turn the local map of a frame into prior queries.

    Every piece is resampled to ``vertex_count`` vertices at equal arc length (a ring repeats its
    first vertex). Classes that the model does not know are left out. Where there are more pieces
    than slots the farthest are dropped and counted.
    """
    known = [e for e in local if e.class_name in classes]
    points = np.zeros((len(known), vertex_count, 2))
    for k, element in enumerate(known):
        points[k] = resample(element.points[:, :2], vertex_count)
        if is_ring(element.points):
            points[k, -1] = points[k, 0]
    distance = np.hypot(points[..., 0], points[..., 1]).min(axis=1, initial=np.inf)
    keep = np.sort(np.argsort(distance, kind="stable")[:max_slots])
    chosen, points = [known[i] for i in keep], points[keep]
    return PriorSlots(
        points=points,
        class_index=np.array([classes.index(e.class_name) for e in chosen], np.int64),
        map_points=transform(map_SE3_ego, points) if len(chosen) else points.copy(),
        element_ids=[e.source.element_id for e in chosen],
        dropped=len(known) - len(chosen),
    )


DUPLICATE_M = 1.0
"""A detection so near (m, on average) to an answered prior slot of its class is that element."""


def on_prior(
    points: NDArray[Any],
    class_id: NDArray[Any],
    slots: NDArray[Any],
    slot_class: NDArray[Any],
    near: float = DUPLICATE_M,
) -> NDArray[np.bool_]:
    """Which detections (n, V, 2) lie on an answered prior slot (m, V, 2) of their class (ego, m).

    The mean distance of the detection's vertices to the slot counts: a piece of a line lies on it.
    """
    out = np.zeros(len(points), bool)
    for line, name in zip(slots, slot_class, strict=True):
        rows = np.flatnonzero((class_id == name) & ~out)
        if not len(rows):
            continue
        dense = resample(np.asarray(line, np.float64), 4 * len(line))
        gap = np.hypot(*np.moveaxis(points[rows][:, :, None] - dense, -1, 0)).min(axis=2)
        out[rows] = gap.mean(axis=1) < near
    return out
