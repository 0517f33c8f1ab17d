"""Evidence: what many drives say about one element, prior or newly found.

The result of detect-changes and the input of crowdsource, so that both judge by the same votes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.maps.element import Element
from rtmap_cli.maps.existence import VoteModel
from rtmap_cli.maps.refit import FusionModel

Array = NDArray[np.float64]


@dataclass
class Counts:
    """How often something was found and could have been, over frames and traversals."""

    frames_seen: int = 0
    frames_in_view: int = 0
    traversals_seen: int = 0
    traversals_in_view: int = 0
    first_seen_ns: int | None = None
    last_seen_ns: int | None = None
    runs: tuple[str, ...] = ()


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
    above which a new one is real; ``first_above`` the same where there is no map yet: what is
    improbable is kept as such, and goes when further drives do not find it; ``first_log_odds``: in
    a class without any, log-odds with which stretches of lines are kept. ``delete_traversals``,
    ``insert_traversals``: drives that must have looked at (seen) it; where only one drive looked at
    a new element, one is enough only for a first map. ``new_log_odds``: log-odds that a found
    candidate is real before the votes. ``correlation_m``: one vote of a line stands for that many
    metres; ``switch``: cost in log-odds of ending or starting a stretch inside a line;
    ``shortest_m``: shorter stretches are not told; ``view_margin_m``: border of the range that does
    not count as looked at, because detections are cut short there.
    """

    delete_below: float = 0.2
    insert_above: float = 0.5
    first_above: float = 0.04
    first_log_odds: float = 1.0
    delete_traversals: int = 2
    insert_traversals: int = 2
    new_log_odds: float = -1.0
    correlation_m: float = 8.0
    switch: float = 2.0
    shortest_m: float = 4.0
    view_margin_m: float = 3.0


@dataclass(frozen=True)
class Settings:
    """Everything that shapes evidence and fusion; the defaults stand with their classes."""

    policy: Policy = field(default_factory=Policy)
    votes: VoteModel = field(default_factory=VoteModel)
    fusion: FusionModel = field(default_factory=FusionModel)
