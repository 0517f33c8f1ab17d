"""Alg. 1 as a whole: accumulate, vectorise, compare with the map by cells, tell the changes."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.formats.changes import ChangeEvent
from rtmap_cli.geometry.blocks import Layout
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.edits import Edit, together
from rtmap_cli.maps.element import RING_CLASSES, VectorMap
from rtmap_cli.maps.evidence import Counts
from rtmap_cli.maps.existence import probability
from rtmap_cli.steps.update.accumulate import Heat, accumulate, layout_of
from rtmap_cli.steps.update.cells import Cell, Judge, flagged_stretches, judge_cells
from rtmap_cli.steps.update.claims import Claims
from rtmap_cli.steps.update.compare import (
    MISSING_NEW,
    MISSING_OLD,
    MOVED,
    Stretch,
    compare,
    usual_of,
)
from rtmap_cli.steps.update.moves import move_odds
from rtmap_cli.steps.update.outlines import Line
from rtmap_cli.steps.update.settings import Settings
from rtmap_cli.steps.update.vectorise import usual_confidence, vectorise
from rtmap_cli.steps.update.witnesses import Witnesses

Array = NDArray[np.float64]

KINDS = {MISSING_OLD: "insert", MISSING_NEW: "delete", MOVED: "modify"}
CANDIDATE = 0.25
"""From this probability on a stretch is a reason to look at its cell."""
BEFORE = {"insert": -1.0, "delete": -2.5, "modify": -1.0}
"""Log-odds of a change before the votes: most of a map is right."""


@dataclass(frozen=True)
class Update:
    """The grids, the lines found in them, the cells, and the changes with their reasons."""

    heat: Heat
    lines: list[Line]
    cells: list[Cell]
    events: list[ChangeEvent]
    reasons: dict[str, str]


def update(
    traversals: Sequence[Traversal],
    old: VectorMap,
    classes: Sequence[str],
    judge: Judge,
    settings: Settings,
) -> Update:
    """What some drives say of a map: cells that differ, and the changes that put them right."""
    layout = layout_of(traversals, settings)
    near = _in_reach(old, layout)
    found = accumulate(traversals, classes, layout, settings, near)
    heat = found.heat
    lines: list[Line] = []
    stretches: list[Stretch] = []
    for name in classes:
        mine = near.of_class(name)
        usual = usual_of(mine, heat, usual_confidence(heat, name))
        all_ = vectorise(heat, name, usual, settings)
        lines += all_
        left = vectorise(found.rest, name, usual, settings) if mine else all_
        stretches += compare(name, mine, left, found, usual, settings)
    told = _named_apart(_judged(stretches, traversals, near, found.claims, settings))
    kept = [s for s, _ in told]
    cells = judge_cells(list(near), lines, kept, heat, judge, settings)
    flagged = {id(s) for s in flagged_stretches(kept, cells)}
    least = settings.min_probability
    events = [(e, s.reason) for s, e in told if id(s) in flagged and e.probability >= least]
    events.sort(key=lambda x: (-x[0].probability, x[0].change_id))
    apart = _without_overlaps([e for e, _ in events], near)
    events = [(e, reason) for e, reason in events if e.change_id in apart]
    reasons = {e.change_id: reason for e, reason in events}
    return Update(heat, lines, cells, [e for e, _ in events], reasons)


def _in_reach(old: VectorMap, layout: Layout) -> VectorMap:
    """The elements of which some vertex lies in a block of the grids."""
    points = [e.xy for e in old]
    if not points:
        return old
    cells = np.floor(np.concatenate(points) / layout.cell).astype(np.int64)
    there = layout.places(cells) >= 0
    owner = np.repeat(np.arange(len(points)), [len(p) for p in points])
    kept = np.bincount(owner, there, len(points)) > 0
    return VectorMap([e for e, k in zip(old, kept, strict=True) if k], old.crs, old.version)


def _judged(
    stretches: Sequence[Stretch],
    traversals: Sequence[Traversal],
    old: VectorMap,
    claims: Mapping[str, Claims],
    settings: Settings,
) -> list[tuple[Stretch, ChangeEvent]]:
    """The stretches whose drives' votes make them probable enough, as changes."""
    out = []
    for name in dict.fromkeys(s.class_name for s in stretches):
        mine = [s for s in stretches if s.class_name == name]
        witness = Witnesses(traversals, old.of_class(name), name, claims.get(name), settings)
        for s in mine:
            counts, votes = witness.say(s)
            event = _event(s, counts, votes)
            agreed = counts.traversals_seen
            if event.kind == "delete":
                agreed = counts.traversals_in_view - agreed
            enough = agreed >= min(settings.drives, len(traversals))
            if enough and event.probability >= min(CANDIDATE, settings.min_probability):
                out.append((s, _bounded(event, move_odds(s, stretches))))
    return out


def _named_apart(told: list[tuple[Stretch, ChangeEvent]]) -> list[tuple[Stretch, ChangeEvent]]:
    """Changes whose middles lie within the same metre get names of their own."""
    count: Counter[str] = Counter()
    out = []
    for stretch, event in told:
        k = count[event.change_id]
        count[event.change_id] += 1
        out.append((stretch, replace(event, change_id=f"{event.change_id}-{k}") if k else event))
    return out


def _without_overlaps(events: Sequence[ChangeEvent], old: VectorMap) -> set[str]:
    """The ids of changes that can be made together, the first ones first: where a stretch lies now
    may reach beside the next one, which is then no change of its own."""
    by_element: dict[str, list[Edit]] = {}
    for e in events:
        edit = Edit(e.change_id, e.kind, e.class_name, e.element_id, e.points)
        by_element.setdefault(e.element_id or e.change_id, []).append(edit)
    known = old.by_id()
    parts = [together(known[k], v) if k in known else v for k, v in by_element.items()]
    return {edit.change_id for part in parts for edit in part}


def _bounded(event: ChangeEvent, most: float) -> ChangeEvent:
    """A change whose log-odds are at most ``most``: its place is looked at all the same."""
    odds = min(event.log_odds, most)
    return replace(event, probability=float(probability(odds)), log_odds=odds)


def _event(stretch: Stretch, counts: Counts, votes: float) -> ChangeEvent:
    """A stretch as a change, with what its drives say."""
    kind = KINDS[stretch.reason]
    odds = BEFORE[kind] + (-votes if kind == "delete" else votes)
    points = stretch.points
    if stretch.class_name in RING_CLASSES and not is_ring(points):
        points = np.concatenate([points, points[:1]])
    return ChangeEvent(
        _change_id(kind, stretch.element_id, stretch.class_name, points),
        kind,
        stretch.class_name,
        stretch.element_id,
        points,
        float(probability(odds)),
        float(odds),
        counts,
    )


def _change_id(kind: str, element_id: str | None, class_name: str, points: Array) -> str:
    """The same change of the same place gets the same id every time."""
    x, y = np.round(points.mean(axis=0)).astype(int)
    text = f"{kind} {element_id or class_name} {x} {y}"
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"
