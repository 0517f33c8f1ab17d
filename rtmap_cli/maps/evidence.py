"""Evidence: what many drives say about one element, prior or newly found.

The result of detect-changes and the input of crowdsource, so that both judge by the same votes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import Element
from rtmap_cli.maps.existence import PRIOR_LOG_ODDS, VoteModel, logit, probability
from rtmap_cli.maps.refit import FusionModel

Array = NDArray[np.float64]

DAY_NS = 86_400 * 10**9


class Driven(Protocol):
    """A drive, as far as its times go."""

    @property
    def timestamp_ns(self) -> NDArray[np.int64]:
        """(m,) times of its frames (ns)."""


@dataclass(frozen=True)
class DriveEvidence:
    """What one drive says about a place: ``frames_seen`` of ``frames_in_view`` frames found it, at
    ``seen_ns``; mean ``score`` of what they found (None: nothing); ``log_odds`` that it exists by
    this drive alone; ``time_ns`` of the drive's first frame. ``looked`` and ``seen``: its vote in
    k of n."""

    run_id: str
    time_ns: int
    frames_in_view: int
    frames_seen: int
    seen_ns: tuple[int, ...]
    score: float | None
    log_odds: float
    looked: bool
    seen: bool


@dataclass
class Counts:
    """How often something was found and could have been, over frames and traversals; ``drives``
    the same drive by drive, of those that had it in view or found it, oldest first."""

    frames_seen: int = 0
    frames_in_view: int = 0
    traversals_seen: int = 0
    traversals_in_view: int = 0
    first_seen_ns: int | None = None
    last_seen_ns: int | None = None
    runs: tuple[str, ...] = ()
    drives: tuple[DriveEvidence, ...] = ()

    def newest(self, n: int) -> tuple[int, int]:
        """Of the newest ``n`` drives that looked (0: of all), how many found it, and how many
        looked."""
        looked = [d for d in self.drives if d.looked or d.seen]
        looked = looked[-n:] if n else looked
        return sum(d.seen for d in looked), len(looked)


@dataclass
class Stretch:
    """A part of an element, from station ``start`` to ``stop`` (included; a stretch of a ring may
    run over its start: then stop < start), that exists or not.

    ``log_odds`` that it exists, with the element's own prior log-odds; ``likelihood_ratio`` what
    the runs alone say; ``geometry`` (n, 2 or 3) in the map frame.
    """

    exists: bool
    log_odds: float
    likelihood_ratio: float
    geometry: Array
    counts: Counts
    start: int = 0
    stop: int = 0


@dataclass
class Evidence:
    """One element and its stretches; elements found new have ``new`` set and no prior log-odds.

    ``hits`` and ``views`` (n,) per station, summed over the drives. Of prior
    lines also ``places``, unit ``normals`` (n, 2) of the stations and the fused ``offset`` of the
    detections to the left of the line with its sigma (m; NaN, inf where unseen).
    """

    element: Element
    stretches: list[Stretch]
    new: bool
    counts: Counts
    likelihood_ratio: float
    hits: Array
    views: Array
    places: Array = field(default_factory=lambda: np.zeros((0, 2)))
    normals: Array = field(default_factory=lambda: np.zeros((0, 2)))
    offset: Array = field(default_factory=lambda: np.zeros(0))
    offset_sigma: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def in_view(self) -> bool:
        """Whether any drive could see any of it."""
        return self.counts.traversals_in_view > 0


@dataclass(frozen=True)
class Policy:
    """When evidence becomes a change; the defaults suit 2 Hz runs of a car.

    ``delete_below``, ``insert_above``: probability of existence below which an element is gone,
    above which a new one is real; ``first_above`` the same where the map knows nothing yet: what
    is improbable is kept as such, and goes when further drives do not find it.
    k of n: ``delete_traversals`` of the newest ``delete_of`` drives that had an element in view
    must have missed it (all of them where there are fewer),
    ``insert_traversals`` of ``insert_of`` must have found a new one (n = 0: of all drives); where
    only one drive looked at a new element, one is enough only for a first map.
    ``vanish``: chance that an element has gone since the drives before: however sure a map is, it
    can learn; ``half_life_days``: the log-odds of an element halve in so many days after it was
    last seen, before new votes count (0: never). ``min_probability``,
    ``max_false_alarms_per_km``: changes that are told; ``prior_log_odds``, ``new_log_odds``:
    log-odds, before the votes, of an element that states none and of a found candidate;
    ``first_log_odds`` the latter where there is no map: roads have lines, new ones are rare.
    ``correlation_m``: one vote of a line stands for that many metres; ``switch``: cost in log-odds
    of ending or starting a stretch inside a line; ``shortest_m``: shorter stretches are not told;
    ``view_margin_m``: border of the range that does not count as looked at, because detections
    are cut short there.
    """

    delete_below: float = 0.2
    insert_above: float = 0.5
    first_above: float = 0.04
    delete_traversals: int = 2
    delete_of: int = 5
    insert_traversals: int = 2
    insert_of: int = 0
    vanish: float = 0.01
    half_life_days: float = 0.0
    min_probability: float | None = None
    max_false_alarms_per_km: float | None = None
    prior_log_odds: float = PRIOR_LOG_ODDS
    new_log_odds: float = -1.3
    first_log_odds: float = 1.0
    correlation_m: float = 8.0
    switch: float = 2.0
    shortest_m: float = 4.0
    view_margin_m: float = 3.0

    @property
    def least(self) -> float:
        """Probability from which on a change is told: one half, unless something else decides."""
        if self.min_probability is not None:
            return self.min_probability
        return 0.5 if self.max_false_alarms_per_km is None else 0.0

    def telling(self, min_probability: float | None, per_km: float | None) -> Policy:
        """The policy with what a command line says; None leaves it as it is.

        Of the two operating points of a policy, one on the command line replaces both.
        """
        if min_probability is None and per_km is None:
            return self
        return replace(self, min_probability=min_probability, max_false_alarms_per_km=per_km)


@dataclass(frozen=True)
class Settings:
    """Everything that shapes evidence and fusion; the defaults stand with their classes."""

    policy: Policy = field(default_factory=Policy)
    votes: VoteModel = field(default_factory=VoteModel)
    fusion: FusionModel = field(default_factory=FusionModel)


def newest_ns(traversals: Sequence[Driven]) -> int:
    """Time of the newest frame of some drives (ns)."""
    return max((int(t.timestamp_ns[-1]) for t in traversals if len(t.timestamp_ns)), default=0)


def prior_log_odds(element: Element, policy: Policy, now_ns: int) -> float:
    """Log-odds of an element before the votes of drives that end at ``now_ns``.

    Its own where it has a history, faded by the time since it was last seen, else the usual ones.
    """
    if element.traversals == 0 and element.existence == 0.0:
        return policy.prior_log_odds
    odds = float(element.existence)
    if policy.half_life_days > 0 and element.last_seen_ns is not None:
        age = max(now_ns - element.last_seen_ns, 0) / DAY_NS
        odds *= 0.5 ** (age / policy.half_life_days)
    # However often it was seen, it may have gone since.
    return float(logit(probability(odds) * (1 - policy.vanish)))
