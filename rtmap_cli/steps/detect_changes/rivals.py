"""Two lines side by side or one that is seen a little off: what does each explain alone?

Detections of a line scatter by as much as lines lie apart. A candidate beside a line of the map
collects some of that line's detections, and so does a line of the map that is gone: each on its own
looks like a line that is hard to see. Both hypotheses are therefore played out: with the weaker
line, detections go to the likelier of the two; without it the stronger one takes what it can (one
detection per frame and place), and the rest is false detections. The log-likelihood of *all* votes
with and without the line is the evidence for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.rings import polygons
from rtmap_cli.maps.existence import (
    LIMIT,
    PRIOR_LOG_ODDS,
    VoteModel,
    joint_log_likelihoods,
    log_odds_of,
    logit,
    probability,
)
from rtmap_cli.maps.stations import GATE, MIN_COS, Feet, Stations
from rtmap_cli.steps.detect_changes.crossings import Rings
from rtmap_cli.steps.detect_changes.votes import Ballot, DriveCounts

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

BESIDE = 2 * GATE
"""Lines nearer to each other than this (m) compete for detections."""
RING_BESIDE = 8.0
"""Centres of crossings nearer than this (m) compete for detections."""
OVERLAP = 0.2
"""Crossings that have this share of the smaller one in common cannot both exist."""
MOST = 2.0
"""Log-odds that the offset of a whole drive is worth at most: errors have heavy tails."""
OWN, CUT = 0.5, 1.3
"""Share of the variance of an offset that is not common to a drive; ½ z² between the halves of a
Gaussian that is cut in two (means at ± 0.8 σ)."""
SHARED = 0.2
"""Correlation of the offsets that two drives have at a place."""
SURE = 3.0
"""Log-odds from which on a line of the map is not in question."""


def neighbours(stations: Stations) -> Int:
    """(k, 2) stations of different strands that lie beside each other and run alike."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(stations.xy).query_pairs(BESIDE, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    alike = np.abs((stations.tangent[a] * stations.tangent[b]).sum(axis=1)) > MIN_COS
    apart = stations.strand[a] != stations.strand[b]
    out: Int = pairs[alike & apart].astype(np.int64)
    return out


@dataclass(frozen=True)
class Play:
    """One way to share out the detections: per drive the counts and the feet behind them."""

    counts: Sequence[DriveCounts]
    feet: Sequence[Feet]

    def select(self, rows: Int) -> Play:
        """Some of the drives."""
        return Play([self.counts[k] for k in rows], [self.feet[k] for k in rows])


def questioned(votes: Ballot, pairs: Int, old: int) -> Mask:
    """(n,) stations of the map in question: of two lines that compete the one with less evidence,
    unless that is much."""
    out = np.zeros(len(votes.extra), bool)
    evidence = votes.evidence
    both = pairs[(pairs < old).all(axis=1)]
    a, b = both[:, 0], both[:, 1]
    weaker = np.where(evidence[a] < evidence[b], a, b)
    out[weaker[evidence[weaker] + PRIOR_LOG_ODDS < SURE]] = True
    return out


