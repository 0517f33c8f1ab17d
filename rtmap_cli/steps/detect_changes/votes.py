"""Counts of hits and views per place and drive, and what follows for existence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.evidence import Counts, DriveEvidence
from rtmap_cli.maps.existence import (
    VoteModel,
    drive_log_likelihoods,
    fitted,
    joint_log_likelihoods,
    log_odds_of,
    remembered,
)
from rtmap_cli.maps.outlook import Outlook
from rtmap_cli.maps.sight import Look, SightModel, measured_sight
from rtmap_cli.maps.stations import STEP, Feet, Samples, Stations
from rtmap_cli.maps.visibility import Views, views

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

TOGETHER = 3
"""Feet of a detection that are so many stations apart, or nearer, cover those between them."""
SEEN_SHARE = 0.3
"""A drive has seen a place when it found something in this share of the usual rate …"""
SEEN_PROMPTED = 0.6
"""… or in this one where its network was asked about the place, and easier to deceive."""
CONFIRMED = 0.35
"""A line found by this share of the frames that looked is there."""
NOISE_SCORE = 0.1
"""A detection of this score or less says nothing …"""
SURE_NO, SURE_YES = 0.15, 0.85
"""… nor does an existence up to the first; from the second on the network is sure."""
GLANCE = 6.0
"""A place with fewer views counts as not asked about: they are looks from the border of the range,
where answers are worse than usual."""


class Looks(Protocol):
    """Which frames could see places."""

    def frames(self, index: Int) -> Int:
        """Of the places ``index`` the frames that could see them, once for each place."""


@dataclass(frozen=True)
class PairLooks:
    """Every view: its ``place`` and its ``frame`` (k,)."""

    place: Int
    frame: Int

    def frames(self, index: Int) -> Int:
        """Of the places ``index`` the frames that could see them, once for each place."""
        mine = np.zeros(int(self.place.max(initial=-1)) + 1, bool)
        mine[index[index < len(mine)]] = True
        return self.frame[mine[self.place]]


@dataclass(frozen=True)
class CellLooks:
    """Views by cells: the ``cell`` (n,) of each place in the drive's ``outlook``, and the
    ``margin`` (m) of its range that does not count but for the places of the ``edge`` (n,)."""

    outlook: Outlook
    cell: Int
    margin: float
    edge: Mask

    def frames(self, index: Int) -> Int:
        """Of the places ``index`` the frames that could see them, once for each place."""
        edge = self.edge[index]
        parts = [
            self.outlook.frames(self.cell[index[some]], margin)
            for some, margin in ((~edge, self.margin), (edge, 0.0))
            if some.any()
        ]
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)


@dataclass(frozen=True)
class DriveCounts:
    """One drive at n places: fractional ``hits`` of weighted ``views``, the ``looks`` behind these;
    of every hit ``hit_place``, ``hit_frame``, ``hit_score``. ``prompted`` (n,): most of the views
    are of frames in which the network was asked about the place."""

    hits: Array
    views: Array
    prompted: Mask
    looks: Looks
    hit_place: Int
    hit_frame: Int
    hit_score: Array

    @cached_property
    def _by_place(self) -> tuple[Int, Int]:
        """The hits in order of their places, and where those of each place begin."""
        first = np.concatenate([[0], np.cumsum(np.bincount(self.hit_place, None, len(self.hits)))])
        return np.argsort(self.hit_place, kind="stable"), first

    def hits_at(self, index: Int) -> Int:
        """The hits at the places ``index``, in their order."""
        order, first = self._by_place
        count = first[index + 1] - first[index]
        at = np.repeat(first[index] - (np.cumsum(count) - count), count) + np.arange(count.sum())
        return np.sort(order[at])


def detection_value(score: Array) -> Array:
    """How much of a hit a detection is."""
    return np.clip((score - NOISE_SCORE) / (1 - NOISE_SCORE), 0.0, 1.0)


def answer_value(existence: Array) -> Array:
    """How much of a hit the network's existence score of a prior element is."""
    return np.clip((existence - SURE_NO) / (SURE_YES - SURE_NO), 0.0, 1.0)


def count(
    n: int, seen: Views, weight: Array, key: Int, value: Array, score: Array, asked: Int
) -> DriveCounts:
    """Counts of ``n`` places from views; hits ``key``, questions ``asked``: frame · n + place.

    ``weight``: the detection probability of each view, relative to a good one: so many hits are
    expected of a place that exists, times its usual rate.

    ``key`` may repeat: the best ``value`` of a frame counts. Hits outside every view (beyond the
    margin, or seen past an occluder) do not count: neither would a miss have.
    """
    view_key = seen.frame * n + seen.point
    key, value, score = _best_hits(key, value, score)
    ok = np.isin(key, view_key)
    views_ = np.bincount(seen.point, weight, n).astype(np.float64)
    looked = PairLooks(seen.point, seen.frame)
    prompted = _prompted(n, asked, view_key, views_)
    return _counted(n, looked, views_, prompted, key[ok], value[ok], score[ok])


