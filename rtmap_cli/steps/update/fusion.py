"""The same accumulation as a fusion method: a first map from grids alone, or a prior put right."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.formats.changes import ChangeEvent
from rtmap_cli.geometry.polylines import normals
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.edits import Edit, apply_edits
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap
from rtmap_cli.steps.update.accumulate import Heat, accumulate, layout_of
from rtmap_cli.steps.update.cells import Judge
from rtmap_cli.steps.update.compare import BEHIND, looked_at, needed
from rtmap_cli.steps.update.evidence import Detected, Rates, counts_of, seen_of
from rtmap_cli.steps.update.outlines import Line
from rtmap_cli.steps.update.settings import Settings
from rtmap_cli.steps.update.update import update
from rtmap_cli.steps.update.vectorise import usual_confidence, vectorise

Array = NDArray[np.float64]

REPEATABLE = 0.04
"""No sigma (m) is smaller: drives of one day repeat themselves."""
WIDEST = 1.5
"""No sigma (m) is larger: what is not a ridge has none."""
NEW_LINE = Rates(0.6)
"""How often frames find what is new, where no map says how often they find anything."""


@dataclass(frozen=True)
class GridFusion:
    """A map and the ids of what is different in it."""

    vector_map: VectorMap
    inserted: list[str]
    deleted: list[str]
    split: list[str]
    moved: list[str]
    untouched: list[str]


def fuse_grid(
    traversals: Sequence[Traversal],
    prior: VectorMap,
    classes: Sequence[str],
    judge: Judge,
    settings: Settings,
    common: float = 0.0,
) -> GridFusion:
    """The map that the grids of some drives make of a prior, which may be empty; ``common``:
    variance (m²) of the place that all of them share."""
    traversals = sorted(traversals, key=lambda t: t.run_id)
    if not len(prior):
        elements = first_map(traversals, classes, settings, common)
        names = [e.element_id for e in elements]
        return GridFusion(VectorMap(elements, prior.crs), names, [], [], [], [])
    told = update(traversals, prior, classes, judge, settings)
    done = apply_edits(prior, [edit_of(e) for e in told.events], "grid")
    modified = set(done.modified)
    old = {e.element_id for e in prior}
    new = done.vector_map.by_id()
    parts = [n for n in done.inserted if n.rpartition(".")[0] in old]
    deletes = {e.element_id for e in told.events if e.kind == "delete"}
    return GridFusion(
        done.vector_map,
        [n for n in done.inserted if n not in parts],
        sorted({*done.deleted, *(n for n in deletes if n)}),
        sorted({n.rpartition(".")[0] for n in parts}),
        sorted(modified - deletes),
        sorted(n for n in new if n in old and n not in modified),
    )


def edit_of(event: ChangeEvent) -> Edit:
    """A change as an edit of the map."""
    c = event.counts
    points = np.column_stack([event.points[:, :2], np.full(len(event.points), np.nan)])
    return Edit(
        event.change_id,
        event.kind,
        event.class_name,
        event.element_id,
        points,
        event.log_odds,
        c.frames_seen,
        c.frames_in_view,
        c.traversals_in_view,
        c.first_seen_ns,
        c.last_seen_ns,
        c.runs,
    )


def first_map(
    traversals: Sequence[Traversal],
    classes: Sequence[str],
    settings: Settings,
    common: float = 0.0,
) -> list[Element]:
    """The lines of the grids as elements, where enough drives stand behind them."""
    heat = accumulate(traversals, classes, layout_of(traversals, settings), settings).heat
    model = max((t.timestamp_ns[-1], t.model_sha256 or "") for t in traversals)[1] or None
    out: list[Element] = []
    taken: set[str] = set()
    for name in classes:
        lines = vectorise(heat, name, usual_confidence(heat, name), settings)
        drives = [Detected.of(t, name) for t in traversals]
        for line in lines:
            # Where only one drive looked, it is enough: there is nothing else to map it from.
            looked = float(np.median(looked_at(heat, line.points)))
            if line.drives < BEHIND * min(needed(heat, settings), max(looked, 1.0)):
                continue
            out.append(_element(line, heat, drives, settings, taken, model, common))
    return out


def _element(
    line: Line,
    heat: Heat,
    drives: Sequence[Detected],
    settings: Settings,
    taken: set[str],
    model: str | None,
    common: float,
) -> Element:
    """A line with its evidence and the variance of its place."""
    seen = seen_of(line.points, line.class_name, drives, settings.margin_m)
    counts, votes = counts_of(seen, NEW_LINE)
    x, y = np.round(line.points.mean(axis=0)).astype(int)
    digest = hashlib.sha256(f"{line.class_name} {x} {y}".encode()).hexdigest()[:10]
    name, k = f"{line.class_name}-{digest}", 1
    while name in taken:
        name, k = f"{line.class_name}-{digest}-{k}", k + 1
    taken.add(name)
    return Element(
        name,
        line.class_name,
        line.points,
        _covariance(line, heat, settings, common),
        votes,
        counts.frames_seen,
        counts.frames_in_view,
        counts.traversals_in_view,
        counts.first_seen_ns,
        counts.last_seen_ns,
        {},
        counts.runs,
        model,
    )


def _covariance(line: Line, heat: Heat, settings: Settings, common: float) -> Array:
    """(n, 4) xx, xy, yy, zz per vertex (m²), the same along and across.

    The profile of the grid across a line is that of its detections and of the blur: f / f″ = −σ² at
    the top of a Gaussian. Of the drives behind the line each has one vote.
    """
    field = heat.confidence(line.class_name)
    normal, step = normals(line.points), heat.layout.cell
    left, top, right = (
        heat.layout.value(field, line.points + k * step * normal) for k in (-1.0, 0.0, 1.0)
    )
    bend = np.maximum(2 * top - left - right, 1e-6)
    width = np.maximum(top / bend - settings.blur**2, 0.0) * step**2
    if line.class_name in RING_CLASSES:
        # Borders are no ridges: half a grid cell, as the region's border goes by cells.
        width = np.full(len(line.points), step**2)
    variance = np.clip(width / max(line.drives, 1.0), REPEATABLE**2, WIDEST**2)
    out = np.full((len(line.points), 4), np.nan)
    out[:, 0] = out[:, 2] = variance + common
    out[:, 1] = 0.0
    return out
