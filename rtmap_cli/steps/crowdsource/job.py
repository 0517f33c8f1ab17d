"""One region fused on its own: what a worker does, here or on another machine."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import clip_to_box
from rtmap_cli.logs.agreement import Agreement, agreement
from rtmap_cli.logs.tracks import read_stretch
from rtmap_cli.logs.traversal import Traversal, same_sigma
from rtmap_cli.maps.element import RING_CLASSES, Element, VectorMap
from rtmap_cli.maps.pieces import parts_of, with_covariance
from rtmap_cli.steps.crowdsource.astray import Astray, find_astray
from rtmap_cli.steps.crowdsource.fuse import Fusion
from rtmap_cli.steps.crowdsource.tiling import Box, Region, band_of

Array = NDArray[np.float64]

Compose = Callable[
    [Sequence[Traversal], VectorMap, Sequence[str], Collection[str], float],
    tuple[Fusion, list[Element]],
]
"""Traversals, prior, classes, the runs that are fused already and the variance (m²) of the place
that all of them share → Fusion, and the candidates that wait. The rooms of detect_changes and
crowdsource meet in the command that gives it."""

SAMPLE = 200
"""Detections of a run that are compared with the prior in each region."""


@dataclass(frozen=True)
class Job:
    """Everything that a worker needs: small, and the same wherever it runs.

    ``aligned``: poses (m, 3) and covariances (m, 3, 3) of the runs, by id, that were put onto each
    other; ``common`` (m²): variance of the place that they then share.
    """

    region: Region
    crs: str
    classes: tuple[str, ...]
    fused: frozenset[str]
    anew: bool = False
    without_sigma: bool = False
    aligned: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    common: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What a region became: its ``old`` elements by the id of the one that they come from, ``new``
    ones (the band around its square included), ids by what happened (``told``), ``waiting``, how
    each run agrees with the prior, which are ``astray``, and the ids of those ``used``."""

    box: Box | None
    old: dict[str, list[Element]]
    new: list[Element]
    told: dict[str, list[str]]
    waiting: list[Element]
    agreements: dict[str, Agreement] = field(default_factory=dict)
    astray: list[Astray] = field(default_factory=list)
    used: frozenset[str] = frozenset()


def run_job(job: Job, compose: Compose) -> Outcome:
    """Read the frames of a region, gather what they say and fuse it."""
    region = job.region
    traversals = [read_stretch(path, frames) for path, frames in region.parts]
    traversals = [
        t.moved(*job.aligned[t.run_id]) if t.run_id in job.aligned else t for t in traversals
    ]
    known = VectorMap(region.known, job.crs)
    fresh = [t for t in traversals if t.run_id not in job.fused]
    agree = {t.run_id: agreement(t, known, SAMPLE) for t in fresh} if len(known) else {}
    astray = find_astray(traversals, region.known, job.fused)
    off = {a.run_id for a in astray if a.certain}
    traversals = [t for t in traversals if t.run_id not in off]
    if job.without_sigma:
        traversals = [same_sigma(t) for t in traversals]
    prior = VectorMap((), job.crs) if job.anew else known
    if traversals:
        fusion, waiting = compose(traversals, prior, job.classes, job.fused, job.common)
    else:
        fusion, waiting = Fusion(prior, untouched=[e.element_id for e in prior]), []
    used = frozenset(t.run_id for t in traversals)
    out = _outcome(region, prior, fusion, waiting)
    return replace(out, agreements=agree, astray=astray, used=used)


def _outcome(
    region: Region,
    prior: VectorMap,
    fusion: Fusion,
    waiting: list[Element],
) -> Outcome:
    """What of a fusion belongs to the region."""
    ids, inserted = {e.element_id for e in prior}, set(fusion.inserted)
    old: dict[str, list[Element]] = {
        e.element_id: [] for e in prior if e.element_id in region.owned
    }
    new: list[Element] = []
    for e in fusion.vector_map:
        source = _source(e.element_id, ids, inserted)
        if source is None:
            new += _cut(e, band_of(region.box))
        elif source in old:
            old[source].append(e)
    told = {
        name: [k for k in getattr(fusion, name) if k in old]
        for name in ("deleted", "split", "moved", "untouched")
    }
    here = [e for e in waiting if _within(e, region.box)]
    return Outcome(region.box, old, new, told, here)


def _source(name: str, ids: Collection[str], inserted: Collection[str]) -> str | None:
    """The prior element that an element of the fusion is, or is a part of; None for new ones."""
    if name in ids:
        return name
    stem = name.rpartition(".")[0]
    return stem if stem in ids and name not in inserted else None


def _within(element: Element, box: Box | None) -> bool:
    """True when the middle of the element lies in the box (half open, so that squares share
    nothing)."""
    if box is None:
        return True
    x, y = (element.xy.min(axis=0) + element.xy.max(axis=0)) / 2
    return bool(box[0] <= x < box[2] and box[1] <= y < box[3])


def _cut(element: Element, band: Box | None) -> list[Element]:
    """A new element inside the band: rings whole or not at all, lines cut at its border."""
    if band is None:
        return [element]
    low, high = element.xy.min(axis=0), element.xy.max(axis=0)
    if (low >= band[:2]).all() and (high <= band[2:]).all():
        return [element]
    if element.class_name in RING_CLASSES:
        return [element] if _within(element, band) else []
    return parts_of(element, clip_to_box(with_covariance(element), band))