def weighed(
    votes: Ballot,
    full: Play,
    without: Play,
    sigma: Sequence[Array],
    asked: Mask,
    pairs: Int,
    stations: Stations,
    picked: Mask,
    new_log_odds: float,
) -> Ballot:
    """The votes with the ``extra`` evidence of the ``asked`` stations added.

    In ``full`` every line takes part, in ``without`` those in question chose last; both hold the
    drives that vote on them. ``sigma``: of every drive's samples; ``new_log_odds``: of a candidate
    (``picked``) before the votes.
    """
    extra = votes.extra.copy()
    with_, alone = (_total(p.counts, votes, picked) for p in (full, without))
    extra[asked] += (with_[2] - alone[2])[asked]
    # No line explains less because it may take more: it could leave the rest alone.
    lost = np.minimum(_marginal(with_, votes.model) - _marginal(alone, votes.model), 0.0)
    giver, taker = _owners(asked, pairs, stations)
    scale = stations.spacing[giver] / np.maximum(stations.spacing[taker], 0.25)
    np.add.at(extra, taker, lost[giver] * scale)
    strain = np.zeros((len(sigma), len(extra)))
    for k, own in enumerate(sigma):
        moved = np.clip(full.counts[k].hits - without.counts[k].hits, 0.0, 1.0)
        strain[k] = moved * _strained(full.feet[k], without.feet[k], own, stations)
    # What all drives share at a place is no independent sign.
    number = np.maximum((strain != 0).sum(axis=0), 1)
    extra[asked] += (strain.sum(axis=0) / (1 + SHARED * (number - 1)))[asked]
    out = replace(votes, extra=extra)
    if picked[asked].any():
        extra = extra.copy()
        extra[giver] += _either(out, with_, alone, giver, taker, new_log_odds)
        out = replace(out, extra=extra)
    return out


def _either(
    votes: Ballot, with_: Array, alone: Array, giver: Int, taker: Int, new_log_odds: float
) -> Array:
    """What stations of the map gain because a new line that takes their detections may not exist:
    the probability of either case weighs the answer in it."""
    new = probability(votes.evidence[taker] + new_log_odds)
    cases = [log_odds_of(v[:, giver], votes.model) for v in (with_, alone)]
    p = [probability(c + PRIOR_LOG_ODDS) for c in cases]
    mixed = logit(new * p[0] + (1 - new) * p[1]) - PRIOR_LOG_ODDS
    return np.asarray(mixed - cases[0])


def _strained(full: Feet, without: Feet, sigma: Array, stations: Stations) -> Array:
    """(n,) log-likelihood that the detections of one drive lose when they go elsewhere, at the
    station where they would be, at most ``MOST``.

    The offset of a detection is mostly what its whole drive shares. Where the other line has
    detections of its own in this drive, theirs is the offset of the drive, and what is left for
    the moved ones is the ``OWN`` share of the variance, less what cutting one line in two would
    give; else it is all of it. Their mean is one vote: ½ z².
    """
    n = len(stations)
    home = np.full(len(sigma), -1)
    home[without.sample] = np.arange(len(without))
    at = home[full.sample]
    moved = (at >= 0) & (without.station[np.maximum(at, 0)] != full.station)
    at, where = at[moved], full.station[moved]
    there = without.station[at]
    mean, some = _around(full, stations)
    variance = sigma[full.sample[moved]] ** 2
    alone = (without.offset[at] ** 2 - full.offset[moved] ** 2) / variance / 2
    apart = (without.offset[at] - mean[there]) ** 2 / (OWN * variance) / 2 - CUT
    loss = np.where(some[there], np.maximum(apart, alone), alone)
    number = np.maximum(np.bincount(where, minlength=n), 1)
    return np.clip(np.bincount(where, loss, n) / number, -MOST, MOST)


def _around(feet: Feet, stations: Stations, reach: int = 4) -> tuple[Array, Mask]:
    """(n,) mean offset of the feet within so many stations of a line, and whether there are any."""
    n = len(stations)
    sums = np.stack([np.bincount(feet.station, feet.offset, n), np.bincount(feet.station, None, n)])
    total = sums.copy()
    for k in range(1, reach + 1):
        same = stations.line[k:] == stations.line[:-k]
        total[:, k:] += sums[:, :-k] * same
        total[:, :-k] += sums[:, k:] * same
    return total[0] / np.maximum(total[1], 1), total[1] >= reach


def _total(drives: Sequence[DriveCounts], votes: Ballot, picked: Mask) -> Array:
    """(3, n) log-likelihoods over some drives, and of what is known from before."""
    names = ("hits", "views", "prompted")
    hits, views, prompted = (np.stack([getattr(d, name) for d in drives]) for name in names)
    return joint_log_likelihoods(hits, views, votes.model, picked, prompted) + votes.memory