def _prompted(n: int, asked: Int, viewed: Int, views_: Array) -> Mask:
    """(n,) places at which at least half of the views have a question, and that were not only
    glanced at; ``asked``, ``viewed``: frame · n + place of the questions and of what was seen."""
    if not len(asked):
        return np.zeros(n, bool)
    both = np.intersect1d(asked, viewed)
    return (views_ >= GLANCE) & (2 * np.bincount(both % n, minlength=n) >= views_)


def _best_hits(key: Int, value: Array, score: Array) -> tuple[Int, Array, Array]:
    """The keys once, in order, each with its best value and score."""
    if not len(key):
        return key, value, score
    order = np.argsort(key)
    key = key[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    best = [np.maximum.reduceat(v[order], first) for v in (value, score)]
    return key[first], best[0], best[1]


def _counted(
    n: int, looked: Looks, views_: Array, prompted: Mask, key: Int, value: Array, score: Array
) -> DriveCounts:
    # An answer that there is nothing is no hit.
    some = value > 0
    frame, place = np.divmod(key[some], n)
    hits = np.bincount(place, value[some], n).astype(np.float64)
    return DriveCounts(hits, views_, prompted, looked, place, frame, score[some])


def looks(stations: Stations, traversal: Traversal, margin: float) -> tuple[Views, Look]:
    """Views of the stations by one drive, and how good each of them is."""
    seen = views(stations.xy, traversal.pose, traversal.range_m, traversal.occluders, margin=margin)
    pose = traversal.pose[seen.frame]
    d = stations.xy[seen.point] - pose[:, :2]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    local = np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]], axis=-1)
    low, high = np.reshape(traversal.range_m, (2, 2))
    border = np.minimum(local - low, high - local).min(axis=1, initial=np.inf)
    return seen, Look(seen.distance, stations.to_end[seen.point], border)


def sight_of(
    stations: Stations,
    traversals: Sequence[Traversal],
    samples: Sequence[Samples],
    feet: Sequence[Feet],
    margin: float,
) -> SightModel:
    """How well the drives see lines, measured on those of the map that they confirm."""
    n, parts, found = len(stations), [], []
    if not n:
        return SightModel()
    for traversal, s, own in zip(traversals, samples, feet, strict=True):
        seen, look = looks(stations, traversal, margin)
        near = [np.clip(own.station + k, 0, n - 1) for k in (-1, 0, 1)]
        hit = np.isin(
            seen.frame * n + seen.point,
            np.concatenate([s.frame[own.sample] * n + place for place in near]),
        )
        number = np.maximum(np.bincount(seen.point, minlength=n), 1)
        sure = (np.bincount(seen.point, hit, n) / number > CONFIRMED)[seen.point]
        parts.append(np.stack([look.distance, look.to_end, look.to_border])[:, sure])
        found.append(hit[sure])
    return measured_sight(Look(*np.concatenate(parts, axis=1)), np.concatenate(found))


def only_at_the_border(
    stations: Stations, ids: Sequence[str], traversals: Sequence[Traversal], margin: float
) -> Mask:
    """(n,) stations of new lines (without id) that no drive had in view inside the ``margin``."""
    new = np.array([not name for name in ids], bool)
    seen = np.zeros(len(ids), bool)
    if new.any():
        for traversal in traversals:
            outlook = traversal.outlook
            seen[stations.line[outlook.counted(margin)[outlook.cells(stations.xy)] > 0]] = True
    out: Mask = (new & ~seen)[stations.line]
    return out


def line_counts(
    stations: Stations,
    ids: Sequence[str],
    traversal: Traversal,
    samples: Samples,
    feet: Feet,
    margin: float,
    sight: SightModel,
    edge: Mask,
) -> DriveCounts:
    """Counts of one drive at the stations of lines with element ``ids`` (one per line); at those of
    the ``edge`` (n,) all of the range counts as looked at: else nothing could refute them."""
    n, outlook = len(stations), traversal.outlook
    cell = outlook.cells(stations.xy)
    views_ = outlook.counted(margin, sight)[cell]
    if edge.any():
        views_[edge] = outlook.counted(0.0, sight)[cell[edge]]
    views_ *= sight.curve("to_end", stations.to_end)
    key, score = _covered(stations, samples, feet)
    asked_key, existence = _asked_stations(stations, ids, traversal)
    value = np.concatenate([detection_value(score), answer_value(existence)])
    key, value, score = _best_hits(
        np.concatenate([key, asked_key]), value, np.concatenate([score, existence])
    )
    at, place = np.divmod(key, n)
    ok = outlook.sees_in_turn(at, cell[place], margin)
    looked = CellLooks(outlook, cell, margin, edge)
    if edge.any():
        ok |= edge[place] & outlook.sees_in_turn(at, cell[place], 0.0)
    prompted = _prompted(n, asked_key, key[ok], views_)
    return _counted(n, looked, views_, prompted, key[ok], value[ok], score[ok])


