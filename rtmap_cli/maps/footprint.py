"""Where a network was trained: cells of the earth that its frames saw, and what has no place.

Cells are web-mercator quadkeys of zoom 18 (about 150 m at the equator, 115 m at 40°): they tell
towns and streets apart, and neither single drives nor times.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import resample_step
from rtmap_cli.geometry.poses import transform
from rtmap_cli.maps.crop import Range
from rtmap_cli.maps.crs import is_local, to_lonlat
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.tiles import quadkeys

Array = NDArray[np.float64]

METADATA_KEY = "rtmap.training_footprint"
"""Of a model file (docs/model-contract.md)."""

ZOOM = 18
PREFIX = 12
"""Cells are written by their tile of this zoom (about 10 km)."""
STEP = 6.0
"""Metres between the points by which areas are taken to cells, and measured."""

PLACES, PROCEDURAL, LOCAL, UNKNOWN = "places", "procedural", "local", "unknown"
ORIGINS = (PLACES, PROCEDURAL, LOCAL, UNKNOWN)
"""Frames with a place on earth; towns made by rtmap; real drives whose place nobody states; frames
of which nothing is known."""

CHUNK = 2000
SHIFT = 1 << 24
"""Squares are numbered from 0 with this added: coordinates of any projected CRS fit."""


@dataclass(frozen=True)
class Footprint:
    """What training saw: ``origins`` of its frames, and the ``cells`` (quadkeys) of those that
    have a place. ``a | b`` is what both saw."""

    origins: frozenset[str] = frozenset()
    cells: frozenset[str] = frozenset()

    def __or__(self, other: Footprint) -> Footprint:
        return Footprint(self.origins | other.origins, self.cells | other.cells)

    @property
    def known(self) -> bool:
        """Whether every frame is accounted for: it has a place, or cannot have one."""
        return bool(self.origins) and not self.origins & {UNKNOWN, LOCAL}

    def stated(self, by_user: Footprint) -> Footprint:
        """With what a user knows in place of what is unknown."""
        return Footprint(self.origins - {UNKNOWN}, self.cells) | by_user

    def holds(self, lonlat: Array) -> NDArray[np.bool_]:
        """(n,) which of (n, 2) WGS84 longitudes and latitudes lie in a cell."""
        return np.array([key in self.cells for key in quadkeys(lonlat, ZOOM)], dtype=bool)

    def text(self) -> str:
        """One phrase for people."""
        count = len(self.cells)
        words = {
            PLACES: f"{count} cell{'s' * (count != 1)} of about 100 m",
            PROCEDURAL: "procedural towns",
            LOCAL: "drives without a place on earth",
            UNKNOWN: "something unknown",
        }
        return " and ".join(words[o] for o in ORIGINS if o in self.origins) or "nothing"

    def as_json(self) -> dict[str, Any]:
        """``{"origins": […], "zoom": 18, "cells": {12 digits: "6 digits 6 digits …"}}``."""
        groups: dict[str, list[str]] = {}
        for cell in sorted(self.cells):
            groups.setdefault(cell[:PREFIX], []).append(cell[PREFIX:])
        cells = {prefix: " ".join(rest) for prefix, rest in groups.items()}
        return {
            "origins": [o for o in ORIGINS if o in self.origins],
            "zoom": ZOOM,
            "cells": cells,
        }


NOTHING_KNOWN = Footprint(frozenset({UNKNOWN}))
TOWNS = Footprint(frozenset({PROCEDURAL}))


def read_footprint(value: Any) -> Footprint:
    """The footprint of ``Footprint.as_json``; None is one of which nothing is known. ValueError
    for anything else."""
    if value is None:
        return NOTHING_KNOWN
    if not isinstance(value, Mapping) or not isinstance(value.get("cells"), Mapping):
        raise ValueError("a training footprint without cells")
    origins = value.get("origins")
    if not isinstance(origins, list) or not origins or not set(map(str, origins)) <= set(ORIGINS):
        raise ValueError(f"a training footprint with the origins {origins!r}")
    if value.get("zoom") != ZOOM:
        raise ValueError(f"a training footprint of zoom {value.get('zoom')!r}, not {ZOOM}")
    cells = [f"{p}{rest}" for p, text in value["cells"].items() for rest in str(text).split()]
    wrong = next((c for c in cells if not re.fullmatch(rf"[0-3]{{{ZOOM}}}", c)), None)
    if wrong is not None:
        raise ValueError(f"a training footprint with the cell {wrong!r}")
    if bool(cells) != (PLACES in origins):
        raise ValueError("a training footprint whose cells and origins disagree")
    return Footprint(frozenset(map(str, origins)), frozenset(cells))


def footprint_of_poses(poses: Array, crs: str, range_m: Range) -> Footprint:
    """What frames at ``poses`` (n, 4, 4) map_SE3_ego saw: every cell that their range touches."""
    if is_local(crs):
        return Footprint(frozenset({LOCAL}))
    cells: set[str] = set()
    for start in range(0, len(poses), CHUNK):
        points = points_in_range(poses[start : start + CHUNK], range_m)
        cells |= set(quadkeys(to_lonlat(crs, points), ZOOM))
    return Footprint(frozenset({PLACES} if cells else ()), frozenset(cells))


def footprint_of_map(vector_map: VectorMap) -> Footprint:
    """The cells that the elements of a map pass through."""
    lines = [resample_step(e.xy, STEP) for e in vector_map]
    if not lines:
        return Footprint()
    keys = quadkeys(to_lonlat(vector_map.crs, np.concatenate(lines)), ZOOM)
    return Footprint(frozenset({PLACES}), frozenset(keys))


def points_in_range(poses: Array, range_m: Range) -> Array:
    """(n, 2) the middles of the squares of the map frame, ``STEP`` metres wide, that the ranges of
    frames at ``poses`` (n, 4, 4) touch."""
    x0, y0, x1, y1 = range_m
    x, y = (np.linspace(a, b, int(np.ceil((b - a) / STEP)) + 1) for a, b in ((x0, x1), (y0, y1)))
    box = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    found = np.zeros(0, np.int64)
    for start in range(0, len(poses), CHUNK):
        here = [transform(pose, box)[:, :2] for pose in poses[start : start + CHUNK]]
        square = np.floor(np.concatenate(here) / STEP).astype(np.int64) + SHIFT
        found = np.union1d(found, square[:, 0] * 2 * SHIFT + square[:, 1])
    column, row = np.divmod(found, 2 * SHIFT)
    return (np.column_stack([column, row]) - SHIFT + 0.5) * STEP


def union(footprints: Iterable[Footprint]) -> Footprint:
    """What all of them saw."""
    several = list(footprints)
    origins = frozenset[str]().union(*(f.origins for f in several))
    return Footprint(origins, frozenset[str]().union(*(f.cells for f in several)))
