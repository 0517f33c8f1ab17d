"""Procedural towns: a vector map like those of real fleets, and the lanes to drive on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import length, resample_step
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.simulate.towns.asphalt import lay_asphalt
from rtmap_cli.steps.simulate.towns.crossings import Crossing, lay_crossings
from rtmap_cli.steps.simulate.towns.fittings import fit_out
from rtmap_cli.steps.simulate.towns.hills import SPACING, Hills
from rtmap_cli.steps.simulate.towns.junctions import (
    find_junctions,
    make_roundabout,
    measure_again,
)
from rtmap_cli.steps.simulate.towns.lanes import lane_network
from rtmap_cli.steps.simulate.towns.paint import lay_dividers, let_paint_pass
from rtmap_cli.steps.simulate.towns.profiles import STYLES
from rtmap_cli.steps.simulate.towns.streets import lay_streets

Array = NDArray[np.float64]

TOWN_CRS = "EPSG:32632"
TOWN_ORIGIN = (500_000.0, 5_400_000.0)
DEFAULT_SIZE = 420.0
"""Width of a town, metres: enough for drives of 300 m with several turns."""


@dataclass(frozen=True)
class Town:
    """A town: its map and its lanes.

    ``lanes`` are directed centre lines (n, 2) in the map frame, metres; lanes and the connectors
    through junctions meet end to start exactly, so that routes can be chained.
    """

    vector_map: VectorMap
    lanes: list[Array]
    seed: int
    size: float


def make_town(
    seed: int, size: float = DEFAULT_SIZE, roundabout: bool | None = None, style: str = "mixed"
) -> Town:
    """A town drawn from ``seed``; ``size`` metres across (150 gives a single junction or two).

    ``roundabout`` None: always one in towns of 300 m and more, in every tenth smaller scene.
    ``style`` is a key of `STYLES`: how the streets are built and painted.
    The map frame is EPSG:32632 around 500 km east, 5,400 km north; three towns of four lie on
    gentle hills (up to 8 %), the others are flat, z = 0.
    Classes: ``boundary`` closed outlines of the asphalt, ``divider`` painted lines with their
    ``mark``, ``ped_crossing`` quads with their ``pattern``.
    """
    rng = np.random.default_rng([seed, 20])
    streets = lay_streets(rng, size, STYLES[style])
    if roundabout is None:
        roundabout = size >= 300 or rng.random() < 0.1
    junctions = find_junctions(streets)
    turning = fit_out(rng, streets, junctions)
    measure_again(streets, junctions)
    if roundabout and junctions:
        make_roundabout(rng, streets, junctions)
    crossings = lay_crossings(rng, streets, junctions)
    let_paint_pass(rng, streets, junctions)
    surface = lay_asphalt(rng, streets, junctions)
    rings = [ring for ring, _ in crossings]
    dividers = lay_dividers(rng, streets, junctions, turning, rings, surface)
    lanes = lane_network(streets, junctions)
    hills = Hills(rng, surface)
    return _assemble(seed, size, surface, dividers, crossings, lanes, hills)


def _assemble(
    seed: int,
    size: float,
    surface: Any,
    dividers: list[tuple[Array, str]],
    crossings: list[Crossing],
    lanes: list[Array],
    hills: Hills,
) -> Town:
    """Shift everything to the map frame and number the elements."""
    elements: list[Element] = []

    def add(class_name: str, points: Array, **attributes: str) -> None:
        draped = hills.drape(points, np.inf if class_name == "ped_crossing" else SPACING)
        placed = draped + (*TOWN_ORIGIN, 0.0)
        name = f"{class_name}-{sum(e.class_name == class_name for e in elements):04d}"
        elements.append(Element(name, class_name, placed, attributes=attributes))

    for ring, pattern in crossings:
        if surface.intersects(shapely.polygons(ring)):
            add("ped_crossing", ring, pattern=pattern)
    for line, mark in dividers:
        if length(line) > 3:
            add("divider", np.asarray(shapely.linestrings(line).simplify(0.02).coords), mark=mark)
    for part in shapely.get_parts(surface):
        for ring in (part.exterior, *part.interiors):
            add("boundary", np.asarray(ring.coords))
    town = Town(VectorMap(elements, TOWN_CRS), [], seed, size)
    return replace(town, lanes=[resample_step(line + TOWN_ORIGIN, 2.0) for line in lanes])
