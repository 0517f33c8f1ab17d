"""From traversals and a prior map to the evidence about every element, old and new."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import is_ring, length
from rtmap_cli.geometry.rings import RING_POINTS, close, open_ring
from rtmap_cli.logs.offsets import fused_offsets
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.assignment import assign_once, offset_sigma
from rtmap_cli.maps.element import OUTLINE_CLASSES, RING_CLASSES, Element, VectorMap
from rtmap_cli.maps.evidence import (
    Counts,
    Evidence,
    Policy,
    Settings,
    Stretch,
    newest_ns,
    prior_log_odds,
)
from rtmap_cli.maps.existence import (
    LIMIT,
    runs_of,
    stretches,
)
from rtmap_cli.maps.registration import registered
from rtmap_cli.maps.sight import SightModel
from rtmap_cli.maps.stations import GATE, MIN_COS, Samples, Stations, stations_of
from rtmap_cli.steps.detect_changes.bridges import bridged, cut_beside
from rtmap_cli.steps.detect_changes.crossings import class_rings, new_rings, ring_counts
from rtmap_cli.steps.detect_changes.doubles import split_doubles
from rtmap_cli.steps.detect_changes.folds import folds, shared
from rtmap_cli.steps.detect_changes.gaps import part_at_gaps
from rtmap_cli.steps.detect_changes.lines import (
    all_line_counts,
    joined_lines,
    new_lines,
    refit_lines,
)
from rtmap_cli.steps.detect_changes.rivals import (
    apart_from_known,
    neighbours,
    questioned,
    weighed,
    weighed_rings,
)
from rtmap_cli.steps.detect_changes.twins import without_twins
from rtmap_cli.steps.detect_changes.votes import Ballot, ballot, sight_of

Array = NDArray[np.float64]

APART = 8
"""Every so many stations (m) a line says something of its own about how often lines are found."""


def gather_evidence(
    traversals: Sequence[Traversal],
    prior: VectorMap,
    classes: Sequence[str],
    settings: Settings | None = None,
    fused: Collection[str] = (),
) -> list[Evidence]:
    """Evidence on every prior element of ``classes`` and on every new candidate.

    Traversals are put in order of their run ids, so that their order does not matter. Elements
    come in the order of the map, new ones after them, class by class. Runs in ``fused`` are part
    of the prior already: they speak for new candidates only.
    """
    settings = settings or Settings()
    if not len(prior):
        first = replace(settings.policy, new_log_odds=settings.policy.first_log_odds)
        settings = replace(settings, policy=first)
    traversals = sorted(traversals, key=lambda t: t.run_id)
    fresh = np.array([t.run_id not in fused for t in traversals], bool)
    out: list[Evidence] = []
    for name in classes:
        judge = _rings if name in RING_CLASSES else _lines
        out += judge(name, traversals, fresh, prior.of_class(name), settings)
    return out


def new_id(class_name: str, geometry: Array) -> str:
    """An id from class and place (to half a metre): the same find gets the same id again."""
    place = np.round(np.asarray(geometry)[:, :2].mean(axis=0) * 2) / 2
    size = round(length(geometry))
    text = f"{class_name} {place[0]:.1f} {place[1]:.1f} {size}"
    return f"{class_name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"


# ---- lines


def _lines(
    name: str,
    traversals: Sequence[Traversal],
    fresh: NDArray[np.bool_],
    prior: list[Element],
    settings: Settings,
) -> list[Evidence]:
    policy, now_ns = settings.policy, newest_ns(traversals)
    old = [e.xy for e in prior]
    known = stations_of(old)
    seen = [t.samples(name) for t in traversals]
    samples = [registered(s, known) for s in seen]
    sigma = [offset_sigma(known, s) for s in samples]
    owns = [t.answered(name, [e.element_id for e in prior]) for t in traversals]
    feet = [assign_once(known, s, own=own)[0] for s, own in zip(samples, owns, strict=True)]
    sight = sight_of(known, traversals, samples, feet, policy.view_margin_m)
    found = new_lines(name, known, traversals, samples, owns)
    found = refit_lines(found, old, traversals, samples, settings.fusion)
    found = split_doubles(found, old, samples)
    for _ in range(2):
        found = refit_lines(found, old, traversals, samples, settings.fusion)
    for last in (False, True):
        stations = stations_of([*old, *found])
        if not len(stations):
            return []
        ids = [e.element_id for e in prior] + [""] * len(found)
        votes = _line_votes(
            stations, ids, prior, traversals, samples, owns, sigma, sight, fresh, settings
        )
        if last:
            break
        # What is left of the candidates competes once more, without those that were refuted.
        found = _supported(found, len(old), stations, votes, policy)
        found = joined_lines(found, name, bool(old))
        if name in OUTLINE_CLASSES:
            found = cut_beside(found)
        found = joined_lines(bridged(found, old, traversals, samples), name, bool(old))
        found = part_at_gaps(found, old, samples)
        found = without_twins(found, old, samples)
    out = [_line_evidence(e, k, stations, votes, settings, now_ns) for k, e in enumerate(prior)]
    # Where a line of the map lies is told by what was seen, not by what the map made of it.
    _add_offsets(out, stations, traversals, seen, fresh, settings)
    for k, line in enumerate(found):
        element = Element(new_id(name, line), name, line)
        out.append(
            _line_evidence(element, len(old) + k, stations, votes, settings, now_ns, new=True)
        )
    return out


def _line_votes(
    stations: Stations,
    ids: Sequence[str],
    prior: Sequence[Element],
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    owns: Sequence[NDArray[np.int64]],
    sigma: Sequence[Array],
    sight: SightModel,
    fresh: NDArray[np.bool_],
    settings: Settings,
) -> Ballot:
    """The votes on all stations, the first lines being those of the ``prior``; ``sigma`` of
    every drive's samples as ``offset_sigma`` has it, ``owns`` as for ``all_line_counts``."""
    old = len(prior)
    before = int(np.searchsorted(stations.line, old))
    margin = settings.policy.view_margin_m
    drives = stations, ids, traversals, samples, owns, margin, sight
    # Lines that are all new part best by what is nearest; known ones may be seen farther off.
    full = all_line_counts(*drives, wide=old > 0)
    history = _history(prior)[:, stations.line[:before]]
    across = folds(stations, before)
    counts = [shared(c, across) for c in full.counts]
    votes = ballot(counts, traversals, settings.votes, fresh, before, APART, history)
    picked = np.arange(len(stations)) >= before
    pairs = neighbours(stations)
    doubtful = questioned(votes, pairs, before)
    some = np.flatnonzero(fresh)
    for asked, rows in ((picked, np.arange(len(fresh))), (doubtful, some)):
        # When all choose last they choose as they did.
        if asked.any() and len(rows) and not (asked | picked).all():
            without = all_line_counts(*drives, first=~(asked | picked))
            votes = weighed(
                votes,
                full.select(rows),
                without.select(rows),
                [sigma[int(k)] for k in rows],
                asked,
                pairs,
                stations,
                picked,
                settings.policy.new_log_odds,
            )
    return votes