def _covered(stations: Stations, samples: Samples, feet: Feet) -> tuple[Int, Array]:
    """Frame · n + station of all stations that detections cover, and the scores of these.

    What a detection covers of a line is a stretch from its first to its last foot. Detections
    with vertices far apart cover the stations beside these, too.
    """
    n = len(stations)
    if not len(feet):
        return np.zeros(0, np.int64), np.zeros(0)
    station, line = feet.station, stations.line[feet.station]
    detection = samples.detection[feet.sample]
    change = np.ones(len(feet), bool)
    change[1:] = (detection[1:] != detection[:-1]) | (line[1:] != line[:-1])
    change[1:] |= np.abs(np.diff(station)) > TOGETHER
    start = np.flatnonzero(change)
    wide = samples.spacing[feet.sample] > STEP
    low = np.minimum.reduceat(station - (wide | (feet.along < 0)), start)
    high = np.maximum.reduceat(station + (wide | (feet.along > 0)), start)
    bounds = np.searchsorted(stations.line, [line[start], line[start] + 1])
    low, high = np.maximum(low, bounds[0]), np.minimum(high, bounds[1] - 1)
    count = high - low + 1
    first = feet.sample[start]
    key = np.repeat(samples.frame[first] * n + low - (np.cumsum(count) - count), count)
    return key + np.arange(len(key)), np.repeat(samples.score[first], count)


def _asked_stations(
    stations: Stations, ids: Sequence[str], traversal: Traversal
) -> tuple[Int, Array]:
    """Frame · n + station and existence of what the network was asked about and confirmed."""
    n, asked = len(stations), traversal.asked
    row = {name: k for k, name in enumerate(ids)}
    keys, values = [np.zeros(0, np.int64)], [np.zeros(0)]
    for q, name in enumerate(asked.element_id):
        k = row.get(name)
        if k is None:
            continue
        index = stations.of_line(k)
        low, high = asked.points[q].min(axis=0) - STEP, asked.points[q].max(axis=0) + STEP
        xy = stations.xy[index]
        # Cheap and sufficient: the stretch asked about is the part of the line in its own box.
        index = index[((xy >= low) & (xy <= high)).all(axis=1)]
        keys.append(asked.frame[q] * n + index)
        values.append(np.full(len(index), asked.existence[q]))
    return np.concatenate(keys), np.concatenate(values)


@dataclass(frozen=True)
class Ballot:
    """The drives' counts at n places, put together: ``votes`` (drives, 3, n) log-likelihoods,
    ``joint`` (3, n) those of all drives, ``in_view`` and ``seen`` (drives, n) flags, and the model
    that judged them; ``memory`` (3, n) the part of ``joint`` that is of drives before these;
    ``extra`` (n,) log-likelihood that other places lose when these do not exist."""

    votes: Array
    joint: Array
    in_view: Mask
    seen: Mask
    drives: Sequence[DriveCounts]
    times: Sequence[Int]
    runs: tuple[str, ...]
    model: VoteModel
    memory: Array
    extra: Array

    @property
    def hits(self) -> Array:
        """(n,) summed over the drives."""
        out: Array = np.sum([d.hits for d in self.drives], axis=0)
        return out

    @property
    def views(self) -> Array:
        """(n,) summed over the drives."""
        out: Array = np.sum([d.views for d in self.drives], axis=0)
        return out

    @property
    def evidence(self) -> Array:
        """(n,) log-likelihood ratio exists : absent."""
        return log_odds_of(self.joint, self.model) + self.extra

    def counts(self, index: Int) -> Counts:
        """Counts of the stretch of places ``index``: frames that found or could see any of it."""
        parts = [self._drive(k, index) for k in range(len(self.drives))] if len(index) else []
        drives = sorted((p for p in parts if p is not None), key=lambda d: (d.time_ns, d.run_id))
        times = [t for d in drives for t in d.seen_ns]
        return Counts(
            frames_seen=sum(d.frames_seen for d in drives),
            frames_in_view=sum(d.frames_in_view for d in drives),
            traversals_seen=sum(d.seen for d in drives),
            traversals_in_view=sum(d.looked for d in drives),
            first_seen_ns=min(times, default=None),
            last_seen_ns=max(times, default=None),
            runs=tuple(sorted(d.run_id for d in drives if d.seen)),
            drives=tuple(drives),
        )

    def _drive(self, k: int, index: Int) -> DriveEvidence | None:
        """What one drive says about the places ``index``; a frame speaks for them when it found
        or could see half of what any frame of the drive did."""
        drive, time = self.drives[k], self.times[k]
        if not drive.views[index].any():
            return None
        found = drive.hits_at(index)
        view_frames = _mostly(drive.looks.frames(index), len(time))
        hit_frames = np.flatnonzero(_mostly(drive.hit_frame[found], len(time)) & view_frames)
        score = drive.hit_score[found]
        odds = log_odds_of(self.votes[k][:, index], self.model)
        return DriveEvidence(
            self.runs[k],
            int(time[0]),
            int(view_frames.sum()),
            len(hit_frames),
            tuple(int(t) for t in time[hit_frames]),
            float(score.mean()) if len(score) else None,
            float(odds.mean()),
            bool(self.in_view[k, index].mean() >= 0.3),
            bool(self.seen[k, index].mean() >= 0.3),
        )


