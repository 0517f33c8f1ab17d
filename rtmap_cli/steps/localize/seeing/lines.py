"""Map lines as samples with directions, and the association of vertices with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.geometry.polylines import arc_length, is_ring, length
from rtmap_cli.maps.element import Element, VectorMap

Array = NDArray[np.float64]

SAMPLE_STEP_M = 0.5
_APART = 1.0e4
"""Metres between two classes (or chains) in the search tree: they never meet."""


@dataclass(frozen=True)
class Match:
    """Where vertices fall on the map: ``sample`` (...) indices, -1 where nothing is near.

    ``normal``, ``tangent`` (..., 2) of the line; ``across``, ``along`` (...) metres from the foot.
    """

    sample: NDArray[np.int64]
    normal: Array
    tangent: Array
    across: Array
    along: Array

    @property
    def found(self) -> NDArray[np.bool_]:
        """(...) True where a line is near."""
        return self.sample >= 0


class MapLines:
    """The lines of a map as samples every half metre, in coordinates relative to ``origin``.

    ``xy``, ``tangent`` (S, 2); ``element_id`` (S,); ``class_code`` (S,) into ``classes``;
    ``chain`` (S,): pieces of one class which share an end are one chain; ``open_end`` (S,): the
    sample is the end of a line that goes on nowhere; ``variance`` (S,): mean variance of the map
    per axis, NaN where unknown.
    """

    def __init__(
        self, vector_map: VectorMap, classes: list[str], origin: Array, heading_weight_m: float
    ) -> None:
        self.classes, self.origin, self.weight = classes, origin, heading_weight_m
        elements = [e for e in vector_map if e.class_name in classes and length(e.points) > 0.01]
        sampled = [_sample(e, origin) for e in elements]
        self.count = sum(len(s[0]) for s in sampled)
        self.chain_of_id: dict[str, int] = {}
        if not elements:
            return
        self.xy, self.tangent, self.variance = (
            np.concatenate(column) for column in zip(*sampled, strict=True)
        )
        sizes = [len(s[0]) for s in sampled]
        element = np.repeat(np.arange(len(elements)), sizes)
        self.class_code = np.array([classes.index(e.class_name) for e in elements])[element]
        self.element_id = np.array([e.element_id for e in elements], object)[element]
        chains, free = _chains(elements, origin)
        self.chain = chains[element]
        self.chain_of_id = {e.element_id: int(chains[k]) for k, e in enumerate(elements)}
        last = np.cumsum(sizes) - 1
        self.open_end = np.zeros(self.count, bool)
        self.open_end[last - np.array(sizes) + 1] = free[:, 0]
        self.open_end[last] = free[:, 1]
        self.class_tree = cKDTree(self._embed(self.xy, self.tangent, self.class_code))
        self.chain_tree = cKDTree(self._embed(self.xy, self.tangent, self.chain))

    def _embed(self, xy: Array, tangent: Array, key: NDArray[np.int64]) -> Array:
        c, s = tangent[:, 0], tangent[:, 1]
        half = 0.5 * self.weight
        # (cos 2θ, sin 2θ): a line has no direction of travel.
        return np.column_stack([xy, half * (c * c - s * s), half * 2.0 * c * s, key * _APART])

    def match(
        self,
        points: Array,
        tangent: Array,
        class_code: NDArray[np.int64],
        chain: NDArray[np.int64],
        reach_m: float,
    ) -> Match:
        """The nearest line of the same class in (x, y, direction) for (n, 2) vertices.

        Where ``chain`` (n,) is not -1 only that chain is searched (the detection says which
        element it is). A vertex beyond the open end of a line has no foot.
        """
        n = len(points)
        sample = np.full(n, -1, np.int64)
        for tree, key, rows in (
            (self.class_tree, class_code, np.flatnonzero(chain < 0)),
            (self.chain_tree, chain, np.flatnonzero(chain >= 0)),
        ):
            if len(rows):
                query = self._embed(points[rows], tangent[rows], key[rows])
                _, index = tree.query(query, distance_upper_bound=reach_m)
                sample[rows] = np.where(index < self.count, index, -1)
        known = np.where(sample < 0, 0, sample)
        t = self.tangent[known]
        d = points - self.xy[known]
        along = (t * d).sum(-1)
        beyond = self.open_end[known] & (np.abs(along) > SAMPLE_STEP_M)
        sample[beyond] = -1
        normal = np.stack([-t[:, 1], t[:, 0]], axis=-1)
        return Match(sample, normal, t, (normal * d).sum(-1), along)


def _sample(element: Element, origin: Array) -> tuple[Array, Array, Array]:
    """Samples (n, 2), ends included, directions of their segments (n, 2), variances (n,)."""
    xy = element.xy - origin
    variance = np.full(len(xy), np.nan)
    if element.covariance is not None:
        variance = 0.5 * (element.covariance[:, 0] + element.covariance[:, 2])
    keep = np.append(True, np.hypot(*np.diff(xy, axis=0).T) > 1e-6)
    xy, variance = xy[keep], variance[keep]
    s = arc_length(xy)
    at = np.linspace(0.0, s[-1], max(2, int(np.ceil(s[-1] / SAMPLE_STEP_M)) + 1))
    segment = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(s) - 2)
    direction = (np.diff(xy, axis=0) / np.diff(s)[:, None])[segment]
    points = xy[segment] + (at - s[segment])[:, None] * direction
    return points, direction, np.interp(at, s, variance)


def _chains(elements: list[Element], origin: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Chain of each element (n,), and which of its two ends (n, 2) meet no other line."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(elements)
    ends = np.array([e.xy[k] - origin for e in elements for k in (0, -1)])
    code = {c: i for i, c in enumerate(dict.fromkeys(e.class_name for e in elements))}
    key = np.repeat([code[e.class_name] for e in elements], 2) * _APART
    pairs = cKDTree(np.column_stack([ends, key])).query_pairs(0.02, output_type="ndarray")
    pairs = pairs[(pairs // 2)[:, 0] != (pairs // 2)[:, 1]]
    free = np.ones(2 * n, bool)
    free[pairs.ravel()] = False
    rings = np.array([is_ring(e.points) for e in elements])
    free = free.reshape(n, 2) & ~rings[:, None]
    a, b = (pairs // 2).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64), free
