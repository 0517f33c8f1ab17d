"""What each drive says about a stretch: frames that had it in view, frames that found it, a vote.

A drive's vote is the log-likelihood ratio of its frames under "the line is there" and "it is not"
(found now and then); frames of one drive are alike, so that they count as a few and the vote
saturates. What is there is found at the usual rate of its class or, where it is worn or half
hidden, at a part of it; it is worn for all drives or for none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.blocks import points_along
from rtmap_cli.geometry.polylines import normals, resample_step
from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.element import RING_CLASSES, Element
from rtmap_cli.maps.evidence import Counts, DriveEvidence
from rtmap_cli.maps.visibility import views
from rtmap_cli.steps.update.claims import Drive

Array = NDArray[np.float64]
Int = NDArray[np.int64]

STEP = 2.0
"""Metres between the places of a stretch that are looked at."""
NEAR = 1.0
"""A detection within so much (m) of a line found it."""
RING_NEAR = 3.0
"""... of the centre of an outline."""
HALF = 0.5
"""Share of a stretch that must be in view, and of what is in view that must be found."""
ENOUGH = 8
"""So many places of a stretch are enough of a long one."""
FRAMES = 12.0
"""Frames of one drive count as so many at most: they are alike."""
FALSE_RATE = 0.02
"""How often frames find what is not there."""
HARD, HARD_SHARE = 0.25, 0.15
"""Part of the usual rate at which worn places are found, and how many places are."""
SATURATED = 4.0
"""No drive says more (log-odds)."""
ASIDE = 1.5
"""Metres beside a line at which its errors look like a line of their own."""
SAMPLE = 60
"""Stretches of old elements whose rate of being found is the usual one."""


@dataclass(frozen=True)
class Detected:
    """The detections of one drive and class for look-ups: a KD-tree over x, y and frame."""

    traversal: Traversal
    tree: Any
    xy: Array
    score: Array

    @staticmethod
    def of(traversal: Traversal, class_name: str, chosen: Int | None = None) -> Detected:
        """Points along the lines of a class, or the middles of its outlines; of all detections or
        of the ``chosen`` rows."""
        from scipy.spatial import cKDTree

        mine = np.flatnonzero(traversal.class_name == class_name) if chosen is None else chosen
        if class_name in RING_CLASSES:
            which, xy = np.arange(len(mine)), traversal.points[mine][:, :-1].mean(axis=1)
        else:
            which, xy, _ = points_along(traversal.points[mine], NEAR)
        xy, row = xy.reshape(-1, 2), mine[which]
        tree = cKDTree(_lifted(xy, traversal.frame[row]))
        return Detected(traversal, tree, xy, traversal.score[row])

    @staticmethod
    def of_samples(drive: Drive, index: Int, raw: bool = False) -> Detected:
        """Some of the samples of a drive, as they were put onto the map, or ``raw``."""
        from scipy.spatial import cKDTree

        s = drive.samples
        xy = s.xy[index] - raw * drive.shift[index]
        return Detected(drive.traversal, cKDTree(_lifted(xy, s.frame[index])), xy, s.score[index])

    def found(
        self, xy: Array, frame: Int, near: float, rivals: Any = None
    ) -> tuple[NDArray[np.bool_], Int]:
        """Whether some detection of its frame lies within ``near`` metres of each point (n, 2), and
        its number; one that lies nearer to a line of ``rivals`` (shapely) is that line's."""
        if not len(self.xy):
            return np.zeros(len(xy), bool), np.zeros(len(xy), np.int64)
        far, at = self.tree.query(_lifted(xy, frame), distance_upper_bound=near)
        hit, at = np.isfinite(far), np.minimum(at, len(self.xy) - 1)
        if rivals is not None and hit.any():
            import shapely

            other = shapely.distance(shapely.points(self.xy[at[hit]]), rivals)
            hit[hit] = far[hit] <= other
        return hit, np.asarray(at, np.int64)


def _lifted(xy: Array, frame: Int) -> Array:
    """Points with their frame as a third axis: those of other frames are far away."""
    return np.column_stack([xy, frame * 1000.0])


@dataclass(frozen=True)
class Seen:
    """Frames of one drive that had a stretch in view (``times``, ns), which of them ``found`` it,
    the ``scores`` of what they found (0: nothing), and their mean (None: nothing)."""

    run_id: str
    times: Int
    found: NDArray[np.bool_]
    scores: Array
    score: float | None
    first_ns: int


def seen_of(
    points: Array,
    class_name: str,
    drives: Sequence[Detected],
    margin: float,
    rivals: Any = None,
) -> list[Seen]:
    """What each drive saw of a stretch (n, 2) in the map frame; ``rivals``: other lines (shapely)
    that detections may belong to."""
    return all_seen([points], class_name, drives, margin, rivals)[0]


def all_seen(
    stretches: Sequence[Array],
    class_name: str,
    drives: Sequence[Detected],
    margin: float,
    rivals: Any = None,
) -> list[list[Seen]]:
    """``seen_of`` for many stretches: frames look for the places of all of them at once."""
    ring = class_name in RING_CLASSES
    places = [p[:-1].mean(axis=0)[None] if ring else resample_step(p, STEP) for p in stretches]
    if not places:
        return []
    owner = np.repeat(np.arange(len(places)), [len(p) for p in places])
    least = np.array([max(min(HALF * len(p), ENOUGH), 1) for p in places])
    xy = np.concatenate(places)
    parts = [_seen_by(d, xy, owner, least, RING_NEAR if ring else NEAR, margin, rivals)
             for d in drives]  # fmt: skip
    return [[part[k] for part in parts] for k in range(len(places))]