def _mostly(frames: Int, count: int) -> Mask:
    """(count,) the frames that occur at least half as often as the commonest one."""
    number = np.bincount(frames, minlength=count)
    return (number > 0) & (2 * number >= number.max())


@dataclass(frozen=True)
class _LaterLooks:
    """Views of the places from ``first`` on."""

    looks: Looks
    first: int

    def frames(self, index: Int) -> Int:
        """Of the places ``index`` the frames that could see them, once for each place."""
        return self.looks.frames(index[index >= self.first])


def _without(drive: DriveCounts, old: int) -> DriveCounts:
    """The counts of a drive with nothing at the first ``old`` places."""
    mask, hit = np.arange(len(drive.hits)) >= old, drive.hit_place >= old
    return DriveCounts(
        drive.hits * mask,
        drive.views * mask,
        drive.prompted,
        _LaterLooks(drive.looks, old),
        drive.hit_place[hit],
        drive.hit_frame[hit],
        drive.hit_score[hit],
    )


def ballot(
    drives: Sequence[DriveCounts],
    traversals: Sequence[Traversal],
    model: VoteModel,
    fresh: Mask | None = None,
    old: int = 0,
    every: int = 1,
    history: Array | None = None,
) -> Ballot:
    """Put the drives together; the rates are measured on every ``every``-th place of the prior.

    The first ``old`` places are those of the prior, the others were picked by what was found. At
    the former only ``fresh`` drives vote: what the others said is in the prior already. Of it
    ``history`` (3, old) tells how easily they saw the place: frames that found it, frames that had
    it in view, drives.
    """
    if fresh is not None and not fresh.all():
        drives = [d if f else _without(d, old) for d, f in zip(drives, fresh, strict=True)]
    hits = np.stack([d.hits for d in drives])
    looked = np.stack([d.views for d in drives])
    prompted = np.stack([d.prompted for d in drives])
    some = np.s_[:, :old:every]
    model = _fitted_both(hits[some], looked[some], prompted[some], model)
    picked = np.arange(hits.shape[1]) >= old
    votes = [
        drive_log_likelihoods(h, v, model, picked, p)
        for h, v, p in zip(hits, looked, prompted, strict=True)
    ]
    enough = np.where(prompted, SEEN_PROMPTED * model.prompted.found, SEEN_SHARE * model.found)
    memory = np.zeros((3, hits.shape[1]))
    if history is not None:
        memory[:, :old] = remembered(history[0], history[1], history[2], model)
    return Ballot(
        np.stack(votes),
        joint_log_likelihoods(hits, looked, model, picked, prompted) + memory,
        looked >= 1.0,
        (looked > 0) & (hits >= enough * looked),
        drives,
        [t.timestamp_ns for t in traversals],
        tuple(t.run_id for t in traversals),
        model,
        memory,
        np.zeros(hits.shape[1]),
    )


def _fitted_both(hits: Array, looked: Array, prompted: Mask, model: VoteModel) -> VoteModel:
    """The model fitted to the map's places, those that the network was asked about on their own.

    The few places of the map that a drive with questions was not asked about are no fair sample.
    """
    plain = np.logical_not(prompted.any(axis=1, keepdims=True))
    own = fitted(hits * plain, looked * plain, model)
    if not prompted.any():
        return own
    asked = fitted(hits * prompted, looked * prompted, model.of_prompted)
    rates = replace(model.prompted, found=asked.found, strength=asked.strength)
    return replace(own, hard=own.hard if plain.any() else asked.hard, prompted=rates)
