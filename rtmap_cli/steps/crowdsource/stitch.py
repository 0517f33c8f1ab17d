"""Regions put together: nothing twice, lines whole over the borders of tiles.

The order of the regions decides, not the order in which they were done, so that the result is the
same for any number of workers. Prior elements come from the region that owns them; where two of
them met in a vertex they meet again. New lines are in the way of those of later regions: what a
later line has in common with them is cut off, and the cut end is put exactly onto their end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring, length, resample_step, tangents
from rtmap_cli.geometry.rings import overlap, polygon
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap
from rtmap_cli.maps.existence import runs_of
from rtmap_cli.maps.pieces import GAP, free_id, left_over, own_ends, parts_of, put_onto
from rtmap_cli.steps.crowdsource.fuse import Fusion
from rtmap_cli.steps.crowdsource.job import Outcome
from rtmap_cli.steps.crowdsource.tiling import BAND

Array = NDArray[np.float64]

SAME = 0.75
"""Two regions' lines so near (m) to each other, side by side, are one line."""
MIN_COS = 0.8
STEP = 0.5
"""Where a line is compared with others (m)."""
CENTRE = 3.5
"""Closed elements whose middles are so near (m), or that overlap by `OVERLAP`, are one."""
OVERLAP = 0.3
MET = 1e-6
"""Ends of prior lines so near (m) meet."""


def stitch(prior: VectorMap, outcomes: Sequence[Outcome]) -> Fusion:
    """The Fusion of a whole map from those of its regions, which are in the order of the plan."""
    if len(outcomes) > 1:
        outcomes = [*outcomes]
        _weld(prior, outcomes)
    old: dict[str, list[Element]] = {}
    for outcome in outcomes:
        old |= outcome.old
    out = Fusion(VectorMap((), prior.crs))
    elements: list[Element] = []
    for e in prior:
        if e.element_id in old:
            elements += old[e.element_id]
        else:
            elements.append(e)
            out.untouched.append(e.element_id)
    for name in ("deleted", "split", "moved", "untouched"):
        getattr(out, name).extend(k for o in outcomes for k in o.told[name])
    fresh = _new(outcomes)
    taken = {e.element_id for e in elements}
    for e in fresh:
        named = replace(e, element_id=free_id(e.element_id, taken))
        taken.add(named.element_id)
        out.inserted.append(named.element_id)
        elements.append(named)
    out.waiting = [e.element_id for o in outcomes for e in o.waiting]
    out.vector_map = VectorMap(elements, prior.crs)
    return out


# ---- prior elements


def _weld(prior: VectorMap, outcomes: list[Outcome]) -> None:
    """Ends of prior lines that met and belong to different regions meet again, in place: at the
    mean of where the regions put them, or where one of them stays."""
    region = {name: k for k, o in enumerate(outcomes) for name in o.old}
    still = {name for o in outcomes for name in o.told["untouched"]}
    ends: dict[tuple[int, int], list[tuple[str, int]]] = {}
    for e in prior:
        if e.element_id in region and not is_ring(e.points):
            for at in (0, -1):
                x, y = np.round(e.xy[at] / MET).astype(np.int64)
                ends.setdefault((int(x), int(y)), []).append((e.element_id, at))
    for group in ends.values():
        if len({region[name] for name, _ in group}) < 2:
            continue
        parts = [outcomes[region[name]].old[name] for name, _ in group]
        # What was split or deleted has no such end any more.
        if any(len(p) != 1 or p[0].element_id != g[0] for p, g in zip(parts, group, strict=True)):
            continue
        places = [p[0].xy[at] for p, (_, at) in zip(parts, group, strict=True)]
        held = [at for at, (name, _) in zip(places, group, strict=True) if name in still]
        middle = held[0] if held else np.mean(places, axis=0)
        for part, (name, at) in zip(parts, group, strict=True):
            if name in still:
                continue
            points = part[0].points.copy()
            points[at, :2] = middle
            part[0] = part[0].with_points(points, part[0].covariance)


# ---- new elements


