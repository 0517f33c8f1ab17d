"""Closed elements: what the drives say about prior rings, and clusters of rings that are new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.rings import align, open_rings, polygons
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.visibility import Views
from rtmap_cli.steps.detect_changes.votes import (
    DriveCounts,
    answer_value,
    count,
    detection_value,
)

Array = NDArray[np.float64]
Int = NDArray[np.int64]

SHARPNESS = 1.5
"""In a mean outline a detection weighs score / variance ** SHARPNESS: its error is mostly shared
with the others, in proportion to its sigma."""
NEAR = 3.5
"""Rings whose features (centre, direction) differ by more than this (m) are different ones."""
SIGMAS = 3.0
"""… unless their own position is known no better than so many standard deviations allow."""
CUT_SHARE = 0.3
"""What a detection that the range cuts counts, against a whole one, where a ring lies."""
VISIBLE = 0.65
"""A ring is in view of a frame when this share of its outline and middle is."""
INSIDE = 0.6
"""A detection with this share of its area in a known ring is a piece of that ring."""
COARSE = 4
"""Every so many-th point of a ring is enough to tell how much two of them share."""
FAR_LOSS = 0.25
"""Share of the detection probability that is lost at 36 m."""
RING_MARGIN = 0.5
"""Border of the range (m) in which the outline does not count as looked at."""


@dataclass(frozen=True)
class Rings:
    """Detected rings of one drive: ``points`` (n, 80, 2) counter-clockwise, ``variance`` (n,) mean
    per axis (m²), ``score``, ``frame``, ``cut`` by the range, ``feature`` (n, 4), ``window``
    (n, 4, 2) corners of the range of its frame in the map frame (None: unlimited)."""

    points: Array
    variance: Array
    score: Array
    frame: Int
    cut: NDArray[np.bool_]
    feature: Array
    window: Array | None = None

    def __len__(self) -> int:
        return len(self.points)


def features(rings: Array) -> Array:
    """(n, 4) centre and direction of rings (n, k, 2): x, y and up to 1.5 m · (cos 2θ, sin 2θ).

    The direction of the longer axis counts as far as the ring is longer than wide; it is noisy
    for small rings, and neighbours at a corner are told apart by their centres.
    """
    centre = rings.mean(axis=1)
    d = rings - centre[:, None]
    xx, yy = (d[..., 0] ** 2).mean(1), (d[..., 1] ** 2).mean(1)
    xy = (d[..., 0] * d[..., 1]).mean(1)
    long = np.hypot((xx - yy) / 2, xy)
    share = 1.5 * long / np.maximum((xx + yy) / 2, 1e-9)
    angle = np.arctan2(2 * xy, xx - yy)
    return np.column_stack([centre, share * np.cos(angle), share * np.sin(angle)])


def class_rings(traversal: Traversal, class_name: str) -> Rings:
    """A drive's detections of a closed class in the map frame."""
    index = np.flatnonzero(traversal.class_name == class_name)
    points = open_rings(traversal.points[index])
    variance = traversal.covariance[index]
    return Rings(
        points,
        (variance[..., 0, 0] + variance[..., 1, 1]).mean(axis=1) / 2,
        traversal.score[index],
        traversal.frame[index],
        traversal.cut[index],
        features(points) if len(index) else np.zeros((0, 4)),
        traversal.windows(traversal.frame[index]),
    )


def _near(variance: Array) -> Array:
    """(n,) farthest features of the ring that detections of a variance (m²) may belong to."""
    return np.clip(SIGMAS * np.sqrt(variance), NEAR, 2 * NEAR)