def _marginal(votes: Array, model: VoteModel) -> Array:
    """(n,) log-likelihood of votes at a place of the map that exists with the usual odds."""
    easy, hard, absent = votes
    exists = np.logaddexp(np.log1p(-model.hard) + easy, np.log(model.hard) + hard)
    p = 1 / (1 + np.exp(-PRIOR_LOG_ODDS))
    return np.asarray(np.logaddexp(np.log(p) + exists, np.log1p(-p) + absent))


def _owners(asked: Mask, pairs: Int, stations: Stations) -> tuple[Int, Int]:
    """Stations that are not asked, and the nearest asked one beside each of them."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[~asked[both[:, 0]] & asked[both[:, 1]]]
    distance = np.hypot(*(stations.xy[both[:, 0]] - stations.xy[both[:, 1]]).T)
    order = np.lexsort((both[:, 1], distance, both[:, 0]))
    both = both[order]
    first = np.ones(len(both), bool)
    first[1:] = both[1:, 0] != both[:-1, 0]
    giver, taker = both[first].T
    return giver, taker


def weighed_rings(
    votes: Ballot,
    full: tuple[Sequence[DriveCounts], Sequence[Int]],
    without: tuple[Sequence[DriveCounts], Sequence[Int]],
    drives: Sequence[Rings],
    places: Array,
    old: int,
) -> Ballot:
    """The votes on closed elements ``places`` (n, 80, 2) with the ``extra`` evidence of the new
    ones, from ``old`` on; counts and owners as ``ring_counts`` gives them, in ``without`` those of
    the map chose first."""
    picked = np.arange(len(places)) >= old
    extra = votes.extra.copy()
    with_, alone = (_total(p[0], votes, picked) for p in (full, without))
    extra[picked] += (with_[2] - alone[2])[picked]
    lost = np.minimum(_marginal(with_, votes.model) - _marginal(alone, votes.model), 0.0)
    centre = places.mean(axis=1)
    apart = np.hypot(*np.moveaxis(centre[:old, None] - centre[None, old:], -1, 0))
    nearest = apart.argmin(axis=1)
    np.add.at(extra, old + nearest, np.where(apart.min(axis=1) < RING_BESIDE, lost[:old], 0.0))
    for one, other, rings in zip(full[1], without[1], drives, strict=True):
        moved = (one >= old) & (other >= 0) & (other != one)
        here, there = centre[one[moved]], centre[other[moved]]
        where = rings.points[moved].mean(axis=1)
        far = ((where - there) ** 2).sum(axis=1) - ((where - here) ** 2).sum(axis=1)
        number = np.bincount(one[moved], minlength=len(places))
        strain = np.bincount(one[moved], far / rings.variance[moved] / 2, len(places))
        share = number / np.maximum(np.bincount(one[one >= 0], minlength=len(places)), 1)
        extra += share * np.clip(strain / np.maximum(number, 1), -MOST, MOST)
    return replace(votes, extra=extra)


def apart_from_known(votes: Ballot, places: Array, before: Array) -> Ballot:
    """The votes on closed elements ``places`` (n, 80, 2), of which the first lie on the map with
    log-odds ``before`` (k,): a new one that overlaps one of them exists only where that does not,
    and is what was seen of it where no drive had enough of that in view to judge it.

    Of old alone, new alone and neither with log-odds a, b and 0 the new one has b − log(1 + eᵃ).
    """
    import shapely

    k = len(before)
    known = np.where(votes.views[:k] > 0, before + votes.evidence[:k], LIMIT)
    shapes = polygons(places)
    new, old = shapely.STRtree(shapes[:k]).query(shapes[k:])
    common = shapely.area(shapely.intersection(shapes[k + new], shapes[old]))
    area = shapely.area(shapes)
    over = common > OVERLAP * np.minimum(area[k + new], area[old])
    strongest = np.full(len(places) - k, -np.inf)
    np.maximum.at(strongest, new[over], known[old[over]])
    extra = votes.extra.copy()
    extra[k:] -= np.logaddexp(0.0, strongest)
    return replace(votes, extra=extra)
