"""From a scene to a training sample: the truth in range, a wrong prior, the targets.

A scene is the elements around one frame in its true ego frame. The prior is what a map would give
at a wrong pose: the scene seen from the *noisy* ego frame and clipped there (clipping in the true
frame would betray the pose through the cut ends), with elements removed and false ones put in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_models.config import ModelConfig

Array = NDArray[np.float64]

MIN_TRUTH_M = 1.0
"""Shorter pieces of lines are not asked for (evaluation counts them from 0.5 m on)."""

MIN_PRIOR_M = 0.5
MIN_AREA_M2 = 1.0
FIELD_REACH_M = 5.0
"""The offset field is learnt this near to the elements of a class."""

HEAT_POSITIVE = 0.4
"""Cells whose heat exceeds this learn the shape of the element."""


class Scene(NamedTuple):
    """Elements in an ego frame: element k is ``points[offsets[k]:offsets[k + 1]]`` (n, 2)."""

    points: Array
    offsets: NDArray[np.int64]
    classes: NDArray[np.int64]

    def moved(self, matrix: Array, shift: Array) -> Scene:
        """The scene after ``p → matrix p + shift``."""
        return self._replace(points=self.points @ matrix.T + shift)


class Pieces(NamedTuple):
    """Elements clipped to the range: ``points`` (K, V, 2), class, index in the scene, closed."""

    points: Array
    classes: NDArray[np.int64]
    source: NDArray[np.int64]
    closed: NDArray[np.bool_]


@dataclass(frozen=True)
class PriorNoise:
    """How wrong the prior is: standard deviations (metres, degrees) and rates.

    In 40 % of the samples the crop is up to ``margin_m`` wider than the range.
    """

    sigma_m: float = 1.3
    sigma_deg: float = 1.2
    drop: float = 0.15
    fake: float = 0.15
    margin_m: float = 2.0


class Prior(NamedTuple):
    """Prior slots of one sample (K elements).

    ``points`` (K, V, 2) as the network sees them; ``target`` (K, V, 2) the same vertices in the
    true ego frame; ``real`` (K,) False for false elements; ``kept`` the scene elements that the
    prior has; ``delta`` (3,) the pose correction dx, dy, dyaw: true = initial · SE2(delta).
    """

    points: Array
    classes: NDArray[np.int64]
    target: Array
    real: NDArray[np.bool_]
    kept: NDArray[np.int64]
    delta: Array


def rotation(angle: float) -> Array:
    """(2, 2) matrix of a counter-clockwise turn, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def resample(points: Array, count: int) -> Array:
    """``count`` points at equal arc length of an (n, 2) line, ends included."""
    steps = np.hypot(points[1:, 0] - points[:-1, 0], points[1:, 1] - points[:-1, 1])
    s = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, s[-1], count)
    return np.stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])], axis=-1)


def clip(
    scene: Scene, config: ModelConfig, margin: float = 0.0, min_length: float = MIN_TRUTH_M
) -> Pieces:
    """What of a scene lies in the range (widened by ``margin`` metres), V vertices each.

    Pieces of lines shorter than ``min_length`` metres and slivers of rings are dropped. Rings run
    counter-clockwise and repeat their first vertex.
    """
    x0, y0, x1, y1 = config.range_m
    box = (x0 - margin, y0 - margin, x1 + margin, y1 + margin)
    count = len(scene.classes)
    if count == 0:
        return _pieces([], [], [], [], config)
    index = np.repeat(np.arange(count), np.diff(scene.offsets))
    ring = np.isin(scene.classes, config.ring_ids)
    points, classes, source, closed = [], [], [], []
    lines = shapely.linestrings(scene.points[~ring[index]], indices=_dense(index[~ring[index]]))
    for k, shape in zip(np.flatnonzero(~ring), shapely.clip_by_rect(lines, *box), strict=True):
        if shape.is_empty:
            continue
        if shape.geom_type == "MultiLineString":
            shape = shapely.line_merge(shape)
        for part in shapely.get_parts(shape):
            if part.geom_type != "LineString" or part.length < min_length:
                continue
            p = shapely.get_coordinates(part)
            loop = bool(len(p) > 3 and np.abs(p[0] - p[-1]).max() < 0.05)
            points.append(resample(_counter_clockwise(p) if loop else p, config.vertex_count))
            classes.append(scene.classes[k])
            source.append(k)
            closed.append(loop)
    for k in np.flatnonzero(ring):
        p = scene.points[scene.offsets[k] : scene.offsets[k + 1]]
        inside = bool((p >= box[:2]).all() and (p <= box[2:]).all())
        for q in [p] if inside else _clip_polygon(p, box):
            points.append(resample(_counter_clockwise(q), config.vertex_count))
            classes.append(scene.classes[k])
            source.append(k)
            closed.append(True)
    return _pieces(points, classes, source, closed, config)


