"""Counts of hits and views per place and drive, and what follows for existence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.traversal import Traversal
from rtmap_cli.maps.evidence import Counts
from rtmap_cli.maps.existence import VoteModel, drive_log_likelihoods, log_odds_of, usual_rate
from rtmap_cli.maps.stations import STEP, Feet, Samples, Stations
from rtmap_cli.maps.visibility import Views, views

Array = NDArray[np.float64]
Int = NDArray[np.int64]

END_FADE = 3.0
"""Detections are cut short: so near (m) to the end of a line a miss counts less."""
SEEN_SHARE = 0.3
"""A drive has seen a place when it found something in this share of the usual rate."""
NOISE_SCORE = 0.1
"""A detection of this score or less says nothing …"""
SURE_NO, SURE_YES = 0.15, 0.85
"""… nor does an existence up to the first; from the second on the network is sure."""
FAR_LOSS = 0.5
"""Share of the detection probability that is lost at 36 m."""


@dataclass(frozen=True)
class DriveCounts:
    """One drive at n places: fractional ``hits`` of weighted ``views``, frames that hit and that
    looked, and times of the first and last hit (ns; 0 where none)."""

    hits: Array
    views: Array
    frames_seen: Int
    frames_in_view: Int
    first_ns: Int
    last_ns: Int


def view_weight(distance: Array) -> Array:
    """Detection probability by distance, relative to a near place: negative evidence weighs so."""
    return 1.0 - FAR_LOSS * np.minimum(distance / 36.0, 1.0) ** 2


def detection_value(score: Array) -> Array:
    """How much of a hit a detection is."""
    return np.clip((score - NOISE_SCORE) / (1 - NOISE_SCORE), 0.0, 1.0)


def answer_value(existence: Array) -> Array:
    """How much of a hit the network's existence score of a prior element is."""
    return np.clip((existence - SURE_NO) / (SURE_YES - SURE_NO), 0.0, 1.0)


def count(
    n: int, traversal: Traversal, seen: Views, weight: Array, key: Int, value: Array
) -> DriveCounts:
    """Counts of ``n`` places from views with ``weight`` and hits ``key`` = frame · n + place.

    ``key`` may repeat: the best ``value`` of a frame counts. Hits outside every view (beyond the
    margin, or seen past an occluder) do not count: neither would a miss have.
    """
    view_key = seen.frame * n + seen.point
    order = np.lexsort((-value, key))
    key, value = key[order], value[order]
    first = np.ones(len(key), bool)
    first[1:] = key[1:] != key[:-1]
    key, value = key[first], value[first]
    at = np.searchsorted(view_key, key)
    at = np.minimum(at, max(len(view_key) - 1, 0))
    ok = view_key[at] == key if len(view_key) else np.zeros(len(key), bool)
    at, value = at[ok], value[ok]
    place, time = seen.point[at], traversal.timestamp_ns[seen.frame[at]]
    start = np.full(n, np.iinfo(np.int64).max)
    last = np.zeros(n, np.int64)
    np.minimum.at(start, place, time)
    np.maximum.at(last, place, time)
    return DriveCounts(
        np.bincount(place, value * weight[at], n).astype(np.float64),
        np.bincount(seen.point, weight, n).astype(np.float64),
        np.bincount(place, minlength=n),
        np.bincount(seen.point, minlength=n),
        np.where(last > 0, start, 0),
        last,
    )


def line_counts(
    stations: Stations,
    ids: Sequence[str],
    traversal: Traversal,
    samples: Samples,
    feet: Feet,
    margin: float,
) -> DriveCounts:
    """Counts of one drive at the stations of lines with element ``ids`` (one per line)."""
    n = len(stations)
    seen = views(stations.xy, traversal.pose, traversal.range_m, traversal.occluders, margin=margin)
    fade = np.clip(stations.to_end / END_FADE, 0.15, 1.0)
    weight = view_weight(seen.distance) * fade[seen.point]
    keys, values = [], []
    frame, value = samples.frame[feet.sample], detection_value(samples.score[feet.sample])
    wide = samples.spacing[feet.sample] > STEP
    for shift in (0, -1, 1):
        place = np.clip(feet.station + shift, 0, n - 1)
        ok = stations.line[place] == stations.line[feet.station]
        # Detections with vertices far apart cover the stations between them, too.
        ok &= wide | (shift == 0) | (np.sign(feet.along) == shift)
        keys.append((frame * n + place)[ok])
        values.append(value[ok])
    asked_key, asked_value = _asked_stations(stations, ids, traversal)
    keys.append(asked_key)
    values.append(asked_value)
    return count(n, traversal, seen, weight, np.concatenate(keys), np.concatenate(values))


