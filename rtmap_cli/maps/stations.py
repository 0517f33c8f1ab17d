"""Lines as stations about a metre apart, and detections assigned to them exclusively.

Vertices of two drives never sample the same physical point: a detection is compared with a line,
not with its vertices. A station carries a position, a unit tangent and the chain that it belongs
to; lines cut for storage which share an end vertex form one chain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.keys import numbered
from rtmap_cli.geometry.polylines import arc_length, is_ring
from rtmap_cli.maps.nearby import Nearby, nearby
from rtmap_cli.maps.strands import strands_of

Array = NDArray[np.float64]
Int = NDArray[np.int64]

STEP = 1.0
"""Distance of stations along a line, metres."""
GATE = 1.5
"""A detection farther than this (m) from a line does not belong to it."""
MIN_COS = 0.80
"""Least cosine between the directions of a detection and a line (about 37°)."""
HAIRPIN = 3.0
"""A detection that turns back within such a way (m) has two sides."""
MIN_STRETCH = 3.0
"""Shortest part of a detection (m) that can be assigned to a line on its own."""


@dataclass(frozen=True)
class Stations:
    """Stations of the lines of one class.

    ``xy`` (n, 2), ``tangent`` (n, 2); ``line`` (n,) index of the line, ``s`` (n,) arc length on
    it (m), ``chain`` (n,) of the line, ``spacing`` (n,) metres that a station stands for,
    ``to_end`` (n,) distance along the chain to its nearest open end (inf on rings).
    """

    xy: Array
    tangent: Array
    line: Int
    s: Array
    chain: Int
    spacing: Array
    to_end: Array
    lines: list[Array] = field(repr=False)
    grids: dict[float, Nearby] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.xy)

    @cached_property
    def normal(self) -> Array:
        """(n, 2) unit normals to the left of the tangents."""
        return np.stack([-self.tangent[:, 1], self.tangent[:, 0]], axis=-1)

    @cached_property
    def tree(self) -> Any:
        """KD-tree of the stations: all drives ask for it."""
        from scipy.spatial import cKDTree

        return cKDTree(self.xy)

    @cached_property
    def strand(self) -> Int:
        """(n,) like ``chain``, but cut where a chain folds back to itself."""
        return strands_of(self.xy, self.tangent, self.s, self.line, self.chain)

    def near(self, gate: float) -> Nearby:
        """The stations near points; points within ``gate`` (m) of a line find it."""
        if gate not in self.grids:
            reach = float(np.hypot(gate, STEP))
            self.grids[gate] = nearby(self.xy, self.tangent, self.s, self.line, reach)
        return self.grids[gate]

    def same(self, other: Stations) -> bool:
        """True for the same stations of the same lines."""
        return self is other or (
            np.array_equal(self.line, other.line) and np.array_equal(self.xy, other.xy)
        )

    def of_line(self, k: int) -> Int:
        """Indices of the stations of line ``k`` in order (they lie together)."""
        a, b = np.searchsorted(self.line, [k, k + 1])
        return np.arange(a, b)


@dataclass(frozen=True)
class Samples:
    """Points along detections: ``detection`` (n,) number of it (the two sides of a hairpin have two
    numbers), ``xy`` (n, 2), ``tangent`` (n, 2), ``spacing``
    (n,) metres that each stands for, ``covariance`` (n, 2, 2), ``score`` (n,), ``frame`` (n,)."""

    detection: Int
    xy: Array
    tangent: Array
    spacing: Array
    covariance: Array
    score: Array
    frame: Int
    last: list[Any] = field(default_factory=list, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.xy)

    @cached_property
    def planar(self) -> Array:
        """(3, n) xx, xy, yy of the covariances, each in a row of its own (m²)."""
        return np.ascontiguousarray(self.covariance.reshape(-1, 4)[:, [0, 1, 3]].T)

    @cached_property
    def across_sigma(self) -> Array:
        """(n,) standard deviation of each sample across its own detection, metres."""
        tx, ty = self.tangent.T
        xx, xy, yy = self.planar
        return np.asarray(np.sqrt(ty * ty * xx - 2 * tx * ty * xy + tx * tx * yy))


@dataclass(frozen=True)
class Feet:
    """Samples assigned to lines: ``sample``, ``station`` (k,), signed ``offset`` to the left of
    the line and ``along`` from the station, metres."""

    sample: Int
    station: Int
    offset: Array
    along: Array

    def __len__(self) -> int:
        return len(self.sample)


def chains_of(lines: Sequence[Array], tolerance: float = 0.02) -> Int:
    """(n,) chain number of each line: lines joined where exactly two open ends meet."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    count = len(lines)
    owner = np.array([k for k in range(count) if not is_ring(lines[k]) for _ in (0, 1)], np.int64)
    if len(owner) < 2:
        return np.arange(count)
    ends = np.array([p for x in lines if not is_ring(x) for p in (x[0, :2], x[-1, :2])])
    tree = cKDTree(ends)
    pairs = tree.query_pairs(tolerance, output_type="ndarray")
    degree = np.bincount(pairs.ravel(), minlength=len(ends))
    pairs = pairs[(degree[pairs] == 1).all(axis=1)] if len(pairs) else pairs
    graph = coo_matrix(
        (np.ones(len(pairs)), (owner[pairs[:, 0]], owner[pairs[:, 1]])), shape=(count, count)
    )
    return connected_components(graph, directed=False)[1].astype(np.int64)


