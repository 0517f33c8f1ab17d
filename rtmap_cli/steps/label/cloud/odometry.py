"""LiDAR odometry: predict, take the turn's motion out, match with the local map, go on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry import lie
from rtmap_cli.geometry.poses import invert, se3_from_xyyaw, transform
from rtmap_cli.steps.label.cloud.degenerate import (
    SUSPECT,
    Spectrum,
    held,
    spectrum,
    turn_is_open,
    turn_share,
    without_weak,
)
from rtmap_cli.steps.label.cloud.match import best_start, make_matcher
from rtmap_cli.steps.label.cloud.matcher import Match, Matcher
from rtmap_cli.steps.label.cloud.place import starts
from rtmap_cli.steps.label.cloud.points import Sweep, deskewed, leaf_of

Array = NDArray[np.float64]

KEY_DISTANCE, KEY_TURN = 2.0, np.radians(12.0)
"""Motion after which a sweep becomes a keyframe (m, rad)."""
STILL = 0.05
"""A vehicle that moved less (m) since the last insertion adds nothing to the local map."""
WORSE = 1.6
"""A match this much costlier than usual is looked for from other starts."""
SAME, FORGIVEN = 0.3, 0.95
"""A search that ends so near (m) where it began found the surroundings changed, not the vehicle
lost: that cost is usual then, for some twenty sweeps (this share of it from sweep to sweep)."""
LOST_SHARE = 0.3
"""A match with fewer partners is none."""
SKEW_ROUNDS = 3
SKEW_DOUBT = 0.004
"""Change of the motion (m or rad) that makes taking it out again worthwhile."""
SEARCH_REACH, SEARCH_YAWS = 25.0, np.radians(np.arange(-60.0, 60.1, 4.0))
"""How far (m) and under which yaws an unexplained sweep is looked for."""

OK, DEGENERATE, LOST = "ok", "degenerate", "lost"


@dataclass(frozen=True)
class Step:
    """One sweep registered: ``pose`` (4, 4) ego → local frame, ``information`` (6, 6) of the match
    with the local map (zero along what it does not know), ``status``, the ``weak`` direction (3,)
    of the ego frame (None: all known), ``points`` (n, 3) with the turn's motion taken out,
    ``turn``: the vehicle's turn is not known."""

    pose: Array
    information: Array
    status: str
    weak: Array | None
    keyframe: bool
    points: Array
    share: float
    cost: float
    turn: bool = False


