"""The asphalt of a town: streets with rounded corners, driveways and lots, less the islands."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.steps.simulate.towns.junctions import Junction, free_stretches
from rtmap_cli.steps.simulate.towns.streets import Street

Array = NDArray[np.float64]


def lay_asphalt(rng: np.random.Generator, streets: list[Street], junctions: list[Junction]) -> Any:
    """The drivable surface as a (multi)polygon; its outlines are the boundaries of the map."""
    polygons = [shapely.polygons(s.outline()).buffer(0) for s in streets]
    polygons += [_bulb(rng, s, k) for s in streets for k in (0, 1) if _is_blind(s, k, junctions)]
    polygons += [p for s in streets for p in _spurs(rng, s, 0.004, (10.0, 35.0), (4.0, 6.5))]
    polygons += [
        shapely.points(j.place).buffer(j.radius, quad_segs=12) for j in junctions if j.radius
    ]
    union = shapely.union_all(polygons)
    corners, islands = [], _medians(rng, streets, junctions)
    for junction in junctions:
        rounded, triangles = _corners(rng, union, junction, streets)
        corners.append(rounded)
        islands += triangles
    drives = [p for s in streets for p in _spurs(rng, s, 0.011, (1.0, 9.0), (2.6, 7.5))]
    lots = [p for s in streets for p in _lots(rng, s)]
    union = shapely.union_all([union, *corners, *drives, *lots])
    if islands:
        union = union.difference(shapely.union_all(islands))
    union = union.simplify(0.03)
    parts = [p for p in shapely.get_parts(union) if p.area > 200]
    kept = [
        shapely.Polygon(p.exterior, [r for r in p.interiors if shapely.Polygon(r).area > 1.5])
        for p in parts
    ]
    return shapely.union_all(kept)


def _is_blind(street: Street, end: int, junctions: list[Junction]) -> bool:
    """Whether a street ends in the town without meeting another one."""
    if not street.closed[end]:
        return False
    place = street.line[0 if end == 0 else -1]
    return all(float(np.hypot(*(j.place - place))) > 20 for j in junctions)


def _bulb(rng: np.random.Generator, street: Street, end: int) -> Any:
    """Room to turn round at a blind end, often none."""
    place = street.line[0 if end == 0 else -1]
    half = max(street.profile.half_width(k) for k in (0, 1))
    radius = rng.uniform(7.0, 11.0) if rng.random() < 0.5 else half
    return shapely.points(place).buffer(radius, quad_segs=8)


def _corners(
    rng: np.random.Generator, union: Any, junction: Junction, streets: list[Street]
) -> tuple[Any, list[Any]]:
    """(what rounds the corners of a junction, islands between a corner and a slip lane)."""
    alley = any(streets[k].profile.rank == "alley" for k in junction.streets)
    radius = rng.uniform(0.5, 3.5) if alley else rng.choice([2.0, 4.5, 8.0]) * rng.uniform(0.8, 1.5)
    wide = max(streets[k].profile.half_width(side) for k in junction.streets for side in (0, 1))
    reach = 1.6 * wide + 2.0 * radius + 8.0
    near = shapely.points(junction.place).buffer(reach + 2 * radius, quad_segs=4)
    inner = shapely.points(junction.place).buffer(reach, quad_segs=4)
    local = union.intersection(near)
    segments = int(rng.choice([1, 3, 5], p=[0.2, 0.3, 0.5]))
    closed = local.buffer(radius, quad_segs=segments).buffer(-radius, quad_segs=segments)
    if alley or junction.radius or rng.random() > 0.3:
        return closed.intersection(inner), []
    return _slip_lanes(rng, local, closed.intersection(inner), junction, reach)


def _slip_lanes(
    rng: np.random.Generator, local: Any, closed: Any, junction: Junction, reach: float
) -> tuple[Any, list[Any]]:
    """One or two corners wide enough for a lane of their own behind a triangular island."""
    radius, lane = rng.uniform(14, 24), rng.uniform(4.2, 6.0)
    inner = shapely.points(junction.place).buffer(reach + radius, quad_segs=4)
    open_ = local.buffer(radius, quad_segs=6).buffer(-radius, quad_segs=6).intersection(inner)
    found = [p for p in shapely.get_parts(open_.difference(local.buffer(0.01))) if p.area > 25]
    out, islands = [closed], []
    for corner in found[: int(rng.integers(1, 3))]:
        whole = corner.buffer(0.05).union(local)
        island = whole.buffer(-lane).intersection(corner).buffer(-1.0).buffer(0.6)
        parts = [p for p in shapely.get_parts(island) if p.area > 8]
        if parts:
            out.append(corner.buffer(0.05))
            islands += parts
    return shapely.union_all(out), islands


def _medians(
    rng: np.random.Generator, streets: list[Street], junctions: list[Junction]
) -> list[Any]:
    """Raised medians between junctions with round or pointed ends, and roundabouts' middles."""
    out: list[Any] = []
    for index, street in enumerate(streets):
        profile = street.profile
        if not profile.raised:
            continue
        half = profile.median / 2 - min(0.35, 0.15 * profile.median)
        for start, end in free_stretches(index, street, junctions, 0.5, 1.0):
            if end - start < 14 or rng.random() < 0.2:
                continue
            # Turning lanes take the place of the island before junctions.
            if rng.random() < 0.4:
                start += rng.uniform(0.2, 0.5) * (end - start)
            if rng.random() < 0.4:
                end -= rng.uniform(0.2, 0.5) * (end - start)
            out.append(_median(rng, street, start, end, half))
    for junction in junctions:
        if junction.radius:
            out.append(shapely.points(junction.place).buffer(junction.island, quad_segs=12))
    return out