def _seen_by(
    drive: Detected,
    xy: Array,
    owner: Int,
    least: Array,
    near: float,
    margin: float,
    rivals: Any,
) -> list[Seen]:
    """What one drive saw of stretches: the places ``xy`` (n, 2) belong to their ``owner`` (n,), of
    which a frame must have had ``least`` in view."""
    t = drive.traversal
    m = len(t.pose)
    pairs = views(xy, t.pose, t.range_m, t.occluders, margin)
    key, size = owner[pairs.point] * m + pairs.frame, len(least) * m
    count = np.bincount(key, minlength=size).reshape(-1, m)
    hit, at = drive.found(xy[pairs.point], pairs.frame, near, rivals)
    hits = np.bincount(key, hit, size).reshape(-1, m)
    total = np.zeros(size)
    if hit.any():
        total += np.bincount(key[hit], drive.score[at[hit]], size)
    scores = total.reshape(-1, m) / np.maximum(hits, 1.0)
    out = []
    for k, enough in enumerate(least):
        looked = np.flatnonzero(count[k] >= enough)
        found = hits[k, looked] >= HALF * count[k, looked]
        worth = np.where(found, scores[k, looked], 0.0)
        mean = float(worth[found].mean()) if found.any() else None
        times = t.timestamp_ns[looked]
        out.append(Seen(t.run_id, times, found, worth, mean, int(t.timestamp_ns[0])))
    return out


def usual_rate(
    elements: Sequence[Element], class_name: str, drives: Sequence[Detected], margin: float
) -> float:
    """How often (by score) frames find an element of a class that is there: the upper half of what
    is measured on elements of the map, so that those which are gone do not count."""
    rates = []
    some = [e.xy for e in elements[:: max(1, len(elements) // SAMPLE)]]
    for seen in all_seen(some, class_name, drives, margin):
        looks = sum(len(s.times) for s in seen)
        if looks >= 4:
            rates.append(sum(float(s.scores.sum()) for s in seen) / looks)
    good = [r for r in rates if r > 2 * FALSE_RATE]
    return float(np.clip(np.median(good), 0.2, 0.95)) if good else 0.7


def aside_rate(
    elements: Sequence[Element],
    class_name: str,
    drives: Sequence[Detected],
    margin: float,
) -> float:
    """How often frames find a line where there is none but one beside it: the tails of its errors,
    measured ``ASIDE`` metres to both sides of lines of the map."""
    found, looks = 0.0, 0
    lines = [resample_step(e.xy, STEP) for e in elements[:: max(1, len(elements) // SAMPLE)]]
    beside = [p + side * normals(p) for p in lines for side in (ASIDE, -ASIDE)]
    for seen in all_seen(beside, class_name, drives, margin):
        found += sum(float(s.scores.sum()) for s in seen)
        looks += sum(len(s.times) for s in seen)
    return float(np.clip(found / max(looks, 1), FALSE_RATE, 0.3))


@dataclass(frozen=True)
class Rates:
    """How often frames find an element of a class that is there, one that is worn, and none;
    ``clutter``: share of places without a line at which something is taken for one as often as for
    a worn one, in every drive: posts, kerbs, seams."""

    usual: float
    false: float = FALSE_RATE
    clutter: float = 0.0

    @property
    def hard(self) -> float:
        """Of what is worn."""
        return max(HARD * self.usual, 2 * self.false)

    def vote(self, rate: float, found: float, looked: int) -> float:
        """Log-likelihood ratio of one drive's frames between a rate and nothing being there."""
        n = min(float(looked), FRAMES)
        k = found / max(looked, 1) * n
        return float(
            k * np.log(rate / self.false) + (n - k) * np.log((1 - rate) / (1 - self.false))
        )

    def log_odds(self, counts: Sequence[tuple[float, int]]) -> float:
        """Of all drives (found, looked) together that the element is there, before any prior."""
        good = hard = 0.0
        for k, n in counts:
            votes = np.array([self.vote(self.usual, k, n), self.vote(self.hard, k, n)])
            # Frames of a drive are alike: they say less, which of the rates is the better stays.
            votes *= min(1.0, SATURATED / max(float(votes.max()), 1e-9))
            good, hard = np.array([good, hard]) + np.maximum(votes, -SATURATED)
        there = np.logaddexp(np.log(1 - HARD_SHARE) + good, np.log(HARD_SHARE) + hard)
        if not self.clutter:
            return float(there)
        return float(there - np.logaddexp(np.log1p(-self.clutter), np.log(self.clutter) + hard))


def counts_of(seen: Sequence[Seen], rates: Rates) -> tuple[Counts, float]:
    """All drives, each with its own vote, oldest first; and what they say together."""
    looked = sorted((s for s in seen if len(s.times)), key=lambda s: (s.first_ns, s.run_id))
    pairs = [(float(s.scores.sum()), len(s.times)) for s in looked]
    drives = []
    for s, pair in zip(looked, pairs, strict=True):
        odds = rates.log_odds([pair])
        times = tuple(s.times[s.found].tolist())
        drives.append(
            DriveEvidence(
                s.run_id, s.first_ns, pair[1], len(times), times, s.score, odds, True, odds > 0
            )
        )
    times = tuple(t for d in drives for t in d.seen_ns)
    counts = Counts(
        sum(d.frames_seen for d in drives),
        sum(d.frames_in_view for d in drives),
        sum(d.seen for d in drives),
        len(drives),
        min(times) if times else None,
        max(times) if times else None,
        tuple(d.run_id for d in drives if d.seen),
        tuple(drives),
    )
    return counts, rates.log_odds(pairs)
