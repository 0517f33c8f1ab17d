"""Strands: what several traces drove on the same lane becomes one line, with what leaves and joins.

Traces are taken one after the other, sample by sample, as in incremental map inference (Cao and
Krumm, "From GPS traces to a routable road map", 2009): a sample that lies on a strand of the same
direction counts for it; where a trace leaves all strands a new one begins there, and it ends where
the trace comes onto a strand again. A trace that meets itself (loops, laps) is no special case.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import tangents
from rtmap_cli.steps.label.lanes.traces import STEP, Trace

Array = NDArray[np.float64]
Place = tuple[int, float]
"""A strand and the place on it in samples."""

WITHIN = 1.3
"""Metres aside that still are the same lane: half of the narrowest lane."""
COSINE = 0.8
"""Of the angle between directions that still are the same."""
OWN = 20.0
"""Metres of its own past that a trace cannot meet."""
ENTER, LEAVE = 10, 6
"""Samples on (off) a strand that make it more than chance."""
BACK = 60
"""Samples by which a place of leaving is looked for backwards, at most."""
CELL = 2.0


@dataclass
class Strand:
    """Samples of one trace, in order, and where the strand begins and ends on others (None: free).

    ``start_run``, ``end_run``: the run of matches from which its trace came, into which it went.
    ``ahead``: samples put before it since places on it were counted.
    """

    ids: list[int]
    start: Place | None = None
    end: Place | None = None
    start_run: int | None = None
    end_run: int | None = None
    ahead: int = 0


@dataclass(frozen=True)
class Match:
    """A sample on a strand: where, and metres to the left of it."""

    sample: int
    strand: int
    at: float
    left: float


@dataclass
class Samples:
    """All samples: (n, 2) places and directions, number of the trace, metres from its start."""

    xy: Array
    direction: Array
    trace: NDArray[np.int64]
    s: Array
    speed: Array

    @staticmethod
    def of(traces: Sequence[Trace]) -> Samples:
        """Of traces, one behind the other."""
        return Samples(
            np.concatenate([t.xy for t in traces]),
            np.concatenate([tangents(t.xy) for t in traces]),
            np.repeat(np.arange(len(traces)), [len(t.xy) for t in traces]),
            np.concatenate([np.arange(len(t.xy)) * STEP for t in traces]),
            np.concatenate([t.speed for t in traces]),
        )


@dataclass
class Strands:
    """Strands, and the runs of matches of all traces on them."""

    samples: Samples
    strands: list[Strand] = field(default_factory=list)
    runs: list[list[Match]] = field(default_factory=list)

    def lefts(self) -> Array:
        """Metres aside of all matches."""
        return np.array([m.left for run in self.runs for m in run])


def strands_of(traces: Sequence[Trace]) -> Strands:
    """What all traces drove, each lane once."""
    out = Strands(Samples.of(traces))
    walker = _Walker(out)
    for k in range(len(traces)):
        walker.walk(np.flatnonzero(out.samples.trace == k))
    _join_ends(out)
    _drawn_back(out)
    return out


class _Walker:
    """Goes along traces; ``grid`` holds the samples of strands by cell."""

    def __init__(self, out: Strands) -> None:
        self.out = out
        s = out.samples
        self.x, self.y = s.xy.T.tolist()
        self.dx, self.dy = s.direction.T.tolist()
        self.trace, self.s = s.trace.tolist(), s.s.tolist()
        self.grid: dict[tuple[int, int], list[tuple[int, int, int]]] = defaultdict(list)

    def walk(self, ids: NDArray[np.int64]) -> None:
        """One trace."""
        self.strand: int | None = None
        self.run: list[Match] = []
        pending: list[int] = []
        self.begin([], None)
        for i in ids.tolist():
            found = self.match(i)
            if self.strand is not None:
                self.off(i, found)
            elif found is not None:
                self.run.append(found)
                pending = []
            else:
                pending.append(i)
                if len(pending) >= LEAVE:
                    self.leave(pending)
                    pending = []
        if self.strand is None:
            self.out.runs.append(self.run)
        else:
            for m in self.run:
                self.add(m.sample)

    def begin(self, ids: list[int], start: Place | None) -> None:
        """A new strand."""
        runs = len(self.out.runs)
        self.strand = len(self.out.strands)
        self.out.strands.append(Strand([], start, None, runs - 1 if start else None))
        for i in ids:
            self.add(i)
        self.run = []

    def add(self, i: int) -> None:
        """A sample of the strand that is being made."""
        assert self.strand is not None
        ids = self.out.strands[self.strand].ids
        cell = int(self.x[i] // CELL), int(self.y[i] // CELL)
        self.grid[cell].append((i, self.strand, len(ids)))
        ids.append(i)

    def off(self, i: int, found: Match | None) -> None:
        """A sample while no strand was below."""
        assert self.strand is not None
        if found is None:
            for m in self.run:
                self.add(m.sample)
            self.run = []
            self.add(i)
            return
        self.run.append(found)
        if len(self.run) >= ENTER:
            strand = self.out.strands[self.strand]
            strand.end = (self.run[0].strand, self.run[0].at)
            strand.end_run = len(self.out.runs)
            self.strand = None

    def leave(self, pending: list[int]) -> None:
        """The trace left what it was on."""
        last = self.run[-1]
        self.out.runs.append(self.run)
        self.begin(pending, (last.strand, last.at))

    def match(self, i: int) -> Match | None:
        """The strand that lies below a sample: the nearest one."""
        x, y, dx, dy = self.x[i], self.y[i], self.dx[i], self.dy[i]
        trace, s = self.trace[i], self.s[i]
        best: Match | None = None
        cx, cy = int(x // CELL), int(y // CELL)
        for cell in ((cx + a, cy + b) for a in (-1, 0, 1) for b in (-1, 0, 1)):
            for j, strand, k in self.grid.get(cell, ()):
                gx, gy, ex, ey = x - self.x[j], y - self.y[j], self.dx[j], self.dy[j]
                along = gx * ex + gy * ey
                if abs(along) > 0.7 * STEP or dx * ex + dy * ey < COSINE:
                    continue
                left = gy * ex - gx * ey
                if abs(left) > WITHIN or (self.trace[j] == trace and abs(self.s[j] - s) < OWN):
                    continue
                if best is None or abs(left) < abs(best.left):
                    best = Match(i, strand, k + along / STEP, left)
        return best


def _join_ends(out: Strands) -> None:
    """Where a trace went from a strand to another one that begins or ends there, free ends meet."""
    for run in out.runs:
        for a, b in pairwise(run):
            if a.strand == b.strand and abs(b.at - a.at) < OWN / STEP:
                continue
            before, after = out.strands[a.strand], out.strands[b.strand]
            if before.end is None and a.at > len(before.ids) - OWN / STEP:
                before.end = (b.strand, b.at)
            elif after.start is None and b.at < OWN / STEP:
                after.start = (a.strand, a.at)


def tolerance(out: Strands) -> float:
    """Metres aside by which traces of one lane differ as a rule: three robust sigmas."""
    left = np.abs(out.lefts())
    if not len(left):
        return 0.1
    return float(np.clip(3 * 1.4826 * np.median(left), 0.08, 0.5))


def _drawn_back(out: Strands) -> None:
    """Strands begin (end) where their trace began to leave what it was on, not 1.3 m aside."""
    bound = tolerance(out)
    for strand in out.strands:
        if strand.start_run is not None:
            run = out.runs[strand.start_run]
            taken = _departing(run[::-1], bound)
            if taken:
                strand.ids[:0] = [m.sample for m in run[len(run) - taken :]]
                strand.ahead = taken
                strand.start = (run[-taken].strand, run[-taken].at)
                del run[len(run) - taken :]
    for strand in out.strands:
        if strand.end_run is not None and strand.end_run < len(out.runs):
            run = out.runs[strand.end_run]
            taken = _departing(run, bound)
            if taken:
                strand.ids += [m.sample for m in run[:taken]]
                strand.end = (run[taken - 1].strand, run[taken - 1].at)
                del run[:taken]


def _departing(run: Sequence[Match], bound: float) -> int:
    """How many of the first matches belong to the leaving: until one lies on the strand."""
    if not run:
        return 0
    for k, m in enumerate(run[:BACK]):
        if m.strand != run[0].strand:
            return k
        if abs(m.left) <= bound:
            return k + 1
    return 0
