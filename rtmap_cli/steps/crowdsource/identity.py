"""Ids that live on: elements made anew keep the ids of those that they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely

from rtmap_cli.geometry.polylines import length, resample_step
from rtmap_cli.maps.element import Element, VectorMap

NEAR = 1.0
"""Stretches of two elements of a class so near (m) to each other are the same thing."""
SHARED = 0.3
"""Share of the shorter element that must be the same thing."""


def keep_ids(before: VectorMap, after: VectorMap) -> VectorMap:
    """``after`` with the ids and first sightings of the elements of ``before`` that it holds.

    Pairs of a class are taken by falling shared length, each element once. Ids of new elements
    that would repeat a kept one get a suffix.
    """
    pairs = sorted(
        (-shared, old, new)
        for name in dict.fromkeys(e.class_name for e in after)
        for shared, old, new in _shared(before, after, name)
    )
    olds, news = before.by_id(), after.by_id()
    taken: dict[str, str] = {}
    used: set[str] = set()
    for _, old, new in pairs:
        if old not in used and new not in taken:
            taken[new] = old
            used.add(old)
    out = []
    for name, element in news.items():
        if name in taken:
            out.append(_as(element, olds[taken[name]]))
            continue
        fresh, k = name, 2
        while fresh in used:
            fresh, k = f"{name}-{k}", k + 1
        used.add(fresh)
        out.append(replace(element, element_id=fresh))
    return VectorMap(out, after.crs)


def _as(element: Element, old: Element) -> Element:
    times = [t for t in (element.first_seen_ns, old.first_seen_ns) if t is not None]
    return replace(
        element,
        element_id=old.element_id,
        first_seen_ns=min(times) if times else None,
        attributes=old.attributes | element.attributes,
    )


def _shared(before: VectorMap, after: VectorMap, name: str) -> list[tuple[float, str, str]]:
    """(length in metres that both share, old id, new id) of the pairs that share enough."""
    olds, news = before.of_class(name), after.of_class(name)
    if not olds or not news:
        return []
    lines = [shapely.LineString(e.xy) for e in olds]
    tree = shapely.STRtree(lines)
    out = []
    for element in news:
        samples = resample_step(element.xy, 1.0)
        line, points = shapely.LineString(element.xy), shapely.points(samples)
        for k in np.sort(tree.query(line, predicate="dwithin", distance=NEAR)):
            share = float((shapely.distance(points, lines[k]) <= NEAR).mean())
            shared = share * length(element.xy)
            if shared >= SHARED * min(length(element.xy), lines[k].length):
                out.append((shared, olds[k].element_id, element.element_id))
    return out