def stations_of(lines: Sequence[Array], step: float = STEP) -> Stations:
    """Stations at most ``step`` apart on every line, both ends included."""
    chain = chains_of(lines)
    xy, tangent, line, s, spacing = [], [], [], [], []
    for k, points in enumerate(lines):
        p = np.asarray(points, np.float64)[:, :2]
        keep = np.concatenate([[True], np.hypot(*np.diff(p, axis=0).T) > 1e-6])
        p = p[keep] if keep.sum() > 1 else p[:2]
        at = arc_length(p)
        n = max(2, int(np.ceil(at[-1] / step - 1e-9)) + 1)
        places = np.linspace(0.0, at[-1], n)
        xy.append(np.stack([np.interp(places, at, p[:, 0]), np.interp(places, at, p[:, 1])], -1))
        # A chord of a metre gives the direction; at the ends it is one-sided.
        reach = min(0.5, max(at[-1], 1e-6) / 2)
        a, b = np.clip(places - reach, 0, at[-1]), np.clip(places + reach, 0, at[-1])
        d = np.stack([np.interp(b, at, p[:, i]) - np.interp(a, at, p[:, i]) for i in (0, 1)], -1)
        tangent.append(d / np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-9)[:, None])
        line.append(np.full(n, k))
        s.append(places)
        gap = at[-1] / (n - 1)
        spacing.append(np.where((np.arange(n) == 0) | (np.arange(n) == n - 1), gap / 2, gap))
    if not xy:
        empty = np.zeros(0)
        none = np.zeros(0, np.int64)
        return Stations(np.zeros((0, 2)), np.zeros((0, 2)), none, empty, none, empty, empty, [])
    lines_index = np.concatenate(line).astype(np.int64)
    places_all = np.concatenate(s)
    return Stations(
        np.concatenate(xy),
        np.concatenate(tangent),
        lines_index,
        places_all,
        chain[lines_index],
        np.concatenate(spacing),
        _to_end(lines, chain, lines_index, places_all),
        [np.asarray(x) for x in lines],
    )


def _to_end(lines: Sequence[Array], chain: Int, line: Int, s: Array) -> Array:
    """Distance of each station to the nearest end of its line that no line of its chain meets."""
    total = np.array([arc_length(x)[-1] for x in lines])
    free = np.zeros((len(lines), 2), bool)
    by_chain: dict[int, list[Array]] = {}
    for k, x in enumerate(lines):
        by_chain.setdefault(int(chain[k]), []).extend([x[0, :2], x[-1, :2]])
    for k, x in enumerate(lines):
        if is_ring(x):
            continue
        others = np.array(by_chain[int(chain[k])])
        for e, p in enumerate((x[0, :2], x[-1, :2])):
            free[k, e] = (np.hypot(*(others - p).T) < 0.05).sum() == 1
    start = np.where(free[line, 0], s, np.inf)
    end = np.where(free[line, 1], total[line] - s, np.inf)
    return np.minimum(start, end)


