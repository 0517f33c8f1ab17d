"""What is on a road besides the elements of its map: stop lines, arrows, seams of tar.

A network must tell them from lane lines. They follow from the map and a seed alone.
"""

from __future__ import annotations

import zlib

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, normals
from rtmap_cli.maps.element import Element, VectorMap

Array = NDArray[np.float64]

STOP_LINE, ARROW = 0.65, 0.25
"""Chance of a stop line before a crossing, of an arrow beside the end of a divider."""
NEAR_END = 5.0
"""A side of a crossing with the end of a divider this near (m) is the one that traffic meets."""
HALF_LANE = 1.65
SEAMS = 35.0
"""Metres of curb per seam of tar, on average."""


def rng_of(element: Element, seed: int) -> np.random.Generator:
    """A generator that depends on the element's id alone: other elements do not disturb it."""
    return np.random.default_rng([seed, zlib.crc32(element.element_id.split("#")[0].encode())])


def stop_lines(vector_map: VectorMap, seed: int) -> list[Array]:
    """Polygons (4, 2) before crossings, on the right half of the road as traffic meets them."""
    lines = [e.xy for e in vector_map.of_class("divider")]
    if not lines:
        return []
    ends = np.concatenate([line[[0, -1]] for line in lines])
    out = []
    for element in vector_map.of_class("ped_crossing"):
        rng = rng_of(element, seed + 1)
        corners = element.xy[:4]
        if len(element.xy) != 5 or rng.random() > STOP_LINE:
            continue
        sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
        first = 0 if sides[0] + sides[2] > sides[1] + sides[3] else 1
        for k in (first, first + 2):
            a, b = corners[k % 4], corners[(k + 1) % 4]
            along = (b - a) / max(float(np.hypot(*(b - a))), 1e-6)
            outward = np.array([-along[1], along[0]])
            if (corners.mean(axis=0) - a) @ outward > 0:
                outward = -outward
            middle = (a + b) / 2
            if np.hypot(*(ends - middle).T).min() > NEAR_END or np.hypot(*(b - a)) < 5:
                continue
            # Who comes against ``outward`` keeps to the right.
            right = np.array([-outward[1], outward[0]])
            far = 0.5 * float(np.hypot(*(b - a))) - 0.6
            thick, away = rng.uniform(0.3, 0.6), rng.uniform(0.7, 1.4)
            p, q = middle + 0.1 * right + away * outward, middle + far * right + away * outward
            out.append(np.array([p, q, q + thick * outward, p + thick * outward]))
    return out


def arrows(vector_map: VectorMap, surface: object, seed: int) -> list[Array]:
    """Arrows (7, 2) on lanes to the right of dividers, some metres before their ends."""
    out = []
    for element in vector_map.of_class("divider"):
        rng = rng_of(element, seed + 2)
        line = element.xy
        s = arc_length(line)
        back, which = rng.uniform(4.0, 12.0), int(rng.integers(2))
        if rng.random() > ARROW or s[-1] < 20.0:
            continue
        line, s = (line, s) if which else (line[::-1], s[-1] - s[::-1])
        at = np.array([s[-1] - back - 0.5, s[-1] - back + 0.5])
        p, q = np.stack([np.interp(at, s, line[:, k]) for k in (0, 1)], axis=-1)
        ahead = (q - p) / max(float(np.hypot(*(q - p))), 1e-6)
        right = np.array([ahead[1], -ahead[0]])
        long, wide = rng.uniform(2.5, 4.5), rng.uniform(0.12, 0.22)
        shape = [
            (0, -wide / 2), (0.65, -wide / 2), (0.65, -0.35), (1, 0), (0.65, 0.35),
            (0.65, wide / 2), (0, wide / 2),
        ]  # fmt: skip
        place = p + HALF_LANE * right
        if shapely.contains_xy(surface, *place):
            out.append(np.array([place + u * long * ahead + v * right for u, v in shape]))
    return out


def seams(vector_map: VectorMap, seed: int) -> list[Array]:
    """Lines (n, 2) of tar on the asphalt, mostly along the curb, some across the road."""
    rng = np.random.default_rng([seed, 71])
    often = rng.choice([0.0, 0.5, 1.5], p=[0.3, 0.4, 0.3])
    out = []
    for element in vector_map.of_class("boundary"):
        line = element.xy
        s = arc_length(line)
        normal = normals(line)
        for _ in range(rng.poisson(often * s[-1] / SEAMS)):
            start, long = rng.uniform(0, s[-1]), rng.uniform(4.0, 30.0)
            offset = rng.uniform(-9.0, 9.0)
            if rng.random() < 0.7:
                at = np.arange(start, min(start + long, s[-1]), 3.0)
                across = offset + np.cumsum(rng.normal(0, 0.06, len(at)))
            else:
                across = np.linspace(0, np.sign(offset) * long, 6)
                at = start + np.cumsum(rng.normal(0, 0.15, 6))
            if len(at) < 2:
                continue
            p, n = (
                np.stack([np.interp(at, s, v[:, k]) for k in (0, 1)], -1) for v in (line, normal)
            )
            out.append(p + n * across[:, None])
    return out