class Odometry:
    """Registers sweeps one after the other; the first one is the local frame."""

    def __init__(self, method: str, leaf: float | None = None) -> None:
        self.method, self._leaf = method, leaf
        self.matcher: Matcher | None = None
        self._pose = np.eye(4)
        self._key = np.eye(4)
        self._inserted: Array | None = None
        self._time = 0.0
        self._delta: Array | None = None
        self._step_s = 0.1
        self._costs: list[float] = []
        self._opening: Sweep | None = None
        self._tolerated = 0.0

    @property
    def matcher_leaf(self) -> float:
        """Side of the cells (m) that sweeps are thinned to."""
        return self.matcher.leaf if self.matcher else float(self._leaf or 0.5)

    def add(self, sweep: Sweep, time: float, motion: Array | None = None) -> Step:
        """Register a cleaned sweep of ``time`` (s).

        ``motion`` (3,): dx, dy, dyaw since the last sweep where odometry is known; otherwise the
        last motion is expected to go on.
        """
        if self.matcher is None:
            return self._first(sweep, time)
        elapsed = max(time - self._time, 1e-3)
        expected = self._expected(elapsed, motion)
        if not len(sweep):
            return self._lost(self._pose @ expected, time, elapsed)
        known = motion is not None or self._delta is not None
        guess = self._pose @ expected
        twist = lie.log(expected) / elapsed
        for attempt in range(SKEW_ROUNDS):
            xyz = deskewed(sweep, twist)
            prepared = self.matcher.prepare(xyz)
            match = self.matcher.match(prepared, guess)
            if attempt == 0 and self._doubtful(match, known):
                first, match = match, self._search(xyz, prepared, match)
                apart = np.linalg.norm(match.pose[:3, 3] - first.pose[:3, 3])
                if apart < SAME and match.share >= LOST_SHARE:
                    self._tolerated = match.cost
            before, twist = twist, lie.log(invert(self._pose) @ match.pose) / elapsed
            span = 0.0 if sweep.time is None else float(np.abs(sweep.time).max(initial=0.0))
            if np.abs(twist - before).max() * span < SKEW_DOUBT:
                break
            guess = match.pose
            if self._opening is not None:
                self._begin_again(twist)
        self._opening = None
        return self._take(match, self._pose @ expected, xyz, prepared, time, elapsed)

    def _first(self, sweep: Sweep, time: float) -> Step:
        leaf = self._leaf or leaf_of(sweep.xyz)
        self.matcher = make_matcher(self.method, leaf)
        self._insert(self.matcher.prepare(sweep.xyz))
        self._time = time
        self._opening = sweep if sweep.time is not None else None
        return Step(self._pose, np.zeros((6, 6)), OK, None, True, sweep.xyz, 1.0, 0.0)

    def _begin_again(self, twist: Array) -> None:
        """The local map anew from the first sweep, now that its motion (6,) is known."""
        assert self._opening is not None
        self.matcher = make_matcher(self.method, self.matcher_leaf)
        self._inserted = None
        self._insert(self.matcher.prepare(deskewed(self._opening, twist)))

    def _expected(self, elapsed: float, motion: Array | None) -> Array:
        """(4, 4) motion since the last sweep before this one is looked at."""
        last = np.eye(4) if self._delta is None else self._delta
        going_on = lie.exp(lie.log(last) * (elapsed / self._step_s))
        if motion is None:
            return np.asarray(going_on)
        planar = se3_from_xyyaw(*motion)
        planar[2, 3] = going_on[2, 3] if self._delta is not None else 0.0
        return planar

    def _doubtful(self, match: Match, known: bool) -> bool:
        if not known:
            return True
        usual = float(np.median(self._costs[-30:])) if self._costs else match.cost
        self._tolerated *= FORGIVEN
        limit = WORSE * max(usual, 0.5, self._tolerated)
        return match.share < LOST_SHARE or match.cost > limit

    def _search(self, xyz: Array, prepared: Any, first: Match) -> Match:
        """The best match from places that look alike from above, ``first`` among them."""
        assert self.matcher is not None
        here = transform(invert(self._pose), self.matcher.local_points())
        found = starts(here, xyz, SEARCH_REACH, SEARCH_YAWS)
        other = best_start(self.matcher, prepared, [self._pose @ pose for _, pose in found])
        return other if other.cost < first.cost else first

    def _lost(self, pose: Array, time: float, elapsed: float) -> Step:
        """A sweep without points: the expected motion."""
        self._delta, self._step_s = invert(self._pose) @ pose, elapsed
        self._pose, self._time = pose, time
        return Step(pose, np.zeros((6, 6)), LOST, None, False, np.zeros((0, 3)), 0.0, 0.0)

    def _take(
        self, match: Match, guess: Array, xyz: Array, prepared: Any, time: float, elapsed: float
    ) -> Step:
        """Judge a match and go on from it."""
        known = spectrum(match.information)
        turn = self._turn_open(match, known, xyz, prepared)
        status, weak, information = OK, None, match.information
        pose = match.pose
        if match.share < LOST_SHARE:
            status, pose, information = LOST, guess, np.zeros((6, 6))
        elif known.weak.any() or turn:
            status, weak = DEGENERATE, known.directions[:, 0] if known.weak.any() else None
            pose = held(match.pose, guess, known, turn)
            information = without_weak(information, known, turn)
        if status == OK:
            self._costs.append(match.cost)
            del self._costs[:-30]
        self._delta, self._step_s = invert(self._pose) @ pose, elapsed
        self._pose, self._time = pose, time
        since = lie.log(invert(self._key) @ pose)
        keyframe = bool(
            np.linalg.norm(since[3:]) > KEY_DISTANCE or np.linalg.norm(since[:3]) > KEY_TURN
        )
        if keyframe:
            self._key = pose
        if status != LOST:
            self._insert(prepared)
        return Step(pose, information, status, weak, keyframe, xyz, match.share, match.cost, turn)

    def _turn_open(self, match: Match, known: Spectrum, xyz: Array, prepared: Any) -> bool:
        """True when the surroundings do not tell the turn."""
        assert self.matcher is not None
        if match.share < LOST_SHARE or turn_share(match.information, known, xyz) > SUSPECT:
            return False
        matcher = self.matcher
        return turn_is_open(lambda start: matcher.match(prepared, start), match)

    def _insert(self, prepared: Any) -> None:
        assert self.matcher is not None
        moved = self._inserted is None or (
            np.linalg.norm(self._pose[:3, 3] - self._inserted[:3, 3]) > STILL
            or np.linalg.norm(lie.log(invert(self._inserted) @ self._pose)[:3]) > STILL / 10
        )
        if moved:
            self.matcher.insert(prepared, self._pose)
            self._inserted = self._pose