def _asked_stations(
    stations: Stations, ids: Sequence[str], traversal: Traversal
) -> tuple[Int, Array]:
    """Frame · n + station and existence of what the network was asked about and confirmed."""
    n, asked = len(stations), traversal.asked
    row = {name: k for k, name in enumerate(ids)}
    keys, values = [np.zeros(0, np.int64)], [np.zeros(0)]
    sure = answer_value(asked.existence)
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
        values.append(np.full(len(index), sure[q]))
    return np.concatenate(keys), np.concatenate(values)


@dataclass(frozen=True)
class Ballot:
    """The drives' counts at n places, put together: ``votes`` (3, n), ``hits``, ``views`` summed,
    ``in_view`` and ``seen`` (drives, n) flags, and the model that judged them."""

    votes: Array
    hits: Array
    views: Array
    in_view: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    frames_seen: Int
    frames_in_view: Int
    first_ns: Int
    last_ns: Int
    runs: tuple[str, ...]
    model: VoteModel

    @property
    def evidence(self) -> Array:
        """(n,) log-likelihood ratio exists : absent."""
        return log_odds_of(self.votes, self.model)

    def counts(self, index: Int) -> Counts:
        """Counts of the stretch of places ``index``: its best seen place speaks for frames."""
        if not len(index):
            return Counts()
        share = self.seen[:, index].mean(axis=1) >= 0.3
        first = self.first_ns[index]
        first = first[first > 0]
        return Counts(
            frames_seen=int(self.frames_seen[index].max()),
            frames_in_view=int(self.frames_in_view[index].max()),
            traversals_seen=int(share.sum()),
            traversals_in_view=int((self.in_view[:, index].mean(axis=1) >= 0.3).sum()),
            first_seen_ns=int(first.min()) if len(first) else None,
            last_seen_ns=int(self.last_ns[index].max()) or None,
            runs=tuple(r for r, s in zip(self.runs, share, strict=True) if s),
        )


def _without(drive: DriveCounts, old: int) -> DriveCounts:
    """The counts of a drive with nothing at the first ``old`` places."""
    mask = np.arange(len(drive.hits)) >= old
    return DriveCounts(*(getattr(drive, name) * mask for name in drive.__dataclass_fields__))


def ballot(
    drives: Sequence[DriveCounts],
    runs: Sequence[str],
    model: VoteModel,
    fresh: NDArray[np.bool_] | None = None,
    old: int = 0,
) -> Ballot:
    """Put the drives together; the usual hit rate is measured on the places themselves.

    The first ``old`` places are those of the prior, the others were picked by what was found. At
    the former only ``fresh`` drives vote: what the others said is in the prior already.
    """
    if fresh is not None and not fresh.all():
        drives = [d if f else _without(d, old) for d, f in zip(drives, fresh, strict=True)]
    hits = np.stack([d.hits for d in drives])
    looked = np.stack([d.views for d in drives])
    found = usual_rate(hits.sum(axis=0), looked.sum(axis=0), model.found)
    model = model.with_found(found)
    votes = np.zeros((3, hits.shape[1]))
    picked = np.arange(hits.shape[1]) >= old
    seen = np.zeros(hits.shape, bool)
    for k in range(len(drives)):
        vote = drive_log_likelihoods(hits[k], looked[k], model, picked)
        votes += vote
        seen[k] = (looked[k] > 0) & (hits[k] >= SEEN_SHARE * model.found * looked[k])
    first = np.stack([np.where(d.first_ns > 0, d.first_ns, np.iinfo(np.int64).max) for d in drives])
    start = first.min(axis=0)
    return Ballot(
        votes,
        hits.sum(axis=0),
        looked.sum(axis=0),
        looked >= 1.0,
        seen,
        np.sum([d.frames_seen for d in drives], axis=0),
        np.sum([d.frames_in_view for d in drives], axis=0),
        np.where(start == np.iinfo(np.int64).max, 0, start),
        np.max([d.last_ns for d in drives], axis=0),
        tuple(runs),
        model,
    )
