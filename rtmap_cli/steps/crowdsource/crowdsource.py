"""The whole of it: cut a fleet into regions, fuse each, put them together."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput
from rtmap_cli.logs.agreement import Agreement
from rtmap_cli.logs.tracks import Track, read_stretch
from rtmap_cli.logs.traversal import same_sigma
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.crowdsource.align.align import align
from rtmap_cli.steps.crowdsource.astray import Astray
from rtmap_cli.steps.crowdsource.fuse import Fusion, compared
from rtmap_cli.steps.crowdsource.identity import keep_ids
from rtmap_cli.steps.crowdsource.job import Compose, Job, Outcome, run_job
from rtmap_cli.steps.crowdsource.stitch import stitch
from rtmap_cli.steps.crowdsource.tiling import SIDE, plan

Array = NDArray[np.float64]

Workers = Callable[[Callable[[Job], Outcome], Sequence[Job]], Iterable[Outcome]]
"""Runs jobs and gives their outcomes in the order of the jobs (``engines``)."""


@dataclass(frozen=True)
class Task:
    """What is to be fused: the map ``before`` (None: there is none), the runs that are ``done``,
    and whether all is fused ``anew``, as if the map were not there but for its ids."""

    before: VectorMap | None
    crs: str
    done: frozenset[str] = frozenset()
    anew: bool = False
    without_sigma: bool = False
    side: float = SIDE

    @property
    def prior(self) -> VectorMap:
        """What the map holds before."""
        return self.before if self.before is not None else VectorMap((), self.crs)


@dataclass(frozen=True)
class Result:
    """The fusion of the ``tracks`` that were used somewhere, with a line for each ``bad`` one, how
    the fresh runs agree with the map, and those that lie ``astray`` with a line each."""

    fusion: Fusion
    tracks: list[Track]
    bad: list[str]
    agreements: dict[str, Agreement]
    astray: dict[str, str]


def crowdsource(
    task: Task,
    tracks: Sequence[Track],
    compose: Compose,
    workers: Workers,
    skip_bad: bool = False,
) -> Result:
    """Fuse the tracks' runs; the same result for any order of them and any workers.

    BadInput when a run turns out to be broken; with ``skip_bad`` it is left out and all begins
    again without it.
    """
    tracks, bad = list(tracks), []
    while True:
        try:
            jobs = _jobs(task, *_aligned(task, tracks))
            outcomes = list(workers(partial(run_job, compose=compose), jobs))
            break
        except BadInput as error:
            broken = [t for t in tracks if error.where.startswith(str(t.path))]
            if not skip_bad or not broken:
                raise
            bad.append(str(error))
            tracks = [t for t in tracks if t is not broken[0]]
            if not tracks:
                raise BadInput(
                    broken[0].path.parent, "none of its runs can be used", bad[0]
                ) from None
    if task.anew:
        made = stitch(VectorMap((), task.crs), outcomes)
        fusion = compared(task.prior, keep_ids(task.prior, made.vector_map), made.waiting)
    else:
        fusion = stitch(task.prior, outcomes)
    astray = _astray(outcomes)
    used = frozenset[str]().union(*(o.used for o in outcomes))
    return Result(
        fusion,
        [t for t in tracks if t.run_id in used],
        bad,
        {name: a for name, a in _agreements(outcomes).items() if name not in astray},
        astray,
    )


def _astray(outcomes: Sequence[Outcome]) -> dict[str, str]:
    """A line about each run that lies elsewhere, by its id."""
    found: dict[str, list[Astray]] = {}
    for a in (a for o in outcomes for a in o.astray):
        found.setdefault(a.run_id, []).append(a)
    out = {}
    for name, parts in sorted(found.items()):
        places = sum(name in o.used for o in outcomes) + sum(a.certain for a in parts)
        text = (
            f"{name}: what it saw lies {max(a.metres for a in parts):.0f} m off the {parts[0].off}"
        )
        if any(a.certain for a in parts):
            where = "" if len(parts) == places else f" in {len(parts)} of {places} tiles"
            out[name] = f"{text}{where}: left out there; localize it again"
        else:
            out[name] = f"{text}, and another run disagrees no less or agrees with it: it counts"
    return out


@dataclass(frozen=True)
class _Placed:
    """Poses (m, 3) and covariances (m, 3, 3) of runs that were put onto each other, by id, and
    the variance (m²) of the place that they share."""

    runs: dict[str, tuple[Array, Array]]
    common: float = 0.0


def _aligned(task: Task, tracks: Sequence[Track]) -> tuple[list[Track], _Placed]:
    """Where nothing says where the runs are but they themselves, they are first put onto each
    other: whole drives at once, before anything is cut into tiles."""
    free = [t for t in tracks if not t.localized]
    if not free or (len(task.prior) and not task.anew):
        return list(tracks), _Placed({})
    traversals = [read_stretch(t.path) for t in free]
    if task.without_sigma:
        traversals = [same_sigma(t) for t in traversals]
    found = align(traversals)
    runs = {t.run_id: (t.pose, t.pose_covariance) for t in found.traversals}
    moved = [replace(t, xy=runs[t.run_id][0][:, :2]) if t.run_id in runs else t for t in tracks]
    return moved, _Placed(runs, found.common)


def _jobs(task: Task, tracks: Sequence[Track], placed: _Placed) -> list[Job]:
    """The regions with everything that a worker needs."""
    tracks = sorted(tracks, key=lambda t: t.run_id)
    classes = tuple(dict.fromkeys(c for t in tracks for c in t.classes))
    by_path = {t.path: t for t in tracks if t.run_id in placed.runs}
    jobs = []
    for region in plan(tracks, list(task.prior), task.side):
        aligned = {}
        for path, frames in region.parts:
            if (track := by_path.get(path)) is not None:
                pose, covariance = placed.runs[track.run_id]
                read = np.ones(len(track), bool) if frames is None else np.isin(track.frame, frames)
                aligned[track.run_id] = (pose[read], covariance[read])
        known = task.crs, classes, task.done, task.anew, task.without_sigma
        jobs.append(Job(region, *known, aligned, placed.common))
    return jobs


def _agreements(outcomes: Collection[Outcome]) -> dict[str, Agreement]:
    """Per run, over its regions."""
    out: dict[str, Agreement] = {}
    for outcome in outcomes:
        for name, found in outcome.agreements.items():
            out[name] = found + out[name] if name in out else found
    return dict(sorted(out.items()))