def _median(rng: np.random.Generator, street: Street, start: float, end: float, half: float) -> Any:
    if rng.random() < 0.5:
        line = street.between(start + half, max(end - half, start + half + 2))
        return shapely.linestrings(line).buffer(half, quad_segs=3)
    s = np.linspace(start, end, max(4, int((end - start) / 2)))
    tips = rng.uniform(1.0, 12.0, 2)
    w = half * np.clip(np.minimum((s - start) / tips[0], (end - s) / tips[1]), 0.12 / half, 1)
    ring = np.concatenate([street.at(s, w), street.at(s, -w)[::-1]])
    return shapely.polygons(ring).buffer(0)


def _spurs(
    rng: np.random.Generator,
    street: Street,
    density: float,
    depth: tuple[float, float],
    width: tuple[float, float],
) -> list[Any]:
    """Short side pieces (alleys, driveways) at random stations: ``density`` per metre.

    They narrow or widen towards the street; some end in a wedge.
    """
    out = []
    for _ in range(rng.poisson(density * street.length)):
        s, side = rng.uniform(5, street.length - 5), int(rng.integers(2))
        w, flare = rng.uniform(*width), rng.uniform(0.0, 2.0) * (rng.random() < 0.6)
        edge = float(street.curb(side, np.array(s)))
        sign = 1 if side == 0 else -1
        reach = sign * (edge + rng.uniform(*depth))
        skew = rng.normal(0, 0.15) * abs(reach)
        near = sign * (edge - 1.0)
        tip = rng.uniform(0.05, 0.6) if rng.random() < 0.2 else 1.0
        far = s + w / 2 + skew
        corners = [
            (s - flare, near), (s + w + flare, near), (far + w * tip / 2, reach),
            (far - w * tip / 2, reach),
        ]  # fmt: skip
        ring = np.array([street.at(a, b) for a, b in corners])
        out.append(shapely.polygons(ring).buffer(0))
    return out


def _lots(rng: np.random.Generator, street: Street) -> list[Any]:
    """Yards and parking lots behind the curb, reached by one driveway."""
    out = []
    for _ in range(rng.poisson(0.0015 * street.length)):
        side = int(rng.integers(2))
        s, sign = rng.uniform(20, street.length - 20), 1 if side == 0 else -1
        edge = float(street.curb(side, np.array(s)))
        w, depth, gap = rng.uniform(14, 34), rng.uniform(9, 20), rng.uniform(1.5, 6.0)
        at = rng.uniform(-0.4, 0.4) * w
        for a, b, low, high in (
            (s - w / 2, s + w / 2, edge + gap, edge + gap + depth),
            (s + at - 3, s + at + 3, edge - 1, edge + gap + 1),
        ):
            corners = [(a, sign * low), (b, sign * low), (b, sign * high), (a, sign * high)]
            out.append(shapely.polygons(np.array([street.at(x, y) for x, y in corners])).buffer(0))
    return out
