"""Exclusive assignment: in one frame a place of a line is seen once, by the likeliest detection.

Two detections of one frame side by side are two lines, even where both lie near the same one: the
likelier keeps it, the other goes to the next line or stays loose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.keys import numbered
from rtmap_cli.maps.stations import (
    GATE,
    MIN_STRETCH,
    Feet,
    Samples,
    Stations,
    assign,
    candidate_feet,
)

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

PLACE = 2.0
"""Length (m) of a line that one frame sees once; vertices of detections lie nearer than that."""
WIDE = 2.5
"""A detection so many sigmas from a line may belong to it, ..."""
FLOOR = 0.12
"""Standard deviation (m) of the map and of the pose, beside that of a detection."""


def sigma_scale(stations: Stations, samples: Samples) -> float:
    """By how much the stated sigmas of a drive are too small (> 1) or too large (< 1).

    Robust: the median of |offset| / sigma over what lies at a line of the map, against that of a
    unit Gaussian (0.674); 1 while little was measured.
    """
    feet, _ = assign(stations, samples)
    if len(feet) < 100:
        return 1.0
    sigma = np.sqrt(samples.across_sigma[feet.sample] ** 2 + FLOOR**2)
    return float(np.clip(np.median(np.abs(feet.offset) / sigma) / 0.674, 0.5, 2.0))


def offset_sigma(stations: Stations, samples: Samples) -> Array:
    """(n,) standard deviation (m) of the samples' offsets from the lines that they belong to."""
    scale = sigma_scale(stations, samples)
    return np.sqrt((scale * samples.across_sigma) ** 2 + FLOOR**2)


def assign_once(
    stations: Stations,
    samples: Samples,
    first: Mask | None = None,
    rounds: int = 4,
    wide: bool = True,
    own: Int | None = None,
) -> tuple[Feet, Mask]:
    """Assign stretches of detections to strands, and say which samples found one.

    A detection goes to the strand of largest gain Σ spacing · (1 − (offset / gate)²); of those of
    one frame at one place of a strand the one of largest mean gain stays. What is left goes to the
    next one, for ``rounds`` rounds. With ``first`` (stations,) the lines of these stations choose
    before all others. The gate is ``GATE``; ``wide``: ``WIDE`` sigmas of the usual detection where
    that is more. ``own`` (samples,): the line that the network says a sample is, -1: none; it goes
    there when that is in reach, and a doubtful detection does not drive out a sure one.
    """
    taken = np.zeros(len(samples), bool)
    parts: list[Feet] = []
    if len(stations) and len(samples):
        gate = GATE
        if wide:
            gate = float(np.clip(WIDE * np.median(samples.across_sigma), GATE, 2 * GATE))
        feet = _Feet(stations, samples, gate, own)
        stages = [None] if first is None else [first, ~first]
        for stage in stages:
            for _ in range(rounds):
                chosen = feet.round(taken, stage)
                if not len(chosen):
                    break
                parts.append(feet.pick(chosen))
                taken[feet.sample[chosen]] = True
    if not parts:
        nothing = np.zeros(0, np.int64)
        return Feet(nothing, nothing, np.zeros(0), np.zeros(0)), taken
    names = ("sample", "station", "offset", "along")
    return Feet(*(np.concatenate([getattr(p, n) for p in parts]) for n in names)), taken