def samples_of(points: Array, covariance: Array, score: Array, frame: Int) -> Samples:
    """Vertices and segment midpoints of detections (n, V, 2) with (n, V, 2, 2) covariances."""
    n, v = points.shape[:2]
    if not n:
        z = np.zeros(0)
        i = np.zeros(0, np.int64)
        return Samples(i, np.zeros((0, 2)), np.zeros((0, 2)), z, np.zeros((0, 2, 2)), z, i)
    k = 2 * v - 1
    xy, cov = np.empty((n, k, 2)), np.empty((n, k, 2, 2))
    xy[:, ::2], cov[:, ::2] = points, covariance
    xy[:, 1::2] = (points[:, 1:] + points[:, :-1]) / 2
    cov[:, 1::2] = (covariance[:, 1:] + covariance[:, :-1]) / 2
    # Noise of single vertices must not turn the direction: chords over about two metres.
    step = np.hypot(*np.moveaxis(np.diff(xy, axis=1), -1, 0))
    reach = np.clip(np.round(1.0 / np.maximum(step.mean(axis=1), 1e-3)), 2, v // 2).astype(int)
    index = np.arange(k)
    ahead = np.minimum(index + reach[:, None], k - 1)
    behind = np.maximum(index - reach[:, None], 0)
    rows = np.arange(n)[:, None]
    d = xy[rows, ahead] - xy[rows, behind]
    tangent = d / np.maximum(np.hypot(d[..., 0], d[..., 1]), 1e-9)[..., None]
    spacing = np.zeros((n, k))
    spacing[:, 1:] += step / 2
    spacing[:, :-1] += step / 2
    return Samples(
        np.repeat(np.arange(n), k) + np.cumsum(_hairpins(xy, step).ravel()),
        xy.reshape(-1, 2),
        tangent.reshape(-1, 2),
        spacing.ravel(),
        cov.reshape(-1, 2, 2),
        np.repeat(score, k),
        np.repeat(frame, k),
    )


def _hairpins(xy: Array, step: Array) -> NDArray[np.bool_]:
    """(n, k) True at the first sample after a turn of more than 120° within some metres.

    The two sides of a narrow island come in one detection, but are two lines.
    """
    out = np.zeros(step.shape[:1] + (step.shape[1] + 1,), bool)
    # Where every step is within 60° of the chord, no two parts differ by more than 120°.
    chord = xy[:, -1] - xy[:, 0]
    ahead = np.diff(xy[..., 0], axis=1) * chord[:, :1] + np.diff(xy[..., 1], axis=1) * chord[:, 1:]
    bent = np.flatnonzero((ahead <= 0.5 * step * np.hypot(*chord.T)[:, None]).any(axis=1))
    if len(bent):
        out[bent] = _turns(xy[bent], step[bent])
    return out


def _turns(xy: Array, step: Array) -> NDArray[np.bool_]:
    """``_hairpins`` of detections that do not run straight on."""
    n, k = xy.shape[:2]
    reach = np.clip(np.round(HAIRPIN / np.maximum(step.mean(axis=1), 1e-3)), 2, k // 3).astype(int)
    index, rows = np.arange(k), np.arange(n)[:, None]
    ahead, behind = index + reach[:, None], index - reach[:, None]
    inside = (behind >= 0) & (ahead < k)
    a = xy[rows, np.minimum(ahead, k - 1)] - xy
    b = xy - xy[rows, np.maximum(behind, 0)]
    size = np.hypot(a[..., 0], a[..., 1]) * np.hypot(b[..., 0], b[..., 1])
    cosine = np.where(inside, (a * b).sum(-1) / np.maximum(size, 1e-9), 1.0)
    sharp = cosine < -0.5
    out = np.zeros((n, k), bool)
    for i in np.flatnonzero(sharp.any(axis=1)):
        # Of the samples around a turn the sharpest one parts the sides.
        around = np.flatnonzero(sharp[i])
        for turn in np.split(around, np.flatnonzero(np.diff(around) > 1) + 1):
            out[i, turn[cosine[i, turn].argmin()]] = True
    return out


def candidate_feet(
    stations: Stations, samples: Samples, gate: float, unit: Int | None = None
) -> tuple[Int, Int, Array, Array]:
    """Best foot of each sample on each chain, or ``unit`` (n,) of stations, in reach: sample,
    station, offset, along."""
    unit = stations.chain if unit is None else unit
    i, j, along, offset = stations.near(gate).feet(samples.xy)
    ok = np.flatnonzero((np.abs(offset) <= gate) & (np.abs(along) <= STEP))
    i, j = i[ok], j[ok]
    tx, ty = stations.tangent.take(j, axis=0).T
    sx, sy = samples.tangent.take(i, axis=0).T
    aligned = np.flatnonzero(np.abs(sx * tx + sy * ty) >= MIN_COS)
    i, j, ok = i[aligned], j[aligned], ok[aligned]
    along, offset = along[ok], offset[ok]
    same = i[1:] == i[:-1]
    twice = np.flatnonzero(np.append(same, False) | np.insert(same, 0, False))
    if len(twice):
        # Of two feet on one chain the nearest one counts, or else the first station.
        i2, j2, far = i[twice], j[twice], (along**2 + offset**2)[twice]
        order = np.lexsort((j2, far, unit[j2], i2))
        key = np.stack([i2, unit[j2]])[:, order]
        again = (key[:, 1:] == key[:, :-1]).all(axis=0)
        keep = np.ones(len(i), bool)
        keep[twice[order[1:][again]]] = False
        i, j, along, offset = i[keep], j[keep], along[keep], offset[keep]
    return i, j, offset, along


def assign(
    stations: Stations, samples: Samples, gate: float = GATE, rounds: int = 3
) -> tuple[Feet, NDArray[np.bool_]]:
    """Assign each stretch of every detection to one chain, and say which samples found one.

    A detection goes to the chain of lowest mean truncated offset, Σ spacing · (gate − |offset|);
    what that chain does not cover goes to the next one, for ``rounds`` rounds: a detection may
    run over several lines but no sample counts twice. The last answer is remembered.
    """
    if samples.last and samples.last[0][1:] == (gate, rounds) and stations.same(samples.last[0][0]):
        return samples.last[1]
    found = _assigned(stations, samples, gate, rounds)
    samples.last[:] = [(stations, gate, rounds), found]
    return found


def _assigned(
    stations: Stations, samples: Samples, gate: float, rounds: int
) -> tuple[Feet, NDArray[np.bool_]]:
    taken = np.zeros(len(samples), bool)
    nothing = Feet(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    if not len(stations) or not len(samples):
        return nothing, taken
    i, j, offset, along = candidate_feet(stations, samples, gate)
    chains = int(stations.chain.max()) + 1
    keys, inverse = numbered(samples.detection[i] * chains + stations.chain[j])
    owner = keys // chains
    spacing = samples.spacing[i]
    value = spacing * (gate - np.abs(offset))
    total = np.bincount(samples.detection, samples.spacing)
    least = np.minimum(MIN_STRETCH, 0.6 * total[owner])
    parts: list[Int] = []
    left = np.arange(len(i))
    for _ in range(rounds):
        gain = np.bincount(inverse, value, len(keys))
        cover = np.bincount(inverse, spacing, len(keys))
        enough = (cover >= least) & (cover > 0)
        order = np.lexsort((keys, -np.where(enough, gain, -1.0), owner))
        best = np.zeros(len(keys), bool)
        best[order] = np.concatenate([[True], owner[order][1:] != owner[order][:-1]])
        chosen = left[(best & enough)[inverse]]
        if not len(chosen):
            break
        parts.append(chosen)
        taken[i[chosen]] = True
        free = np.flatnonzero(~taken[i[left]])
        if not len(free):
            break
        left, inverse, value, spacing = left[free], inverse[free], value[free], spacing[free]
    if not parts:
        return nothing, taken
    k = np.concatenate(parts)
    return Feet(i[k], j[k], offset[k], along[k]), taken


def loose_stretches(samples: Samples, taken: NDArray[np.bool_], shortest: float) -> Int:
    """Indices of the samples in runs of a detection that found no line and are long enough."""
    if not len(samples):
        return np.zeros(0, np.int64)
    new = np.ones(len(samples), bool)
    new[1:] = (samples.detection[1:] != samples.detection[:-1]) | (taken[1:] != taken[:-1])
    run = np.cumsum(new) - 1
    length = np.bincount(run, samples.spacing)
    return np.flatnonzero(~taken & (length[run] >= shortest))


def smoother(stations: Stations, width: float) -> Any:
    """Sparse (n, n) Gaussian weights between stations of a chain, ``width`` (m) one sigma.

    Stations of one chain are neighbours by distance, whatever line they lie on; opposite
    directions do not mix (the two sides of a narrow island).
    """
    from scipy.sparse import coo_matrix

    tree = stations.tree
    near = tree.sparse_distance_matrix(tree, 3 * width, output_type="coo_matrix")
    i, j = near.row, near.col
    same = stations.chain[i] == stations.chain[j]
    same &= (stations.tangent[i] * stations.tangent[j]).sum(-1) > 0.5
    # Neighbouring lines of a chain may run against each other; the sign then flips with them.
    i, j, d = i[same], j[same], near.data[same]
    off = i != j
    i, j, d = i[off], j[off], d[off]
    n = len(stations)
    rows = np.concatenate([i, np.arange(n)])
    columns = np.concatenate([j, np.arange(n)])
    values = np.exp(-0.5 * (np.concatenate([d, np.zeros(n)]) / width) ** 2)
    return coo_matrix((values, (rows, columns)), shape=(n, n)).tocsr()