def _new(outcomes: Sequence[Outcome]) -> list[Element]:
    """The new elements of all regions, each once."""
    out: list[Element] = []
    names = dict.fromkeys(e.class_name for o in outcomes for e in o.new)
    for name in sorted(names):
        # Only what lies at the border of a square can be in the way of another region's.
        border: list[Element] = []
        for o in outcomes:
            mine = [e for e in o.new if e.class_name == name]
            inner = [_is_inner(e, o) for e in mine]
            kept = [e for e, own in zip(mine, inner, strict=True) if own]
            rest = [e for e, own in zip(mine, inner, strict=True) if not own]
            fit = _rings_apart if name in RING_CLASSES else _lines_apart
            mended = fit(rest, border)
            out += kept + mended
            border += mended
    return out


def _is_inner(element: Element, outcome: Outcome) -> bool:
    """True when no other region's band reaches the element."""
    if outcome.box is None:
        return True
    x0, y0, x1, y1 = outcome.box
    low, high = element.xy.min(axis=0), element.xy.max(axis=0)
    room = BAND + CENTRE
    return bool((low > [x0 + room, y0 + room]).all() and (high < [x1 - room, y1 - room]).all())


def _rings_apart(rings: list[Element], others: list[Element]) -> list[Element]:
    """Those that are none of the others."""
    if not others:
        return rings
    shapes = [polygon(e.xy) for e in others]
    centres = np.array([e.xy[:-1].mean(axis=0) for e in others])
    out = []
    for e in rings:
        far = np.hypot(*(centres - e.xy[:-1].mean(axis=0)).T)
        shape = polygon(e.xy)
        size = float(np.ptp(e.xy, axis=0).max())
        near = np.flatnonzero(far < max(CENTRE, size))
        if (far > CENTRE).all() and all(overlap(shape, shapes[k]) < OVERLAP for k in near):
            out.append(e)
    return out


def _lines_apart(lines: list[Element], others: list[Element]) -> list[Element]:
    """The lines without what they have in common with others, cut ends put onto the others'."""
    if not others or not lines:
        return lines
    shapes = np.array([shapely.LineString(e.xy) for e in others], object)
    tree = shapely.STRtree(shapes)
    ends = [e.points[at] for e in others if not is_ring(e.points) for at in (0, -1)]
    common = [_in_common(e, others, shapes, tree) for e in lines]
    pieces: list[Array] = []
    owner: list[int] = []
    cuts: list[tuple[int, int]] = []
    for k, (e, same) in enumerate(zip(lines, common, strict=True)):
        for piece, *cut in left_over(e, same) if same.any() else []:
            cuts += [(len(pieces), at) for at, here in zip((0, -1), cut, strict=True) if here]
            pieces.append(piece)
            owner.append(k)
    for (k, at), end in own_ends(cuts, pieces, np.array(ends)):
        pieces[k] = put_onto(pieces[k], end) if at == 0 else put_onto(pieces[k][::-1], end)[::-1]
    out = []
    for k, (e, same) in enumerate(zip(lines, common, strict=True)):
        mine = [p for p, o in zip(pieces, owner, strict=True) if o == k and length(p) >= GAP]
        out += parts_of(e, mine) if same.any() else [e]
    return out


def _stations(element: Element) -> Array:
    return resample_step(element.xy, STEP)


def _in_common(
    element: Element, others: list[Element], shapes: NDArray[np.object_], tree: shapely.STRtree
) -> NDArray[np.bool_]:
    """(n,) stations of a line that run beside one of the others, short gaps closed."""
    xy = _stations(element)
    direction = tangents(xy)
    points = shapely.points(xy)
    same = np.zeros(len(xy), bool)
    whole = shapely.LineString(element.xy)
    for k in tree.query(whole, predicate="dwithin", distance=SAME):
        line = shapes[k]
        at = shapely.line_locate_point(line, points)
        ahead = shapely.get_coordinates(shapely.line_interpolate_point(line, at + STEP))
        behind = shapely.get_coordinates(
            shapely.line_interpolate_point(line, np.maximum(at - STEP, 0.0))
        )
        d = ahead - behind
        d /= np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-9)[:, None]
        beside = (shapely.distance(line, points) <= SAME) & (
            np.abs((d * direction).sum(axis=1)) >= MIN_COS
        )
        same |= beside
    for run in runs_of(~same):
        inner = run[0] > 0 and run[-1] < len(same) - 1
        if inner and len(run) * STEP < GAP and same.any():
            same[run] = True
    return same
