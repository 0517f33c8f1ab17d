"""Procedural towns: a vector map like those of real fleets, and the lanes to drive on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import length, resample_step
from rtmap_cli.maps.element import Element, VectorMap
from rtmap_cli.steps.simulate.towns.town_lanes import lane_network
from rtmap_cli.steps.simulate.towns.town_streets import Street, lay_streets

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


@dataclass
class Arm:
    """One side of a street at a junction: stations where paint stops and the lane ends.

    ``direction`` +1: the arm lies beyond the junction along the street, -1: before it.
    ``clear`` (left, right) are the stations at which the two curbs leave the other street.
    """

    street: int
    junction: int
    direction: int
    clear: tuple[float, float]
    stop: float = 0.0
    oblique: bool = False

    def station(self, share: float, beyond: float) -> float:
        """Station ``beyond`` metres outside the junction; share 0 = left curb, 1 = right curb."""
        left, right = self.clear
        return left + share * (right - left) + self.direction * beyond


@dataclass
class Junction:
    """Where two streets meet: ``place`` (2,) local metres; a roundabout has a radius."""

    place: Array
    arms: list[Arm]
    radius: float = 0.0
    island: float = 0.0


def make_town(seed: int, size: float = DEFAULT_SIZE, roundabout: bool | None = None) -> Town:
    """A town drawn from ``seed``; ``size`` metres across (150 gives a single junction or two).

    ``roundabout`` None: always one in towns of 300 m and more, in every tenth smaller scene.
    The map frame is EPSG:32632 around 500 km east, 5,400 km north; the town is flat, z = 0.
    Classes: ``boundary`` closed outlines of the asphalt, ``divider`` painted lines with their
    ``mark``, ``ped_crossing`` quads with their ``pattern``.
    """
    rng = np.random.default_rng([seed, 20])
    streets = lay_streets(rng, size)
    if roundabout is None:
        roundabout = size >= 300 or rng.random() < 0.1
    junctions = find_junctions(streets)
    if roundabout and junctions:
        _make_roundabout(rng, streets, junctions)
    crossings = _crossings(rng, streets, junctions)
    islands = _islands(rng, streets, junctions)
    surface = _surface(rng, streets, junctions, islands)
    dividers = _dividers(rng, streets, junctions, [c for c, _ in crossings], surface)
    lanes = lane_network(streets, junctions)
    return _assemble(seed, size, surface, dividers, crossings, lanes)


def find_junctions(streets: list[Street]) -> list[Junction]:
    """Every place where two streets cross or one ends on the other."""
    outlines = [shapely.polygons(s.outline()).buffer(0) for s in streets]
    lines = [shapely.linestrings(s.line) for s in streets]
    junctions: list[Junction] = []
    for i, a in enumerate(streets):
        for j in range(i + 1, len(streets)):
            b = streets[j]
            near = lines[i].buffer(4.0).intersection(lines[j])
            if near.is_empty:
                continue
            for part in shapely.get_parts(near):
                place = np.asarray(part.interpolate(0.5, normalized=True).coords[0])
                arms = [
                    arm
                    for index, street, outline in ((i, a, outlines[j]), (j, b, outlines[i]))
                    for arm in _arms(street, index, place, outline, len(junctions))
                ]
                if len(arms) >= 3:
                    junctions.append(Junction(place, arms))
    return junctions


def _arms(street: Street, index: int, place: Array, other: object, junction: int) -> list[Arm]:
    """The arms of one street at a junction: walk both curbs until they leave the other street."""
    middle = float(shapely.linestrings(street.line).project(shapely.points(place)))
    found: list[Arm] = []
    for direction in (1, -1):
        limit = street.length if direction > 0 else 0.0
        if abs(limit - middle) < 18:
            continue
        s = middle + direction * np.arange(0, min(45.0, abs(limit - middle)), 0.5)
        clear = []
        for side in (0, 1):
            offset = street.profile.half_width(side) * (1 if side == 0 else -1)
            p = street.at(s, np.full(len(s), offset))
            inside = np.flatnonzero(shapely.contains_xy(other, p[:, 0], p[:, 1]))
            clear.append(float(s[inside[-1]] if len(inside) else s[0]))
        # Streets that meet at a sharp angle get no crossing, but their paint stops as well.
        oblique = abs(clear[0] - clear[1]) > 14 or max(abs(c - middle) for c in clear) > 36
        found.append(Arm(index, junction, direction, (clear[0], clear[1]), oblique=oblique))
    return found


def _make_roundabout(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> None:
    """Turn the junction nearest to the middle of the town into a roundabout."""
    best = min(junctions, key=lambda j: float(np.hypot(*j.place)))
    widths = [max(streets[a.street].profile.half_width(k) for k in (0, 1)) for a in best.arms]
    best.radius = max(float(rng.uniform(15, 19)), max(widths) * 1.35 + 4)
    best.island = best.radius - float(rng.uniform(6.0, 7.5))
    for arm in best.arms:
        street = streets[arm.street]
        s = float(shapely.linestrings(street.line).project(shapely.points(best.place)))
        edge = s + arm.direction * best.radius
        arm.clear = (edge, edge)


def _crossings(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> list[tuple[Array, str]]:
    """Crossing quads (5, 2) on the arms of junctions and between them; sets where paint stops."""
    out: list[tuple[Array, str]] = []
    for junction in junctions:
        busy = max(streets[a.street].profile.crossings for a in junction.arms)
        zebra = rng.random() < busy
        pattern = streets[junction.arms[0].street].profile.pattern
        for arm in junction.arms:
            street = streets[arm.street]
            gap, depth = rng.uniform(1.0, 3.5), rng.uniform(2.6, 5.0)
            arm.stop = rng.uniform(0.5, 4.0)
            if not zebra or arm.oblique or rng.random() > 0.85:
                continue
            arm.stop = gap + depth + rng.uniform(0.8, 2.0)
            left, right = street.profile.half_width(0), -street.profile.half_width(1)
            far = gap + depth
            corners = ((0.0, left, gap), (1.0, right, gap), (1.0, right, far), (0.0, left, far))
            ring = [street.at(arm.station(k, d), o) for k, o, d in corners]
            out.append((np.array([*ring, ring[0]]), pattern))
    for index, street in enumerate(streets):
        if rng.random() < 0.35 * street.profile.crossings:
            quad = _midblock(rng, street, index, junctions)
            if quad is not None:
                out.append((quad, street.profile.pattern))
    return out


def _midblock(
    rng: np.random.Generator, street: Street, index: int, junctions: list[Junction]
) -> Array | None:
    s = float(rng.uniform(15, max(16, street.length - 15)))
    depth = rng.uniform(2.5, 4.0)
    for junction in junctions:
        for arm in junction.arms:
            if arm.street == index and min(abs(s - c) for c in arm.clear) < 25:
                return None
    left, right = street.profile.half_width(0), -street.profile.half_width(1)
    quad = [street.at(s + d, o) for d, o in ((0, left), (0, right), (depth, right), (depth, left))]
    return np.array([*quad, quad[0]])


def free_stretches(
    index: int, street: Street, junctions: list[Junction], share: float, extra: float = 0.0
) -> list[tuple[float, float]]:
    """Station intervals of a street outside its junctions' stop lines.

    ``share`` across the street: 0 at the left curb, 1 at the right one.
    """
    blocked = []
    for junction in junctions:
        own = [a for a in junction.arms if a.street == index]
        if not own:
            continue
        ends = {a.direction: a.station(share, a.stop + extra) for a in own}
        middle = float(shapely.linestrings(street.line).project(shapely.points(junction.place)))
        low = ends.get(-1, -1.0 if middle < 25 else middle - 25)
        high = ends.get(1, street.length + 1 if middle > street.length - 25 else middle + 25)
        blocked.append((low, high))
    out, at = [], 0.0
    for low, high in sorted(blocked):
        if low > at:
            out.append((at, low))
        at = max(at, high)
    if at < street.length:
        out.append((at, street.length))
    return out


def _islands(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> list[object]:
    """Raised medians between junctions, as polygons, with rounded ends."""
    out: list[object] = []
    for index, street in enumerate(streets):
        profile = street.profile
        if not profile.raised:
            continue
        half = profile.median / 2 - 0.35
        for start, end in free_stretches(index, street, junctions, 0.5, 1.0):
            if end - start < 14 or rng.random() < 0.2:
                continue
            if rng.random() < 0.4:
                start += rng.uniform(0.2, 0.5) * (end - start)
            if rng.random() < 0.3:
                end -= rng.uniform(0.2, 0.4) * (end - start)
            line = street.between(start + half, max(end - half, start + half + 2))
            out.append(shapely.linestrings(line).buffer(half, quad_segs=3))
    for junction in junctions:
        if junction.radius:
            out.append(shapely.points(junction.place).buffer(junction.island, quad_segs=12))
    return out


def _surface(
    rng: np.random.Generator,
    streets: list[Street],
    junctions: list[Junction],
    islands: list[object],
) -> object:
    """The asphalt: streets and alleys with rounded corners, driveways, less the islands."""
    polygons = [shapely.polygons(s.outline()).buffer(0) for s in streets]
    polygons += [
        shapely.points(j.place).buffer(j.radius, quad_segs=12) for j in junctions if j.radius
    ]
    polygons += [p for s in streets for p in _spurs(rng, s, 0.012, (10.0, 35.0), (4.0, 6.5))]
    radius = rng.uniform(3.0, 7.0)
    union = shapely.union_all(polygons)
    union = union.buffer(radius, quad_segs=5).buffer(-radius, quad_segs=5)
    drives = [p for s in streets for p in _spurs(rng, s, 0.02, (2.0, 8.0), (2.8, 7.0))]
    union = shapely.union_all([union, *drives])
    if islands:
        union = union.difference(shapely.union_all(islands))
    union = union.simplify(0.03)
    parts = [p for p in shapely.get_parts(union) if p.area > 200]
    kept = [
        shapely.Polygon(p.exterior, [r for r in p.interiors if shapely.Polygon(r).area > 1.5])
        for p in parts
    ]
    return shapely.union_all(kept)


def _spurs(
    rng: np.random.Generator,
    street: Street,
    density: float,
    depth: tuple[float, float],
    width: tuple[float, float],
) -> list[object]:
    """Short side pieces (alleys, driveways) at random stations: ``density`` per metre."""
    out = []
    for _ in range(rng.poisson(density * street.length)):
        s, side = rng.uniform(5, street.length - 5), int(rng.integers(2))
        w = rng.uniform(*width)
        edge = street.profile.half_width(side)
        sign = 1 if side == 0 else -1
        reach = sign * (edge + rng.uniform(*depth))
        skew = rng.normal(0, 0.15) * abs(reach)
        near = sign * (edge - 1.0)
        corners = [(s, near), (s + w, near), (s + w + skew, reach), (s + skew, reach)]
        ring = np.array([street.at(a, b) for a, b in corners])
        out.append(shapely.polygons(ring).buffer(0))
    return out


def _dividers(
    rng: np.random.Generator,
    streets: list[Street],
    junctions: list[Junction],
    crossings: list[Array],
    surface: object,
) -> list[tuple[Array, str]]:
    """Painted lines between the stop lines; they stop at crossings and where asphalt ends."""
    keep = surface.buffer(-0.1)  # type: ignore[attr-defined]
    if crossings:
        keep = keep.difference(shapely.union_all(shapely.polygons(crossings)).buffer(0.8))
    out: list[tuple[Array, str]] = []
    for index, street in enumerate(streets):
        left, right = street.profile.half_width(0), street.profile.half_width(1)
        ahead = rng.uniform(12, 30) if rng.random() < 0.5 else 0.0
        sparse = rng.random() < 0.15
        for offset, mark in street.profile.painted_lines():
            share = (left - offset) / (left + right)
            for start, end in free_stretches(index, street, junctions, share):
                if sparse and rng.random() < 0.5:
                    end = start + rng.uniform(0.3, 0.8) * (end - start)
                if end - start < 5 or rng.random() < 0.04:
                    continue
                for a, b, paint in _marks(start, end, mark, ahead, street.length):
                    line = shapely.linestrings(street.between(a, b, offset)).intersection(keep)
                    out += [
                        (np.asarray(g.coords), paint)
                        for g in shapely.get_parts(line)
                        if g.geom_type == "LineString" and g.length > 4
                    ]
    return out


def _marks(
    start: float, end: float, mark: str, ahead: float, total: float
) -> list[tuple[float, float, str]]:
    """Dashed lane lines become solid ``ahead`` metres before a junction."""
    if mark != "DASHED_WHITE" or ahead == 0 or end - start < 2.5 * ahead:
        return [(start, end, mark)]
    cuts = [start, start + ahead if start > 0 else start, end - ahead if end < total else end, end]
    marks = ["SOLID_WHITE", mark, "SOLID_WHITE"]
    return [(a, b, m) for a, b, m in zip(cuts, cuts[1:], marks, strict=False) if b - a > 1]


def _assemble(
    seed: int,
    size: float,
    surface: object,
    dividers: list[tuple[Array, str]],
    crossings: list[tuple[Array, str]],
    lanes: list[Array],
) -> Town:
    """Shift everything to the map frame and number the elements."""
    elements: list[Element] = []

    def add(class_name: str, points: Array, **attributes: str) -> None:
        flat = np.column_stack([points + TOWN_ORIGIN, np.zeros(len(points))])
        name = f"{class_name}-{sum(e.class_name == class_name for e in elements):04d}"
        elements.append(Element(name, class_name, flat, attributes=attributes))

    for quad, pattern in crossings:
        if surface.intersects(shapely.polygons(quad)):  # type: ignore[attr-defined]
            add("ped_crossing", quad, pattern=pattern)
    for line, mark in dividers:
        if length(line) > 3:
            add("divider", np.asarray(shapely.linestrings(line).simplify(0.02).coords), mark=mark)
    for part in shapely.get_parts(surface):
        for ring in (part.exterior, *part.interiors):
            add("boundary", np.asarray(ring.coords))
    town = Town(VectorMap(elements, TOWN_CRS), [], seed, size)
    return replace(town, lanes=[resample_step(line + TOWN_ORIGIN, 2.0) for line in lanes])