class _Feet:
    """The best foot of each sample on each strand in reach, and which of them are still free."""

    def __init__(
        self,
        stations: Stations,
        samples: Samples,
        gate: float,
        own: Int | None = None,
    ) -> None:
        unit = stations.strand
        feet = Feet(*candidate_feet(stations, samples, gate, unit))
        total = np.bincount(samples.detection, samples.spacing)
        self.score = np.ones(len(total))
        if own is not None and (own >= 0).any():
            feet = _faithful(feet, stations, own)
            self.score[samples.detection] = samples.score
        self.sample, self.station = feet.sample, feet.station
        self.offset, self.along = feet.offset, feet.along
        self.weight = samples.spacing[self.sample]
        self.gain = 1.0 - (self.offset / gate) ** 2
        self.detection = samples.detection[self.sample]
        self.strands = int(unit.max()) + 1
        self.pair = self.detection * self.strands + unit[self.station]
        # One place of a line in one frame.
        place = np.floor(stations.s / PLACE).astype(np.int64)
        size = int(place.max()) + 1
        where = stations.line * size + place
        count = int(where.max()) + 1
        self.frame = samples.frame[self.sample]
        self.slot = self.frame * count + where[self.station]
        self.free = np.ones(len(self.sample), bool)
        self.least = np.minimum(MIN_STRETCH, 0.6 * total)

    def pick(self, index: Int) -> Feet:
        """Some of the feet."""
        return Feet(self.sample[index], self.station[index], self.offset[index], self.along[index])

    def round(self, taken: Mask, stage: Mask | None) -> Int:
        """The feet that are accepted now; places that they fill are closed to others."""
        open_ = self.free & ~taken[self.sample]
        if stage is not None:
            open_ &= stage[self.station]
        index = np.flatnonzero(open_)
        if not len(index):
            return index
        pairs, inverse = numbered(self.pair[index])
        weight = self.weight[index]
        gain = np.bincount(inverse, weight * self.gain[index])
        cover = np.bincount(inverse, weight)
        owner = pairs // self.strands
        enough = cover >= self.least[owner]
        order = np.lexsort((pairs, -np.where(enough, gain, -1.0), owner))
        best = np.zeros(len(pairs), bool)
        best[order] = np.concatenate([[True], owner[order][1:] != owner[order][:-1]])
        wanted = (best & enough)[inverse]
        mean = gain / np.maximum(cover, 1e-9) * self.score[owner]
        index, inverse = index[wanted], inverse[wanted]
        if not len(index):
            return index
        winners = np.ones(len(index), bool)
        rivals = self._contested(index, inverse)
        if len(rivals):
            winners[rivals] = self._winners(index[rivals], mean[inverse[rivals]])
        # What lost most of its way along a line is another line, with its ends, too.
        weight = self.weight[index]
        total = np.bincount(inverse, weight, len(pairs))
        won = np.bincount(inverse, weight * winners, len(pairs)) / np.maximum(total, 1e-30)
        winners &= won[inverse] >= 0.5
        self.free[index] = False
        kept = index[winners]
        self._close(kept, taken)
        return kept

    def _close(self, kept: Int, taken: Mask) -> None:
        """Places filled by ``kept`` are closed to other detections of their frames."""
        own = taken.copy()
        own[self.sample[kept]] = True
        rest = np.flatnonzero(self.free & ~own[self.sample])
        if not len(rest) or not len(kept):
            return
        slots, first = np.unique(self.slot[kept], return_index=True)
        slot = self.slot[rest]
        at = np.minimum(np.searchsorted(slots, slot), len(slots) - 1)
        filled = slots[at] == slot
        other = self.detection[rest] != self.detection[kept][first][at]
        self.free[rest[filled & other]] = False

    def _contested(self, index: Int, pair: Int) -> Int:
        """Which of the feet ``index`` belong to a ``pair`` (n,), numbered, that is not alone on its
        strand in its frame: most are, and nobody contests their places."""
        first = np.flatnonzero(np.diff(pair, prepend=-1))
        some, at = np.unique(pair[first], return_index=True)
        first = first[at]
        strand = self.pair[index[first]] % self.strands
        _, group = np.unique(self.frame[index[first]] * self.strands + strand, return_inverse=True)
        contested = np.zeros(int(some[-1]) + 1, bool)
        contested[some] = np.bincount(group)[group] > 1
        return np.flatnonzero(contested[pair])

    def _winners(self, index: Int, mean: Array) -> Mask:
        """Of the feet ``index``, those whose detection is the likeliest at their place."""
        slot, detection = self.slot[index], self.detection[index]
        order = np.lexsort((detection, -mean, slot))
        start = np.concatenate([[True], slot[order][1:] != slot[order][:-1]])
        group = np.cumsum(start) - 1
        best = detection[order][start][group]
        out = np.zeros(len(index), bool)
        out[order] = detection[order] == best
        return out


def _faithful(feet: Feet, stations: Stations, own: Int) -> Feet:
    """The feet without those on other chains than that of the sample's ``own`` line, where it has
    one there."""
    chain = np.full(int(stations.line.max()) + 2, -1)
    chain[stations.line] = stations.chain
    # The last entry stands for samples that are no line's own.
    mine = (own[feet.sample] >= 0) & (chain[own[feet.sample]] == stations.chain[feet.station])
    has = np.zeros(len(own), bool)
    has[feet.sample[mine]] = True
    keep = mine | ~has[feet.sample]
    return Feet(feet.sample[keep], feet.station[keep], feet.offset[keep], feet.along[keep])