def match(rings: Rings, places: Array, first: int = 0) -> Int:
    """(n,) index of the place (m, 80, 2) that each detection belongs to, or -1.

    The nearest in the feature space within ``NEAR``, or ``SIGMAS`` of the detection where that is
    more; one frame sees a place once, by its nearest detection. The ``first`` places choose before
    the others. A piece of a place belongs to it, too, although its centre is not the centre of the
    element: where it overlaps it, or is what the range leaves of it.
    """
    out = np.full(len(rings), -1)
    if not len(places) or not len(rings):
        return out
    from scipy.spatial import cKDTree

    gate = _near(rings.variance)
    near = cKDTree(rings.feature).sparse_distance_matrix(
        cKDTree(features(places)), 2 * NEAR, output_type="ndarray"
    )
    near = near[near["v"] <= gate[near["i"]]]
    i, j = near["i"], near["j"]
    later = j >= first if first else np.zeros(len(j), bool)
    order = np.lexsort((j, i, near["v"], later))
    owner, taken = out.tolist(), set[tuple[int, int]]()
    frame = rings.frame[i[order]].tolist()
    for ring, place, at in zip(i[order].tolist(), j[order].tolist(), frame, strict=True):
        if owner[ring] < 0 and (at, place) not in taken:
            owner[ring] = place
            taken.add((at, place))
    out = np.array(owner, np.int64)
    for pieces in (_overlapping, _cut_places):
        left = np.flatnonzero(out < 0)
        if len(left):
            out[left] = pieces(rings, left, gate[left], places)
    return out


def _overlapping(rings: Rings, rows: Int, gate: Array, places: Array) -> Int:
    """(k,) which place each of the detections ``rows`` overlaps by 15 % of the union or lies in
    with `INSIDE` of its own area, or -1; ``gate`` does not matter."""
    out = np.full(len(rows), -1)
    centres, radius = places.mean(axis=1), np.ptp(places, axis=1).max(axis=1)
    reach = np.hypot(*np.moveaxis(rings.feature[rows, None, :2] - centres, -1, 0))
    near = (reach < radius) & _boxes_meet(_boxes(rings.points[rows]), _boxes(places))
    k, j = np.nonzero(near)
    if not len(k):
        return out
    some, one = np.unique(k, return_inverse=True)
    them, other = np.unique(j, return_inverse=True)
    mine = polygons(rings.points[rows[some], ::COARSE])[one]
    theirs = polygons(places[them, ::COARSE])[other]
    common, own, other = shapely.area(np.stack([shapely.intersection(mine, theirs), mine, theirs]))
    share = common / np.maximum(own + other - common, 1e-12)
    within = common / np.maximum(own, 1e-12)
    meets = np.asarray((share >= 0.15) | (within >= INSIDE), bool)
    some = np.unique(k[meets])
    # Of those that it overlaps it belongs to the one that holds most of it.
    order = np.lexsort((j, -within, k))
    out[some] = j[order[np.searchsorted(k[order], some)]]
    return out


def _boxes(rings: Array) -> Array:
    """(n, 4) low and high corners of rings (n, k, 2)."""
    return np.concatenate([rings.min(axis=1), rings.max(axis=1)], axis=-1)


def _boxes_meet(boxes: Array, others: Array) -> NDArray[np.bool_]:
    """(n, m) whether boxes (n, 4) have anything in common with others (m, 4)."""
    low = np.maximum(boxes[:, None, :2], others[:, :2])
    high = np.minimum(boxes[:, None, 2:], others[:, 2:])
    return np.asarray((low <= high).all(axis=-1))


def _hold(windows: Array, boxes: Array) -> NDArray[np.bool_]:
    """(n,) whether each counter-clockwise rectangle (n, 4, 2) holds all of its box (n, 4)."""
    side = np.roll(windows, -1, axis=1) - windows
    corners = boxes[:, [[0, 1], [2, 1], [2, 3], [0, 3]]]
    d = corners[:, :, None] - windows[:, None]
    left = side[:, None, :, 0] * d[..., 1] - side[:, None, :, 1] * d[..., 0]
    return np.asarray((left >= 0).all(axis=(1, 2)))