def _dense(index: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.unique(index, return_inverse=True)[1]


def _pieces(points: list, classes: list, source: list, closed: list, config: ModelConfig) -> Pieces:
    shape = (-1, config.vertex_count, 2)
    return Pieces(
        np.array(points, dtype=np.float64).reshape(shape),
        np.array(classes, dtype=np.int64),
        np.array(source, dtype=np.int64),
        np.array(closed, dtype=bool),
    )


def _clip_polygon(points: Array, box: tuple[float, float, float, float]) -> list[Array]:
    if (points.max(axis=0) < box[:2]).any() or (points.min(axis=0) > box[2:]).any():
        return []
    polygon = shapely.polygons(points)
    if not polygon.is_valid:
        polygon = polygon.buffer(0)
    parts = shapely.get_parts(shapely.clip_by_rect(polygon, *box))
    return [
        shapely.get_coordinates(part.exterior)
        for part in parts
        if part.geom_type == "Polygon" and part.area >= MIN_AREA_M2
    ]


def _counter_clockwise(p: Array) -> Array:
    area = (p[:-1, 0] * p[1:, 1] - p[1:, 0] * p[:-1, 1]).sum()
    return p if area >= 0 else p[::-1]


def equivalent_orders(points: Array, closed: bool) -> Array:
    """(V - 1, V, 2): all orders of the vertices that mean the same element.

    A ring may start anywhere (its direction is fixed); a line runs either way (the two orders
    alternate, so that every element has the same number of them).
    """
    count = len(points) - 1
    if closed:
        start = (np.arange(count)[:, None] + np.arange(count + 1)) % count
        return points[start]
    return np.stack([points if k % 2 == 0 else points[::-1] for k in range(count)])


def make_prior(
    scene: Scene,
    truth: Pieces,
    config: ModelConfig,
    noise: PriorNoise,
    rng: np.random.Generator,
) -> Prior:
    """A wrong prior of a scene (R31–R34 of the paper): noisy pose, removal, false elements."""
    delta = rng.normal(0.0, 1.0, 3) * [noise.sigma_m, noise.sigma_m, np.radians(noise.sigma_deg)]
    turn = rotation(delta[2])
    margin = rng.uniform(0.0, noise.margin_m) if rng.random() < 0.4 else 0.0
    keep = rng.random(len(scene.classes)) >= noise.drop
    # p_initial = SE2(delta) p_true
    seen = clip(scene.moved(turn, delta[:2]), config, margin, MIN_PRIOR_M)
    real = keep[seen.source]
    false = clip(
        _false_elements(scene, truth, config, noise.fake, rng).moved(turn, delta[:2]),
        config,
        margin,
        MIN_PRIOR_M,
    )
    points = np.concatenate([seen.points[real], false.points])
    classes = np.concatenate([seen.classes[real], false.classes])
    kept = np.unique(seen.source[real])
    is_real = np.arange(len(points)) < real.sum()
    order = rng.permutation(len(points))
    if len(order) > config.prior_slots:
        near = np.abs(points / config.half_range).max(axis=-1).min(axis=-1)
        order = rng.permutation(np.argsort(near, kind="stable")[: config.prior_slots])
    p = points[order]
    # Someone else's map may run either way and start its rings anywhere.
    backwards = rng.random(len(p)) < 0.5
    p[backwards] = p[backwards, ::-1]
    target = (p - delta[:2]) @ turn
    return Prior(p, classes[order], target, is_real[order], kept, delta)


def _false_elements(
    scene: Scene, truth: Pieces, config: ModelConfig, rate: float, rng: np.random.Generator
) -> Scene:
    """Copies of real elements where there is none: moved sideways, along, or turned.

    Whole elements are moved and clipped afterwards, so that their ends tell nothing.
    """
    found: list[Array] = []
    classes: list[int] = []
    count = len(truth.classes)
    for _ in range(rng.binomial(max(count, 4), rate) if count else 0):
        k = rng.integers(count)
        source, c = int(truth.source[k]), int(truth.classes[k])
        p = scene.points[scene.offsets[source] : scene.offsets[source + 1]]
        for _ in range(8):
            q = _displaced(p, truth.points[k], c in config.ring_ids, rng)
            one = Scene(q, np.array([0, len(q)]), np.array([c]))
            inside = clip(one, config).points.reshape(-1, 1, 2)
            same = truth.points[truth.classes == c].reshape(1, -1, 2)
            if len(inside) == 0:
                continue
            if np.hypot(*np.moveaxis(inside - same, -1, 0)).min(axis=1).mean() > 2.2:
                found.append(q)
                classes.append(c)
                break
    offsets = np.cumsum([0] + [len(q) for q in found]).astype(np.int64)
    points = np.concatenate(found) if found else np.zeros((0, 2))
    return Scene(points, offsets, np.array(classes, dtype=np.int64))


def _displaced(p: Array, near: Array, ring: bool, rng: np.random.Generator) -> Array:
    """An element elsewhere; ``near`` (V, 2), its part in range, tells its middle and direction."""
    centre = near[:-1].mean(axis=0)
    axis = np.linalg.svd(near - centre, full_matrices=False)[2][0]
    across = np.array([-axis[1], axis[0]])
    kind = rng.random()
    if kind < 0.55:  # a parallel line on the same road; a crossing further down the road
        return p + across * rng.uniform(2.5, 14.0) * rng.choice([-1, 1])
    if kind < 0.65 and ring:
        return p + axis * rng.uniform(5.0, 25.0) * rng.choice([-1, 1])
    turn = rotation(rng.choice([0.0, rng.normal(0, 0.15), rng.uniform(-1.6, 1.6)]))
    return (p - centre) @ turn.T + centre + rng.uniform([-14, -8], [14, 8])


def segmentation_target(truth: Pieces, config: ModelConfig) -> NDArray[np.uint8]:
    """(C, H/2, W/2) 0 / 1: rings filled, lines two cells wide."""
    rows, columns = (size // 2 for size in config.picture_size)
    out = np.zeros((len(config.classes), rows, columns), np.uint8)
    cell = config.cell_m * 2
    pixel = np.round(((truth.points + config.half_range) / cell - 0.5) * 16).astype(np.int32)
    for p, c in zip(pixel, truth.classes, strict=True):
        if c in config.ring_ids:
            cv2.fillPoly(out[c], [p], 1, 8, 4)
        else:
            cv2.polylines(out[c], [p], False, 1, 2, 8, 4)
    return out


FIELD_STEP_M = 0.2


def field_target(truth: Pieces, config: ModelConfig) -> NDArray[np.float32]:
    """(C, 2, H/2, W/2) metres from the centre of each cell to the nearest point of an element of
    the class (x, y); NaN further than `FIELD_REACH_M` away and where there is none."""
    rows, columns = (size // 2 for size in config.picture_size)
    half, cell = np.array(config.half_range), config.cell_m * 2
    xs = (np.arange(columns) + 0.5) * cell - half[0]
    ys = (np.arange(rows) + 0.5) * cell - half[1]
    out = np.full((len(config.classes), 2, rows, columns), np.nan, np.float32)
    for c in range(len(config.classes)):
        lines = truth.points[truth.classes == c]
        if len(lines) == 0:
            continue
        lengths = np.hypot(*np.moveaxis(lines[:, 1:] - lines[:, :-1], -1, 0)).sum(axis=1)
        dense = np.concatenate(
            [resample(p, int(n / FIELD_STEP_M) + 2) for p, n in zip(lines, lengths, strict=True)]
        )
        column, row = ((dense + half) / cell).astype(np.int64).T
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        row, column, dense = row[inside], column[inside], dense[inside]
        if len(dense) == 0:
            continue
        free = np.ones((rows, columns), np.uint8)
        free[row, column] = 0
        _, label = cv2.distanceTransformWithLabels(
            free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        nearest = np.zeros((label.max() + 1, 2))
        nearest[label[row, column]] = dense
        place = nearest[label]
        dx, dy = place[..., 0] - xs[None], place[..., 1] - ys[:, None]
        near = np.hypot(dx, dy) < FIELD_REACH_M
        out[c, 0][near], out[c, 1][near] = dx[near], dy[near]
    return out


def heat_target(
    truth: Pieces, config: ModelConfig
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Middles of the elements on the 1 m map, and the cells that learn shapes.

    Returns heat (C, h, w): Gaussians stretched along the lines, 1 at the cell of the middle; and
    (M, 4) rows class, row, column, truth index.
    """
    rows, columns = (size // 4 for size in config.picture_size)
    half_x, half_y = config.half_range
    cell = config.cell_m * 4
    xs, ys = (np.arange(columns) + 0.5) * cell - half_x, (np.arange(rows) + 0.5) * cell - half_y
    heat = np.zeros((len(config.classes), rows, columns), np.float32)
    positive: list[NDArray[np.int64]] = []
    middle = config.vertex_count // 2
    for g, (p, c) in enumerate(zip(truth.points, truth.classes, strict=True)):
        if truth.closed[g]:
            m, t, stretch = p[:-1].mean(axis=0), np.array([1.0, 0.0]), 1.0
        else:
            m = (p[middle - 1] + p[middle]) / 2
            t = p[middle + 1] - p[middle - 2]
            t = t / (np.hypot(*t) + 1e-6)
            steps = p[1:] - p[:-1]
            stretch = float(np.clip(0.05 * np.hypot(steps[:, 0], steps[:, 1]).sum(), 0.8, 2.2))
        dx, dy = xs[None] - m[0], ys[:, None] - m[1]
        along, off = dx * t[0] + dy * t[1], dy * t[0] - dx * t[1]
        q = np.exp(-0.5 * ((along / stretch) ** 2 + (off / 0.8) ** 2)).astype(np.float32)
        row = int(np.clip((m[1] + half_y) / cell, 0, rows - 1))
        column = int(np.clip((m[0] + half_x) / cell, 0, columns - 1))
        q[row, column] = 1.0
        heat[c] = np.maximum(heat[c], q)
        r, k = np.nonzero(q > HEAT_POSITIVE)
        positive.append(np.stack([np.full_like(r, c), r, k, np.full_like(r, g)], axis=1))
    cells = np.concatenate(positive) if positive else np.zeros((0, 4), np.int64)
    return heat, cells
