"""Plausible inputs of any size: a straight painted road seen by cameras all round, and a prior."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rtmap_models.config import SemanticConfig

LINES_Y = (-7.0, -3.5, 0.0, 3.5, 7.0)
"""Metres: the rims of the road and the lines between its lanes."""

CROSSING_X = (10.0, 14.0)

Array = NDArray[Any]


def example_inputs(
    config: Any, batch: int, cameras: int, priors: int, seed: int = 0
) -> tuple[Tensor, ...]:
    """Inputs of the exported graph (docs/model-contract.md) for a model configuration.

    Every sample is a road at another place and heading, with noise in its pixels; the first slots
    of the prior are the road's lines, a metre off, the others stand anywhere; one in five slots is
    empty.
    """
    rng = np.random.default_rng(seed)
    if isinstance(config, SemanticConfig):
        return _semantic_inputs(config, batch, priors, rng)
    height, width = config.image_size
    images = np.zeros((batch, cameras, height, width, 3), np.uint8)
    projections = np.zeros((batch, cameras, 3, 4), np.float32)
    points = np.zeros((batch, priors, config.vertex_count, 2), np.float32)
    class_id = rng.integers(0, len(config.classes), (batch, priors))
    for b in range(batch):
        heading, aside = rng.normal(0, 0.1), rng.uniform(-3, 3)
        for k in range(cameras):
            projections[b, k] = _looking(2 * np.pi * k / cameras, config)
            images[b, k] = _view(projections[b, k], (height, width), heading, aside, rng)
        points[b] = _prior(config, priors, heading, aside, rng)
        _name_lines(class_id[b], config)
    mask = (rng.random((batch, priors)) < 0.8).astype(np.float32)
    return _tensors(images, projections, points, class_id, mask)


def _semantic_inputs(
    config: SemanticConfig, batch: int, priors: int, rng: np.random.Generator
) -> tuple[Tensor, ...]:
    """The same road as a semantic raster: planes of classes, each cell seen in three of four."""
    rows, columns = config.raster_size
    half_x, half_y = config.raster_half_m
    y, x = np.mgrid[0:rows, 0:columns] + 0.5
    x, y = x * config.raster_cell_m - half_x, y * config.raster_cell_m - half_y
    raster = np.zeros((batch, config.channels, rows, columns), np.uint8)
    points = np.zeros((batch, priors, config.vertex_count, 2), np.float32)
    class_id = rng.integers(0, len(config.classes), (batch, priors))
    for b in range(batch):
        heading, aside = rng.normal(0, 0.1), rng.uniform(-3, 3)
        along, across = _on_road(x, y, heading, aside)
        kind = np.where(np.abs(across) < LINES_Y[-1], 0, 4)
        kind[np.min([np.abs(across - line) for line in LINES_Y[1:-1]], axis=0) < 0.15] = 2
        kind[np.abs(np.abs(across) - LINES_Y[-1]) < 0.15] = 3
        crossing = (along > CROSSING_X[0]) & (along < CROSSING_X[1])
        kind[crossing & (np.abs(across) < LINES_Y[-1])] = 1
        seen = rng.random((rows, columns)) < 0.75
        for k in range(config.channels - 1):
            raster[b, k] = seen * np.where(kind == k, 200, 10)
        raster[b, -1] = seen * rng.integers(20, 255, (rows, columns))
        points[b] = _prior(config, priors, heading, aside, rng)
        _name_lines(class_id[b], config)
    mask = (rng.random((batch, priors)) < 0.8).astype(np.float32)
    return _tensors(raster, points, class_id, mask)


def _tensors(*arrays: Array) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(np.ascontiguousarray(a)) for a in arrays)


def _name_lines(class_id: Array, config: Any) -> None:
    """The first slots of a prior are the lines of the road."""
    for k in range(min(len(class_id), len(LINES_Y))):
        outer = k in (0, len(LINES_Y) - 1)
        class_id[k] = _class_of(config, "boundary" if outer else "divider")


def _on_road(x: Array, y: Array, heading: float, aside: float) -> tuple[Array, Array]:
    """Places along and across the road."""
    y = y - aside
    return np.cos(heading) * x + np.sin(heading) * y, np.cos(heading) * y - np.sin(heading) * x


def _class_of(config: Any, name: str) -> int:
    return config.classes.index(name) if name in config.classes else 0


def _looking(yaw: float, config: Any) -> Array:
    """(3, 4) projection of a level camera 1.5 m above the road that looks towards ``yaw``."""
    height, width = config.image_size
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rows = np.stack([right, [0.0, 0.0, -1.0], forward])
    focal = 0.6 * width
    k = np.array([[focal, 0, width / 2], [0, focal, config.horizon * height], [0, 0, 1]])
    centre = np.array([0.0, 0.0, 1.5])
    return k @ np.column_stack([rows, -rows @ centre])


def _view(
    projection: Array,
    size: tuple[int, int],
    heading: float,
    aside: float,
    rng: np.random.Generator,
) -> Array:
    """(H, W, 3) uint8: sky above, asphalt with lines and a crossing, grass beside the road."""
    u, v = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    ray = np.linalg.inv(projection[:, [0, 1, 3]].astype(np.float64))
    x, y, w = ray @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    ground = w > 1e-4
    w = np.where(ground, w, 1)
    x, y = _on_road(x / w, y / w, heading, aside)
    paint = np.min([np.abs(y - line) for line in LINES_Y], axis=0) < 0.12
    paint |= (x > CROSSING_X[0]) & (x < CROSSING_X[1]) & (np.abs(y) < 7) & (y % 1.0 < 0.5)
    colour = np.where(paint, 220.0, 85.0)[:, None].repeat(3, 1)
    colour[np.abs(y) > LINES_Y[-1] + 0.2] = (70, 110, 60)
    colour[~ground] = (150, 180, 210)
    noisy = colour + rng.normal(0, 12, colour.shape)
    return noisy.clip(0, 255).astype(np.uint8).reshape(*size, 3)


def _prior(
    config: Any, count: int, heading: float, aside: float, rng: np.random.Generator
) -> Array:
    """(P, V, 2) metres: the road's lines, moved together, then lines anywhere."""
    along = np.linspace(-1, 1, config.vertex_count)[:, None]
    middle = rng.uniform(-15, 15, (count, 1, 2))
    points = middle + 5 * rng.normal(0, 1, (count, 1, 2)) * along
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    off = rng.normal(0, 0.7, 2) + [0, aside]
    for k, y in enumerate(LINES_Y[:count]):
        points[k] = np.column_stack([30.0 * along[:, 0], np.full(len(along), y)]) @ turn.T + off
    return points.astype(np.float32)