def _cut_places(rings: Rings, rows: Int, gate: Array, places: Array) -> Int:
    """(k,) which place each of the detections ``rows`` is what the range leaves of, or -1: the
    place whose part in the range has its middle nearest to the detection's, within ``gate``."""
    out = np.full(len(rows), -1)
    if rings.window is None:
        return out
    middle, box = rings.feature[rows, :2], _boxes(places)
    # The middle of a part of a place lies in the place's box.
    away = np.maximum(box[:, :2] - middle[:, None], middle[:, None] - box[:, 2:]).max(axis=-1)
    k, j = np.nonzero(away < gate[:, None])
    cut = ~_hold(rings.window[rows[k]], box[j])
    k, j = k[cut], j[cut]
    if not len(k):
        return out
    window = shapely.polygons(rings.window[rows])
    them = np.unique(j)
    whole = np.zeros(len(places), object)
    whole[them] = polygons(places[them])
    part = shapely.intersection(whole[j], window[k])
    area = shapely.area(part)
    # A place that lies wholly in the range would have been seen whole.
    cut = (area > 1.0) & (area < 0.9 * shapely.area(whole[j]))
    k, j, part = k[cut], j[cut], part[cut]
    away = np.hypot(*(shapely.get_coordinates(shapely.centroid(part)) - middle[k]).T)
    near = away < gate[k]
    k, j, away = k[near], j[near], away[near]
    order = np.lexsort((j, away, k))
    some, first = np.unique(k[order], return_index=True)
    out[some] = j[order][first]
    return out


def new_rings(prior: Array, drives: Sequence[Rings], least: float = 0.8) -> Array:
    """(m, 80, 2) mean rings of detections that no prior ring explains; not yet judged.

    Greedy clusters by support (Σ score of the neighbours), then means with reassignment, twice.
    Clusters with a summed score below ``least`` are noise. Detections cut by the range come
    second: they speak for crossings that are longer than the range and never seen whole.
    """
    found = prior[:0]
    for cut in (False, True):
        known = np.concatenate([prior, found])
        keep = [(match(r, known) < 0) & (r.cut | (not cut)) for r in drives]
        parts = [
            (
                r.points[k],
                r.feature[k],
                r.score[k] * np.where(r.cut[k] & (not cut), CUT_SHARE, 1.0),
                r.variance[k],
            )
            for r, k in zip(drives, keep, strict=True)
        ]
        points, feature, score, variance = (np.concatenate(p) for p in zip(*parts, strict=True))
        if len(points):
            found = np.concatenate([found, _means(points, feature, score, variance, least)])
    return found


def _means(points: Array, feature: Array, score: Array, variance: Array, least: float) -> Array:
    """Mean rings of the clusters, twice reassigned to the nearest one."""
    weight, near = score / np.maximum(variance, 0.01) ** SHARPNESS, _near(variance)
    groups = _clusters(feature, score, least)
    means = points[:0]
    for k in range(3):
        means = np.array([_mean(points[g], weight[g]) for g in groups]).reshape(
            -1, *points.shape[1:]
        )
        if not len(means) or k == 2:
            break
        means = _apart(means)
        distance, owner = _nearest(features(means), feature)
        groups = [np.flatnonzero((owner == i) & (distance <= near)) for i in range(len(means))]
        groups = [g for g in groups if len(g) and score[g].sum() >= least]
    return means


def _nearest(places: Array, feature: Array) -> tuple[Array, Int]:
    from scipy.spatial import cKDTree

    distance, index = cKDTree(places).query(feature)
    return distance, index


def _clusters(feature: Array, score: Array, least: float) -> list[Int]:
    """Groups of detections around those with most support, best first, each one used once."""
    from scipy.spatial import cKDTree

    near = [np.asarray(k) for k in cKDTree(feature).query_ball_point(feature, 0.7 * NEAR)]
    free = np.ones(len(feature), bool)
    support = np.array([score[k].sum() for k in near])
    out = []
    for k in np.argsort(-support, kind="stable"):
        if not free[k]:
            continue
        group = near[k][free[near[k]]]
        if score[group].sum() < least:
            continue
        free[group] = False
        out.append(group)
    return out


