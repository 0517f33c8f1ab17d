"""Where to cut a fleet: regions that are fused on their own, each from the frames in its reach.

Frames whose views cannot meet form components; a component that fits into a tile is one region.
A larger one is cut by squares of a fixed grid. A region reads the frames that see its square and
``HALO`` metres around it, so that what lies in the square is judged by all that was seen of it.
Every prior element belongs to one region, the first one that sees it, which also reads all other
frames in reach of the element: elements are never cut. New elements are kept in the square and
``BAND`` metres around it; ``stitch`` compares them there with those of the neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.logs.tracks import Track
from rtmap_cli.maps.element import Element

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Box = tuple[float, float, float, float]

SIDE = 512.0
"""Side of a tile (m): what it and its halo see is in memory at once."""
HALO = 40.0
"""Metres around a tile in which everything that was seen is read as well."""
BAND = 10.0
"""Metres around a tile in which its new elements are kept until the neighbours' are there."""
ASIDE = 20.0
"""Frames that see this near (m) to a prior element are read for it."""
CELLS = 64
"""Cells per side of a tile in which frames are counted."""


@dataclass(frozen=True)
class Region:
    """One region: ``box`` of its square (None: no neighbour, nothing to cut), ``parts`` the run
    folders with the sorted frames to read (None: all), ``known`` elements of the prior in reach,
    ``owned`` the ids of those that it decides on."""

    box: Box | None
    parts: tuple[tuple[Path, NDArray[Any] | None], ...]
    known: tuple[Element, ...]
    owned: frozenset[str]


def band_of(box: Box | None, by: float = BAND) -> Box | None:
    """The box with a band around it: where the new elements of a region are kept."""
    return None if box is None else (box[0] - by, box[1] - by, box[2] + by, box[3] + by)


@dataclass(frozen=True)
class _Fleet:
    """All frames: place, run, cell; of the cells (k) centre, and of pairs that meet (cell,
    element)."""

    tracks: list[Track]
    xy: Array
    run: Int
    cell: Int
    centres: Array
    by_cell: list[Int]

    @property
    def reach(self) -> float:
        """The farthest that any run sees (m)."""
        return max(t.reach for t in self.tracks)


