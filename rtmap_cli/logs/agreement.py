"""Whether a run and a map speak of the same place: what a user should hear before trusting more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.element import VectorMap

NEAR_M = 1.5
"""A vertex this near to an element of its class lies on it; twice a usual initial error."""
SURE = 0.3
"""Detections from this score on are counted."""
ENOUGH_FRAMES, ENOUGH_DETECTIONS = 0.5, 0.2
"""Shares of frames and detections below which a run is said to disagree with a map. On the map of
their own town most detections of simulated drives are found, on another's hardly any."""
SAMPLE = 1000
"""Detections of a run that are looked at, evenly spread."""


@dataclass(frozen=True)
class Agreement:
    """Of one run: ``frames``, of which ``in_range`` have an element of the map in their range;
    sure ``detections`` in these, of which ``found`` lie with half their vertices or more within
    ``NEAR_M`` of elements of their class."""

    frames: int
    in_range: int
    detections: int
    found: int

    def __add__(self, other: Agreement) -> Agreement:
        """Of two parts of a run."""
        return Agreement(*(getattr(self, n) + getattr(other, n) for n in self.__dataclass_fields__))

    def doubt(self, enough: float = ENOUGH_DETECTIONS) -> str:
        """What speaks against run and map being of one place, in words; empty where nothing.

        ``enough``: share of the detections that must lie on the map.
        """
        if self.in_range < ENOUGH_FRAMES * self.frames:
            return f"{self.frames - self.in_range} of {self.frames} frames have no element in range"
        if self.found < enough * self.detections:
            found = f"only {self.found} of {self.detections} detections"
            return f"{found} lie within {NEAR_M} m of an element of their class"
        return ""


def agreement(traversal: Traversal, vector_map: VectorMap, sample: int = SAMPLE) -> Agreement:
    """Compare (``sample`` of) the detections of a run, at its poses, with the elements of a map."""
    import shapely

    lines = np.array([shapely.LineString(e.xy) for e in vector_map], object)
    classes = np.array([e.class_name for e in vector_map], object)
    in_range = np.zeros(len(traversal.pose), bool)
    in_range[shapely.STRtree(lines).query(_views(traversal), predicate="intersects")[0]] = True
    sure = np.flatnonzero((traversal.score >= SURE) & in_range[traversal.frame])
    sure = sure[:: max(1, len(sure) // sample)]
    found = 0
    for name in np.unique(traversal.class_name[sure].astype(str)):
        points = traversal.points[sure[traversal.class_name[sure] == name]]
        tree = shapely.STRtree(_segments(lines[classes == name]))
        near = np.zeros(points.shape[:2], bool)
        hits = tree.query(shapely.points(points.reshape(-1, 2)), "dwithin", distance=NEAR_M)[0]
        near.reshape(-1)[hits] = True
        found += int((near.mean(axis=1) >= 0.5).sum())
    return Agreement(len(in_range), int(in_range.sum()), len(sure), found)


def _segments(lines: NDArray[Any]) -> NDArray[Any]:
    """Every segment of lines by itself: a tree finds the nearest ones of a long line at once."""
    import shapely

    xy, owner = shapely.get_coordinates(lines, return_index=True)
    within = np.flatnonzero(owner[1:] == owner[:-1])
    return np.asarray(shapely.linestrings(np.stack([xy[within], xy[within + 1]], axis=1)))


def _views(traversal: Traversal) -> NDArray[Any]:
    """(m,) the range of every frame as a polygon in the map frame."""
    import shapely

    x0, y0, x1, y1 = traversal.range_m
    box = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    c, s = np.cos(traversal.pose[:, 2]), np.sin(traversal.pose[:, 2])
    rotation = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=-2)
    return shapely.polygons(box @ rotation.transpose(0, 2, 1) + traversal.pose[:, None, :2])


def warning(
    traversals: Sequence[Traversal],
    vector_map: VectorMap,
    where: str | Path,
    enough: float = ENOUGH_DETECTIONS,
) -> str | None:
    """One line for people when runs and a map do not seem to be of the same place, else None.

    An empty map agrees with everything: it is a beginning. ``enough`` as in ``Agreement.doubt``.
    """
    if not len(vector_map):
        return None
    return warning_of({t.run_id: agreement(t, vector_map) for t in traversals}, where, enough)


def warning_of(
    agreements: Mapping[str, Agreement], where: str | Path, enough: float = ENOUGH_DETECTIONS
) -> str | None:
    """The line of ``warning`` for the agreements of runs by their ids."""
    doubts = [(name, a.doubt(enough)) for name, a in agreements.items()]
    doubts = [(name, doubt) for name, doubt in doubts if doubt]
    if not doubts:
        return None
    name, doubt = doubts[0]
    more = f" ({len(doubts)} of {len(agreements)} runs are so)" if len(agreements) > 1 else ""
    return f"warning: {name} and {where} hardly agree: {doubt}{more}; is it the map of this place?"