def _mean(rings: Array, weight: Array) -> Array:
    """Weighted mean ring: aligned to the heaviest one, then to their mean."""
    reference = rings[int(weight.argmax())]
    for _ in range(2):
        aligned = align(rings, reference)
        reference = (aligned * weight[:, None, None]).sum(0) / weight.sum()
    return reference


def _apart(means: Array) -> Array:
    """Means without those that overlap an earlier (better supported) one by a third, or lie within
    ``NEAR`` of it: one crossing that a drive saw a little off must not compete with itself."""
    shapes, places, boxes = polygons(means[:, ::COARSE]), features(means), _boxes(means)
    area = shapely.area(shapes)
    keep: list[int] = []
    for k in range(len(means)):
        others = np.array(keep, np.int64)
        if (np.hypot(*(places[k] - places[others])[:, :2].T) <= NEAR).any() and (
            np.hypot.reduce(places[k] - places[others], axis=1) <= NEAR
        ).any():
            continue
        near = others[_boxes_meet(boxes[k : k + 1], boxes[others])[0]]
        common = shapely.area(shapely.intersection(shapes[k], shapes[near]))
        if (common < 0.3 * (area[k] + area[near] - common)).all():
            keep.append(k)
    return means[keep]


def _ring_views(places: Array, traversal: Traversal) -> tuple[Views, Array]:
    """Frames that could see each ring, and the weight of each view."""
    outline = places[:, :: max(places.shape[1] // 16, 1)]
    points = np.concatenate([outline, places.mean(axis=1, keepdims=True)], axis=1)
    pose = traversal.pose
    # Of a ring that is seen whole enough the middle is in the range, or nearly so.
    room = np.ptp(places, axis=1).max(axis=1, initial=0.0) / 2
    c, s = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    dx, dy = (points[:, -1, k] - pose[:, k, None] for k in (0, 1))
    x, y = c * dx + s * dy, c * dy - s * dx
    x0, y0, x1, y1 = traversal.range_m
    near = (x >= x0 - room) & (x <= x1 + room) & (y >= y0 - room) & (y <= y1 + room)
    frame, ring = np.nonzero(near)
    distance = traversal.outlook.clear(frame[:, None], points[ring], RING_MARGIN)
    seen = distance >= 0
    share = seen.mean(axis=1)
    ok = share >= VISIBLE
    share, far = share[ok], np.where(seen, distance, 0.0)[ok].sum(axis=1) / seen[ok].sum(axis=1)
    loss = 1.0 - FAR_LOSS * np.minimum(far / 36.0, 1.0) ** 2
    return Views(frame[ok], ring[ok], far), np.minimum(share + 0.2, 1.0) * loss


def ring_counts(
    places: Array,
    ids: Sequence[str],
    traversals: Sequence[Traversal],
    drives: Sequence[Rings],
    first: int = 0,
) -> tuple[list[DriveCounts], list[Int]]:
    """Counts of every drive on closed elements ``places`` (n, 80, 2) with element ``ids``, and to
    which of them its detections belong; the ``first`` places choose before the others."""
    n = len(places)
    row = {name: k for k, name in enumerate(ids)}
    counts: list[DriveCounts] = []
    owners: list[Int] = []
    for traversal, rings in zip(traversals, drives, strict=True):
        seen, weight = _ring_views(places, traversal)
        owner = match(rings, places, first)
        owners.append(owner)
        hit = owner >= 0
        asked = traversal.asked
        known = np.array([row.get(name, -1) for name in asked.element_id], np.int64)
        asked_key = (asked.frame * n + known)[known >= 0]
        key = np.concatenate([rings.frame[hit] * n + owner[hit], asked_key])
        score = [rings.score[hit], asked.existence[known >= 0]]
        value = np.concatenate([detection_value(score[0]), answer_value(score[1])])
        counts.append(count(n, seen, weight, key, value, np.concatenate(score), asked_key))
    return counts, owners