def _fleet(tracks: Sequence[Track], size: float) -> _Fleet:
    tracks = sorted(tracks, key=lambda t: t.run_id)
    xy = np.concatenate([t.xy for t in tracks])
    run = np.repeat(np.arange(len(tracks)), [len(t) for t in tracks])
    corner, cell = np.unique(np.floor(xy / size).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    order = np.argsort(cell, kind="stable")
    by_cell = np.split(order, np.cumsum(np.bincount(cell))[:-1])
    centres = np.asarray((corner + 0.5) * size, np.float64)
    return _Fleet(tracks, xy, run, cell, centres, by_cell)


def plan(tracks: Sequence[Track], prior: Sequence[Element], side: float = SIDE) -> list[Region]:
    """The regions of a fleet over a prior, in an order that depends on places alone."""
    size = side / CELLS
    fleet = _fleet(tracks, size)
    squares = _squares(fleet, side)
    pairs = _in_reach(fleet, prior, size)
    home = np.zeros(len(fleet.centres), np.int64)
    for k, (_, own, _) in enumerate(squares):
        home[fleet.cell[own]] = k
    owner = np.full(len(prior), len(squares))
    np.minimum.at(owner, pairs[1], home[pairs[0]])
    by_element = _groups(pairs[1], pairs[0], len(prior))
    by_cell = _groups(pairs[0], pairs[1], len(fleet.centres))
    mine = _groups(owner, np.arange(len(prior)), len(squares) + 1)
    out = []
    for k, (box, _, near) in enumerate(squares):
        cells = np.unique(np.concatenate([near[:0], *(by_element[e] for e in mine[k])]))
        frames = np.unique(np.concatenate([near, *(fleet.by_cell[c] for c in cells)]))
        seen = np.unique(fleet.cell[frames])
        known = np.unique(np.concatenate([mine[k], *(by_cell[c] for c in seen)]))
        if box is None and len(frames) > len(near):
            # Frames of elsewhere came along for a long element; what is new there is not ours.
            xy = fleet.xy[near]
            low, high = xy.min(axis=0) - fleet.reach, xy.max(axis=0) + fleet.reach
            box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        out.append(
            Region(
                box,
                _parts(fleet, frames),
                tuple(prior[e] for e in known),
                frozenset(prior[e].element_id for e in mine[k]),
            )
        )
    return out


def _groups(keys: Int, values: Int, count: int) -> list[Int]:
    """The values of every key 0 … count − 1."""
    order = np.argsort(keys, kind="stable")
    return np.split(values[order], np.cumsum(np.bincount(keys, minlength=count))[:-1])


def _components(fleet: _Fleet) -> Int:
    """(n,) component of every frame: frames whose views may meet are in one."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    size = 2 * fleet.reach + HALO
    corner, of_frame = np.unique(
        np.floor(fleet.xy / size).astype(np.int64), axis=0, return_inverse=True
    )
    pairs = cKDTree(corner).query_pairs(1.0, p=np.inf, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(corner), len(corner)))
    label: Int = connected_components(graph, directed=False)[1].astype(np.int64)
    return label[of_frame.ravel()]


def _squares(fleet: _Fleet, side: float) -> list[tuple[Box | None, Int, Int]]:
    """Of every region its box or None, the frames that stand in it, and those that see it."""
    out: list[tuple[Box | None, Int, Int]] = []
    component = _components(fleet)
    for frames in _groups(component, np.arange(len(component)), int(component.max()) + 1):
        xy = fleet.xy[frames]
        if (np.ptp(xy, axis=0) <= side).all():
            out.append((None, frames, frames))
            continue
        corner, square = np.unique(
            np.floor(xy / side).astype(np.int64), axis=0, return_inverse=True
        )
        groups = _groups(square.ravel(), frames, len(corner))
        number = {(int(x), int(y)): k for k, (x, y) in enumerate(corner)}
        far = fleet.reach + HALO
        around = range(-int(np.ceil(far / side)), int(np.ceil(far / side)) + 1)
        for (x, y), k in number.items():
            box = (x * side, y * side, (x + 1) * side, (y + 1) * side)
            hood = [
                number[p] for p in ((x + i, y + j) for i in around for j in around) if p in number
            ]
            near = np.concatenate([groups[h] for h in hood])
            away = np.maximum(np.array(box[:2]) - fleet.xy[near], fleet.xy[near] - box[2:])
            out.append((box, groups[k], near[np.hypot(*np.maximum(away, 0.0).T) <= far]))
    return out


def _in_reach(fleet: _Fleet, prior: Sequence[Element], size: float) -> tuple[Int, Int]:
    """Pairs of a cell and an element that frames in the cell may see."""
    if not prior:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    tree = shapely.STRtree([shapely.LineString(e.xy) for e in prior])
    found = tree.query(
        shapely.points(fleet.centres),
        predicate="dwithin",
        distance=fleet.reach + ASIDE + size,
    )
    return found[0].astype(np.int64), found[1].astype(np.int64)


def _parts(fleet: _Fleet, frames: Int) -> tuple[tuple[Path, NDArray[Any] | None], ...]:
    """The frames by run; runs that are read whole without a list."""
    first = np.cumsum([0, *(len(t) for t in fleet.tracks)])
    out: list[tuple[Path, NDArray[Any] | None]] = []
    for k in np.unique(fleet.run[frames]):
        track = fleet.tracks[k]
        rows = frames[fleet.run[frames] == k] - first[k]
        out.append((track.path, None if len(rows) == len(track) else np.sort(track.frame[rows])))
    return tuple(out)
