"""From evidence to the changes that are told: inserts, deletes (also of stretches), modifies."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.formats.changes import ChangeEvent
from rtmap_cli.geometry.polylines import length
from rtmap_cli.maps.evidence import Evidence, Policy, Stretch
from rtmap_cli.maps.existence import logit, probability, runs_of

Array = NDArray[np.float64]

DISPLACED = 0.3
"""A line that lies farther (m) from its place in the map than this is modified …"""
TOLD = 0.6
"""… and told of where it is at least this (m) …"""
TOLD_LENGTH = 8.0
"""… over such a length (m): corners and ends alone are no displacement."""


def change_events(
    evidence: Sequence[Evidence], min_probability: float = 0.5, displaced: bool = False
) -> list[ChangeEvent]:
    """The changes of at least ``min_probability``, most probable first.

    A delete is an element or a stretch of it that does not exist, an insert a new element, a
    modify (only with ``displaced``) a stretch that exists but elsewhere.
    """
    out: list[ChangeEvent] = []
    for e in evidence:
        for stretch in e.stretches:
            if e.new:
                out.append(_event("insert", e, stretch, stretch.log_odds))
            elif not stretch.exists:
                out.append(_event("delete", e, stretch, -stretch.log_odds))
        if displaced and not e.new:
            out += _modified(e)
    out = [c for c in out if c.probability >= min_probability]
    return sorted(out, key=lambda c: (-c.probability, c.change_id))


def told_changes(
    evidence: Sequence[Evidence], policy: Policy, kilometres: float, displaced: bool = False
) -> list[ChangeEvent]:
    """The changes that a policy tells of drives of so many ``kilometres``, most probable first."""
    found = change_events(evidence, policy.least, displaced)
    if policy.max_false_alarms_per_km is None:
        return found
    return within_budget(found, kilometres, policy.max_false_alarms_per_km)


def within_budget(
    events: Sequence[ChangeEvent], kilometres: float, max_per_km: float
) -> list[ChangeEvent]:
    """The most probable changes, as many as may be told with ``max_per_km`` false alarms expected.

    Of calibrated probabilities the expected number of false alarms is Σ (1 − p); a delete and an
    insert of one probability are told or left out together.
    """
    order = sorted(events, key=lambda c: (-c.probability, c.change_id))
    told = np.array([c.probability for c in order])
    expected = np.cumsum(1.0 - told)
    ok = expected <= max_per_km * kilometres + 1e-12
    count = int(ok.sum())
    # Equal probabilities are one step.
    while 0 < count < len(told) and told[count] == told[count - 1]:
        count -= 1
    return order[:count]


def _event(
    kind: str, evidence: Evidence, stretch: Stretch, log_odds: float, points: Array | None = None
) -> ChangeEvent:
    element, counts = evidence.element, stretch.counts
    geometry = stretch.geometry if points is None else points
    # A run that found it from afar had it in view, though too little for "looked and not there".
    in_view = max(counts.traversals_in_view, counts.traversals_seen)
    return ChangeEvent(
        change_id=_change_id(kind, element.element_id, geometry),
        kind=kind,
        class_name=element.class_name,
        element_id=None if evidence.new else element.element_id,
        points=geometry,
        probability=float(probability(log_odds)),
        log_odds=float(log_odds),
        counts=replace(counts, traversals_in_view=in_view),
    )


def _change_id(kind: str, element_id: str, geometry: Array) -> str:
    """The same change of the same place gets the same id in every run of the command."""
    place = np.round(geometry[:, :2].mean(axis=0)).astype(int)
    text = f"{kind} {element_id} {place[0]} {place[1]}"
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"


def _modified(evidence: Evidence) -> list[ChangeEvent]:
    """Stretches whose detections agree on another place, across the line.

    The probability that the line lies more than ``DISPLACED`` from its place in the map, from the
    fused offset and its variance (Gaussian).
    """
    from scipy.special import ndtr

    offset, sigma = evidence.offset, evidence.offset_sigma
    if not len(offset):
        return []
    moved = np.isfinite(offset) & (np.abs(np.nan_to_num(offset)) >= TOLD)
    moved &= np.abs(np.nan_to_num(offset)) >= 3 * sigma
    out = []
    for run in runs_of(moved):
        points = evidence.places[run] + offset[run, None] * evidence.normals[run]
        if len(run) < 2 or length(points) < TOLD_LENGTH:
            continue
        if np.ptp(np.sign(offset[run])) > 0:
            continue
        z = (np.abs(offset[run]) - DISPLACED) / sigma[run]
        p = float(ndtr(np.median(z)))
        stretch = Stretch(True, 0.0, 0.0, points, evidence.counts, int(run[0]), int(run[-1]))
        out.append(_event("modify", evidence, stretch, float(logit(p)), points))
    return out