def _history(prior: Sequence[Element]) -> Array:
    """(3, n) of elements of the map: frames that found them, had them in view, and drives."""
    rows = [(e.seen, e.in_view, e.traversals) for e in prior]
    return np.array(rows, float).reshape(-1, 3).T


def _add_offsets(
    prior: list[Evidence],
    stations: Stations,
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    fresh: NDArray[np.bool_],
    settings: Settings,
) -> None:
    """Where the fresh drives put the prior lines, relative to where the map has them."""
    if not prior or not fresh.any():
        return
    chosen = np.flatnonzero(fresh).tolist()
    offset, variance = fused_offsets(
        stations, [traversals[k] for k in chosen], [samples[k] for k in chosen], settings.fusion
    )
    offset = np.where(_ambiguous(stations), np.nan, offset)
    for k, e in enumerate(prior):
        index = stations.of_line(k)
        e.places, e.normals = stations.xy[index], stations.normal[index]
        e.offset, e.offset_sigma = offset[index], np.sqrt(variance[index])


def _ambiguous(stations: Stations) -> NDArray[np.bool_]:
    """(n,) True where another line, or the far side of an island, runs beside a station.

    A detection between the two may belong to either: it says nothing of a displacement.
    """
    from scipy.spatial import cKDTree

    pairs = cKDTree(stations.xy).query_pairs(2 * GATE, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    d = stations.xy[b] - stations.xy[a]
    apart = np.abs((d * stations.normal[a]).sum(axis=1)) > 0.3
    parallel = np.abs((stations.tangent[a] * stations.tangent[b]).sum(axis=1)) > MIN_COS
    beside = apart & parallel
    out = np.zeros(len(stations), bool)
    out[a[beside]] = out[b[beside]] = True
    return out


def _supported(
    found: list[Array], before: int, stations: Stations, votes: Ballot, policy: Policy
) -> list[Array]:
    """The stretches of candidates that the votes bear out, each a line of its own."""
    out = []
    evidence = votes.evidence
    for k, line in enumerate(found):
        index = stations.of_line(before + k)
        ring = is_ring(line)
        real = stretches(
            evidence[index],
            stations.spacing[index] / policy.correlation_m,
            policy.new_log_odds if before else policy.first_log_odds,
            policy.switch,
            ring,
        )
        if ring and real.all():
            out.append(stations.xy[index])
            continue
        for run in runs_of(real, ring):
            piece = stations.xy[index[run]]
            if len(piece) > 1 and length(piece) >= policy.shortest_m:
                out.append(piece)
    return out


def _line_evidence(
    element: Element,
    k: int,
    stations: Stations,
    votes: Ballot,
    settings: Settings,
    now_ns: int,
    new: bool = False,
) -> Evidence:
    policy = settings.policy
    index = stations.of_line(k)
    ring = is_ring(element.points)
    before = policy.new_log_odds if new else prior_log_odds(element, policy, now_ns)
    evidence = votes.evidence[index]
    looked = votes.views[index] > 0
    real = np.ones(len(index), bool)
    if not new:
        # The prior log-odds of an element speak for its length as one vote does.
        weight = stations.spacing[index] / policy.correlation_m
        real = stretches(np.where(looked, evidence, 0.0), weight, before, policy.switch, ring)
        real = _without_slivers(real, stations.spacing[index], policy.shortest_m, ring)
    parts = []
    for flag in (True, False):
        for run in runs_of(real == flag, ring and bool(real.any()) and not real.all()):
            parts.append(_stretch(element, stations, votes, index, run, flag, before, policy))
    mean = _mean_evidence(evidence, stations.spacing[index], looked)
    if stations.spacing[index].sum() < policy.shortest_m:
        mean = max(mean, 0.0)
    return Evidence(
        element,
        sorted(parts, key=lambda p: p.start),
        new,
        votes.counts(index[looked]),
        mean,
        votes.hits[index],
        votes.views[index],
    )


def _mean_evidence(evidence: Array, spacing: Array, looked: NDArray[np.bool_]) -> float:
    """Mean over the stations that were looked at; stretches nobody saw say nothing."""
    if not looked.any():
        return 0.0
    weight = np.maximum(spacing, 1e-6)[looked]
    return float((evidence[looked] * weight).sum() / weight.sum())


def _stretch(
    element: Element,
    stations: Stations,
    votes: Ballot,
    index: NDArray[np.int64],
    run: NDArray[np.int64],
    exists: bool,
    before: float,
    policy: Policy,
) -> Stretch:
    places = index[run]
    looked = votes.views[places] > 0
    ratio = _mean_evidence(votes.evidence[places], stations.spacing[places], looked)
    # Short stretches are less than one vote.
    extent = float(stations.spacing[places].sum())
    ratio *= min(1.0, max(extent / policy.correlation_m, 0.3))
    whole = len(run) == len(index)
    if whole and exists and extent < policy.shortest_m:
        # Nobody reports pieces of that length: that they are not found says nothing.
        ratio = max(ratio, 0.0)
    geometry = element.points if whole else _cut_out(element.points, stations, places)
    odds = float(np.clip(before + ratio, -LIMIT, LIMIT))
    counts = votes.counts(places[looked])
    return Stretch(exists, odds, ratio, geometry, counts, int(run[0]), int(run[-1]))


def _cut_out(points: Array, stations: Stations, places: NDArray[np.int64]) -> Array:
    """The part of a line between two of its stations, with its own vertices in between."""
    from rtmap_cli.geometry.polylines import arc_length

    at = arc_length(points)
    a, b = float(stations.s[places[0]]), float(stations.s[places[-1]])
    if b <= a:
        # The stretch runs over the start of a ring.
        turned = np.concatenate([points, points[1:]])
        at = np.concatenate([at, at[1:] + at[-1]])
        b += float(at[len(points) - 1])
        points = turned
    inside = (at > a + 1e-9) & (at < b - 1e-9)
    ends = [
        np.array([np.interp(x, at, points[:, k]) for k in range(points.shape[1])]) for x in (a, b)
    ]
    return np.concatenate([ends[0][None], points[inside], ends[1][None]])


def _without_slivers(
    real: NDArray[np.bool_], spacing: Array, shortest: float, ring: bool
) -> NDArray[np.bool_]:
    """Absent runs too short to be told of, and elements as short, count as existing: nobody
    reports pieces of that length."""
    out = real.copy()
    for run in runs_of(~real, ring and bool(real.any())):
        out[run] = spacing[run].sum() < shortest
    return out


# ---- closed elements


def _rings(
    name: str,
    traversals: Sequence[Traversal],
    fresh: NDArray[np.bool_],
    prior: list[Element],
    settings: Settings,
) -> list[Evidence]:
    drives = [class_rings(t, name) for t in traversals]
    old = np.array([open_ring(e.xy) for e in prior]).reshape(-1, RING_POINTS, 2)
    found = new_rings(old, drives)
    places = np.concatenate([old, found])
    if not len(places):
        return []
    elements = list(prior) + [Element(new_id(name, r), name, close(r)) for r in found]
    ids = [e.element_id for e in elements]
    counts, owners = ring_counts(places, ids, traversals, drives)
    history = _history(prior)
    votes = ballot(counts, traversals, settings.votes, fresh, len(prior), history=history)
    if len(found) and len(old):
        alone = ring_counts(places, ids, traversals, drives, first=len(old))
        votes = weighed_rings(votes, (counts, owners), alone, drives, places, len(old))
        before = [prior_log_odds(e, settings.policy, newest_ns(traversals)) for e in prior]
        votes = apart_from_known(votes, places, np.array(before))
    return [
        _ring_evidence(e, k, votes, settings, newest_ns(traversals), new=k >= len(prior))
        for k, e in enumerate(elements)
    ]


def _ring_evidence(
    element: Element, k: int, votes: Ballot, settings: Settings, now_ns: int, new: bool
) -> Evidence:
    policy = settings.policy
    before = policy.new_log_odds if new else prior_log_odds(element, policy, now_ns)
    ratio = float(votes.evidence[k]) if votes.views[k] > 0 else 0.0
    odds = float(np.clip(before + ratio, -LIMIT, LIMIT))
    index = np.array([k])
    counts = votes.counts(index) if votes.views[k] > 0 else Counts()
    return Evidence(
        element,
        [Stretch(new or odds > 0, odds, ratio, element.points, counts)],
        new,
        counts,
        ratio,
        votes.hits[index],
        votes.views[index],
    )
