"""The next map version from the evidence: confirm and move, insert, delete, split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import arc_length, is_ring, length
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.element import OUTLINE_CLASSES, RING_CLASSES, Element, VectorMap
from rtmap_cli.maps.evidence import (
    Counts,
    Evidence,
    Policy,
    Stretch,
    newest_ns,
    prior_log_odds,
)
from rtmap_cli.maps.existence import LIMIT, probability
from rtmap_cli.maps.refit import FusionModel
from rtmap_cli.steps.crowdsource.forks import Branch, forked
from rtmap_cli.steps.crowdsource.lines import fuse_lines, snap_ends
from rtmap_cli.steps.crowdsource.rings import fuse_ring

Array = NDArray[np.float64]

SNAP, SNAP_ANGLE = 3.0, float(np.radians(30))
"""Ends of new lines are joined to ends that they look at over such a gap (m)."""
UNCHARTED = 15.0
"""Where no element of the prior is so near (m), one drive is enough to start a map."""
THIN = 0.04
"""Vertices of new lines that lie so near (m) to the line of their neighbours are left out."""


@dataclass
class Fusion:
    """The next version and what is different: ids ``inserted``, ``deleted`` (an element, or parts
    of it), ``moved`` (geometry changed), ``untouched`` (not in view) and ``waiting`` (new, but not
    yet seen by enough drives)."""

    vector_map: VectorMap
    inserted: list[str] = field(default_factory=list)
    deleted: list[str] = field(default_factory=list)
    split: list[str] = field(default_factory=list)
    moved: list[str] = field(default_factory=list)
    untouched: list[str] = field(default_factory=list)
    waiting: list[str] = field(default_factory=list)

    def counts(self) -> dict[str, int]:
        """Numbers of each kind."""
        names = ("inserted", "deleted", "split", "moved", "untouched", "waiting")
        return {name: len(getattr(self, name)) for name in names}


def fuse(
    prior: VectorMap,
    evidence: Sequence[Evidence],
    fresh: Sequence[Traversal],
    every: Sequence[Traversal],
    policy: Policy | None = None,
    model: FusionModel | None = None,
) -> Fusion:
    """Fuse the ``fresh`` traversals into ``prior``; ``every`` includes those fused before.

    The order of the traversals does not matter. Elements without any evidence are returned as
    they are, so that their tiles stay untouched.
    """
    policy, model = policy or Policy(), model or FusionModel()
    fresh = sorted(fresh, key=lambda t: t.run_id)
    every = sorted(every, key=lambda t: t.run_id)
    out = Fusion(VectorMap((), prior.crs))
    charted = _Charted(prior)
    now_ns = newest_ns(every)
    pieces = [p for e in evidence for p in _pieces(e, policy, charted, now_ns, out)]
    judged = {e.element.element_id for e in evidence if not e.new}
    rest = [e for e in prior if e.element_id not in judged]
    elements = rest + _geometry(pieces, fresh, every, model, out)
    out.untouched += [e.element_id for e in rest]
    out.vector_map = VectorMap(_unique_ids(elements), prior.crs)
    return out


def compared(before: VectorMap, after: VectorMap, waiting: Sequence[str] = ()) -> Fusion:
    """The Fusion that says what is different between two versions of a map, by ids."""
    out = Fusion(after, waiting=list(waiting))
    old, new = before.by_id(), after.by_id()
    out.inserted = [name for name in new if name not in old]
    out.deleted = [name for name in old if name not in new]
    for name in new.keys() & old.keys():
        same = np.array_equal(new[name].points, old[name].points, equal_nan=True)
        (out.untouched if same else out.moved).append(name)
    return out


@dataclass
class _Piece:
    """An element of the next version before its geometry is fused; ``before``: that it was fused
    for a version before this one, too."""

    element: Element
    new: bool
    seen: bool
    before: bool = False


class _Charted:
    """Whether the prior knows anything near a place."""

    def __init__(self, prior: VectorMap) -> None:
        import shapely

        self.tree = shapely.STRtree([shapely.LineString(e.xy) for e in prior])

    def near(self, points: Array) -> bool:
        """True when a prior element lies within ``UNCHARTED`` metres."""
        import shapely

        line = shapely.LineString(points[:, :2])
        return len(self.tree.query(line, predicate="dwithin", distance=UNCHARTED)) > 0


def _pieces(
    evidence: Evidence, policy: Policy, charted: _Charted, now_ns: int, out: Fusion
) -> list[_Piece]:
    """What remains of an element, or what a candidate becomes."""
    if evidence.new:
        return _inserted(evidence, policy, charted, out)
    element = evidence.element
    before = prior_log_odds(element, policy, now_ns)
    if not evidence.in_view:
        out.untouched.append(element.element_id)
        return [_Piece(element, False, False)]
    absent = [not s.exists and _deletable(element, s, policy) for s in evidence.stretches]
    doubted = [not s.exists and _unlikely(s, policy) for s in evidence.stretches]
    if not any(absent) and (not any(doubted) or len(doubted) == 1):
        odds = before + evidence.likelihood_ratio
        return [
            _Piece(_updated(element, odds, evidence.counts), False, True, element.traversals > 0)
        ]
    if any(absent):
        out.deleted.append(element.element_id)
    kept = _kept(evidence.stretches, absent, doubted, is_ring(element.points))
    if not kept:
        return []
    out.split.append(element.element_id)
    return _split(element, kept, before)


def _kept(
    stretches: list[Stretch], absent: list[bool], doubted: list[bool], ring: bool
) -> list[Stretch]:
    """What stays of an element: what is ``doubted`` without being ``absent`` on its own, so that
    the map remembers the doubt, and meeting what is beside it; all else in one piece."""
    groups: list[list[Stretch]] = []
    follows: list[bool] = []
    for k, stretch in enumerate(stretches):
        if absent[k]:
            continue
        beside = k > 0 and not absent[k - 1]
        if beside and not (doubted[k] or doubted[k - 1]):
            groups[-1].append(stretch)
        else:
            groups.append([stretch])
            follows.append(beside)
    if ring and len(groups) > 1 and not (absent[0] or absent[-1]):
        if doubted[0] or doubted[-1]:
            follows[0] = True
        else:
            groups[0], follows[0] = groups.pop() + groups[0], follows.pop()
    out = [_one(g) for g in groups]
    for k, met in enumerate(follows):
        if met:
            both = [out[k - 1].geometry, out[k].geometry[:1]]
            out[k - 1] = replace(out[k - 1], geometry=np.concatenate(both))
    return out


def _one(parts: list[Stretch]) -> Stretch:
    """Stretches that follow each other as one: their evidence by length, counts of the longest."""
    size = np.array([length(p.geometry) for p in parts])
    share = size / size.sum()
    return replace(
        parts[int(size.argmax())],
        exists=True,
        log_odds=float(sum(w * p.log_odds for w, p in zip(share, parts, strict=True))),
        likelihood_ratio=float(
            sum(w * p.likelihood_ratio for w, p in zip(share, parts, strict=True))
        ),
        geometry=np.concatenate([p.geometry for p in parts]),
        start=parts[0].start,
        stop=parts[-1].stop,
    )


def _deletable(element: Element, stretch: Stretch, policy: Policy) -> bool:
    """Improbable, enough drives had a look at it (those of earlier fusions included), and k of the
    newest n missed it."""
    looked = element.traversals + stretch.counts.traversals_in_view
    found, of = stretch.counts.newest(policy.delete_of)
    # Of drives fused before, the map knows how many there were and which found it, not their order.
    room = policy.delete_of - of if policy.delete_of else element.traversals
    before = min(element.traversals, room)
    missed_before = min(max(element.traversals - len(element.runs), 0), before)
    missed = of - found + missed_before >= min(policy.delete_traversals, of + before)
    return _unlikely(stretch, policy) and looked >= policy.delete_traversals and missed


def _unlikely(stretch: Stretch, policy: Policy) -> bool:
    return float(probability(stretch.log_odds)) < policy.delete_below


def _split(element: Element, kept: list[Stretch], before: float) -> list[_Piece]:
    """Elements for the stretches of one; the longest keeps the id."""
    order = sorted(range(len(kept)), key=lambda k: (-length(kept[k].geometry), k))
    taken = element.element_id
    out: dict[int, _Piece] = {}
    for rank, k in enumerate(order):
        stretch = kept[k]
        name = taken if rank == 0 else f"{taken}.{rank}"
        geometry, covariance = _part(element, stretch)
        piece = replace(element, element_id=name, points=geometry, covariance=covariance)
        odds = before + stretch.likelihood_ratio
        fused_before = element.traversals > 0
        out[k] = _Piece(_updated(piece, odds, stretch.counts), False, True, fused_before)
    return [out[k] for k in sorted(out)]


def _part(element: Element, stretch: Stretch) -> tuple[Array, Array | None]:
    """Geometry of a stretch with covariances interpolated along the element."""
    geometry = np.asarray(stretch.geometry, np.float64)
    if geometry.shape[1] == 2:
        geometry = np.column_stack([geometry, np.full(len(geometry), np.nan)])
    if element.covariance is None:
        return geometry, None
    from rtmap_cli.geometry.polylines import project

    _, _, segment = project(geometry, element.points)
    at = arc_length(element.points)
    a = element.points[segment, :2]
    s = at[segment] + np.hypot(*(geometry[:, :2] - a).T)
    rows = [np.interp(s, at, element.covariance[:, k]) for k in range(4)]
    return geometry, np.stack(rows, axis=-1)


def _updated(element: Element, log_odds: float, counts: Counts) -> Element:
    """The element with its log-odds after these runs, and their counts added."""
    if not counts.traversals_in_view:
        return element
    firsts = [t for t in (element.first_seen_ns, counts.first_seen_ns) if t is not None]
    lasts = [t for t in (element.last_seen_ns, counts.last_seen_ns) if t is not None]
    return replace(
        element,
        existence=float(np.clip(log_odds, -LIMIT, LIMIT)),
        seen=element.seen + counts.frames_seen,
        in_view=element.in_view + counts.frames_in_view,
        traversals=element.traversals + counts.traversals_in_view,
        first_seen_ns=min(firsts) if firsts else None,
        last_seen_ns=max(lasts) if lasts else None,
        runs=tuple(sorted({*element.runs, *counts.runs})),
    )


def _inserted(evidence: Evidence, policy: Policy, charted: _Charted, out: Fusion) -> list[_Piece]:
    stretch, counts = evidence.stretches[0], evidence.counts
    element = evidence.element
    first = not charted.near(element.points)
    least = policy.first_above if first else policy.insert_above
    if float(probability(stretch.log_odds)) < least:
        return []
    found, _ = counts.newest(policy.insert_of)
    if not first and found < policy.insert_traversals:
        out.waiting.append(element.element_id)
        return []
    out.inserted.append(element.element_id)
    fresh = replace(
        element,
        existence=stretch.log_odds,
        seen=counts.frames_seen,
        in_view=counts.frames_in_view,
        traversals=counts.traversals_in_view,
        first_seen_ns=counts.first_seen_ns,
        last_seen_ns=counts.last_seen_ns,
        runs=counts.runs,
    )
    return [_Piece(fresh, True, True)]


# ---- geometry


def _geometry(
    pieces: list[_Piece],
    fresh: Sequence[Traversal],
    every: Sequence[Traversal],
    model: FusionModel,
    out: Fusion,
) -> list[Element]:
    done: dict[int, list[Element]] = {}
    for name in dict.fromkeys(p.element.class_name for p in pieces):
        index = [k for k, p in enumerate(pieces) if p.element.class_name == name]
        if name in RING_CLASSES:
            for k in index:
                done[k] = [_fused_ring(pieces[k], name, fresh, every, model, out)]
            continue
        group = [pieces[k] for k in index]
        fused = _fused_lines(group, name, fresh, every, model, out)
        parts = [[e] for e in fused]
        if name not in OUTLINE_CLASSES:
            parts = _at_forks(fused, [p.new for p in group], out)
        done |= dict(zip(index, parts, strict=True))
    return [element for k in sorted(done) for element in done[k]]


def _fused_lines(
    pieces: list[_Piece],
    name: str,
    fresh: Sequence[Traversal],
    every: Sequence[Traversal],
    model: FusionModel,
    out: Fusion,
) -> list[Element]:
    new = [p.new for p in pieces]
    points = [p.element.points.copy() for p in pieces]
    covariances = [p.element.covariance for p in pieces]
    looked_at = [p.seen for p in pieces]
    before = [p.before for p in pieces]
    fused = fuse_lines(points, covariances, new, name, fresh, every, model, looked_at, before)
    moved = [f.points.copy() for f in fused]
    snap_ends(moved, new, SNAP, SNAP_ANGLE)
    elements = []
    model_sha = _model_of(every)
    for piece, f, xyz in zip(pieces, fused, moved, strict=True):
        if not f.touched:
            elements.append(piece.element)
            continue
        covariance = f.covariance
        if piece.new:
            xyz, covariance = _thinned(xyz, covariance)
        else:
            out.moved.append(piece.element.element_id)
        elements.append(
            replace(
                piece.element,
                points=xyz,
                covariance=covariance,
                model_sha256=model_sha or piece.element.model_sha256,
            )
        )
    return elements


def _at_forks(elements: list[Element], new: list[bool], out: Fusion) -> list[list[Element]]:
    """New lines cut where others end on them; the longest part keeps the id."""
    lines = [Branch(e.points, e.covariance, k) for k, e in enumerate(elements)]
    parts: list[list[Branch]] = [[] for _ in elements]
    for branch in forked(lines, new):
        parts[branch.source].append(branch)
    result = []
    for element, own in zip(elements, parts, strict=True):
        order = sorted(range(len(own)), key=lambda k: (-length(own[k].points), k))
        names = {k: f"{element.element_id}.{r}" if r else element.element_id
                 for r, k in enumerate(order)}  # fmt: skip
        out.inserted += [n for n in names.values() if n != element.element_id]
        result.append(
            [
                replace(element, element_id=names[k], points=b.points, covariance=b.covariance)
                for k, b in enumerate(own)
            ]
        )
    return result


def _thinned(points: Array, covariance: Array | None) -> tuple[Array, Array | None]:
    """A new line without needless vertices (Douglas–Peucker), covariances of those that stay."""
    import shapely

    ring = is_ring(points)
    thin = np.asarray(shapely.simplify(shapely.LineString(points[:, :2]), THIN).coords)
    from scipy.spatial import cKDTree

    _, keep = cKDTree(points[:, :2]).query(thin)
    keep = np.asarray(keep)
    if ring:
        keep[-1] = keep[0]
    return points[keep], None if covariance is None else covariance[keep]


def _fused_ring(
    piece: _Piece,
    name: str,
    fresh: Sequence[Traversal],
    every: Sequence[Traversal],
    model: FusionModel,
    out: Fusion,
) -> Element:
    if not piece.seen:
        return piece.element
    e = piece.element
    drives = every if piece.new else fresh
    fused = fuse_ring(e.points, e.covariance, piece.new, name, drives, model)
    if not fused.touched:
        return e
    if not piece.new:
        out.moved.append(e.element_id)
    return replace(
        e,
        points=fused.points,
        covariance=fused.covariance,
        model_sha256=_model_of(drives) or e.model_sha256,
    )


def _model_of(traversals: Sequence[Traversal]) -> str | None:
    """The model behind the traversals: one hash, or the newest run's where they differ."""
    known = [(int(t.timestamp_ns[-1]), t.model_sha256) for t in traversals if len(t.timestamp_ns)]
    named = [k for k in known if k[1]]
    return max(named)[1] if named else None


def _unique_ids(elements: list[Element]) -> list[Element]:
    """Ids that clash (two finds at one place) get a number."""
    seen: set[str] = set()
    out = []
    for e in elements:
        name, k = e.element_id, 1
        while name in seen:
            name, k = f"{e.element_id}.{k}", k + 1
        seen.add(name)
        out.append(e if name == e.element_id else replace(e, element_id=name))
    return out
