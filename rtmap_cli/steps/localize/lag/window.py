"""The last stretch of a drive as unknowns, and a prior from what was driven before it.

The whole-log problem (``solve_smooth``) is block-tridiagonal in chunks of travel: eliminating its
first chunk leaves a Gaussian on the second one and nothing else. A window that moves on thus loses
nothing of the linearized past, but cannot linearize it anew: poses, bias of GNSS and the field of
place errors leave it together, by the Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.drive.blocks import BlockSystem
from rtmap_cli.steps.localize.drive.motion import STATE, Motion, motion_terms
from rtmap_cli.steps.localize.drive.smooth import chunks, first_poses
from rtmap_cli.steps.localize.frame.single import Solution
from rtmap_cli.steps.localize.lag.quadratic import Bumps, FrameTerms, Group, frame_terms, picked
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import judge, linearize, noise_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_MOVED = np.array([0.05, 0.05, 0.002])
"""A frame whose pose moved further (m, m, rad) looks for its lines anew."""

_STORY = 24
"""The last frames that may tell another story; ``_APART_FRAMES`` at its end say where it ends."""
_APART_FRAMES = 4
_APART_M, _APART_RAD = 0.8, 0.05
_CONVINCED = 5.0
"""Nats by which the other story must be likelier."""


@dataclass(frozen=True)
class _Prior:
    """What the past says about ``bumps`` (m,) and the states of ``frames`` (k,): informations
    ``solved``, ``stated`` and the gradient of the former at ``at`` (2 m + 6 k,)."""

    bumps: Index
    frames: Index
    solved: Array
    stated: Array
    gradient: Array
    at: Array


class _Layout:
    """Where the unknowns of frames ``first`` to ``last`` stand: ``bumps`` (m,) that take part,
    ``bump`` (all bumps,) and ``frame`` (k,) first unknown of each, ``sizes`` of the chunks."""

    def __init__(self, bumps: Index, born: Index, chunk: Index) -> None:
        self.bumps, self.sizes = bumps, list[int]()
        self.bump, self.frame = np.full(len(born), -1), np.empty(len(chunk), np.int64)
        first = 0
        for c in range(int(chunk[0]), int(chunk[-1]) + 1):
            own, frames = bumps[born[bumps] == c], np.flatnonzero(chunk == c)
            self.bump[own] = first + 2 * np.arange(len(own))
            self.frame[frames] = first + 2 * len(own) + STATE * np.arange(len(frames))
            self.sizes.append(2 * len(own) + STATE * len(frames))
            first += self.sizes[-1]

    def of_bumps(self, bumps: Index) -> Index:
        """(2 m,) unknowns of m bumps."""
        return np.asarray(self.bump[bumps][:, None] + (0, 1), np.int64).ravel()

    def of(self, bumps: Index, frames: Index) -> Index:
        """(2 m + 6 k,) unknowns of m bumps and k frames (0 is the first one)."""
        states = self.frame[frames][:, None] + np.arange(STATE)
        return np.concatenate([self.of_bumps(bumps), states.ravel()])


class Window:
    """Frames ``first`` to ``last`` of a drive with all that is known about them.

    ``pose``, ``bias`` (T, 3) hold the current estimates. ``model`` and ``motion`` may be replaced
    between frames; what was linearized before keeps its weights.
    """

    def __init__(
        self,
        lines: MapLines,
        seen: Detections,
        motion: Motion,
        model: ErrorModel,
        settings: Settings,
    ) -> None:
        self.lines, self.seen, self.settings = lines, seen, settings
        self.motion, self.model = motion, model
        self.chunk = chunks(motion.step, settings.chunk_m)
        self.pose, self.bias = np.full((len(seen), 3), np.nan), np.zeros((len(seen), 3))
        self.first, self.last = 0, -1
        self.frames: dict[int, FrameTerms] = {}
        self.bumps = Bumps()
        self.prior: _Prior | None = None

    # ---- frames come

    def begin(self, last: int, single: Solution, first: Array | None = None) -> None:
        """Frames 0 to ``last`` at once, from the answers of each frame alone; ``first`` as in
        ``solve_smooth``."""
        self._arrive(last)
        now = slice(0, last + 1)
        self.pose[now], self.bias[now] = first_poses(self._motion(now), single, first)
        for _ in self.settings.smooth_gates_m:
            self.round()

    def follow(self, rounds: int) -> None:
        """The next frame starts where odometry (else GNSS) says; its neighbours stand already, so
        that it begins with the second half of the rounds."""
        n = self.last + 1
        self._arrive(n)
        motion, before = self.motion, self.pose[n - 1]
        self.bias[n] = motion.keep[n] * self.bias[n - 1]
        dx, dy, turn = motion.odometry[n]
        c, s = np.cos(before[2]), np.sin(before[2])
        self.pose[n] = before + (c * dx - s * dy, s * dx + c * dy, turn)
        if not np.isfinite(self.pose[n]).all():
            self.pose[n] = motion.gnss[n] - self.bias[n]
            self.pose[n, 2] = before[2] + wrap_angle(self.pose[n, 2] - before[2])
        self.frames[n].rounds = len(self.settings.smooth_gates_m) // 2
        for _ in range(rounds):
            self.round()

    def reconsider(self, single: Solution) -> None:
        """Begin anew where the answers of each frame alone (0 to ``last``) tell another story.

        A lane that was chosen when little was known cannot be left by small steps. The frames of
        the window are then solved as a log of their own; what left it is forgotten.
        """
        some = slice(max(self.first, self.last + 1 - _STORY), self.last + 1)
        other, _ = first_poses(self._motion(some, alone=True), _part(single, some), None)
        apart = np.abs(other - self.pose[some])[-_APART_FRAMES:]
        apart[:, 2] = np.abs(wrap_angle(apart[:, 2]))
        far = np.median(np.hypot(apart[:, 0], apart[:, 1])) > _APART_M
        if not far and np.median(apart[:, 2]) < _APART_RAD:
            return
        if self._evidence(some, other) < self._evidence(some, self.pose[some]) + _CONVINCED:
            return
        now = slice(self.first, self.last + 1)
        self.prior, self.bumps = None, Bumps()
        self.frames = {t: FrameTerms() for t in self.frames}
        self.pose[now], self.bias[now] = first_poses(self._motion(now), _part(single, now), None)
        for _ in self.settings.smooth_gates_m:
            self.round()

    def _evidence(self, frames: slice, pose: Array) -> float:
        """What the detections of some frames say for poses (nats)."""
        some = picked(self.seen, np.arange(frames.start, frames.stop))
        rule = self.settings.start_gates_m[1][-1], self.settings.start_doubts_m[1][0]
        linear = linearize(self.lines, some, pose, rule[0])
        noise = noise_of(self.lines, some, linear, self.model, self.model.offset_share)
        noise = noise.doubted(rule[1])
        told = judge(some, linear, noise, linear.r, self.model, self.settings.smooth_huber).evidence
        return self.settings.evidence_share * float(told.sum())

    def _arrive(self, last: int) -> None:
        self.frames |= {t: FrameTerms() for t in range(self.last + 1, last + 1)}
        self.last = last

    def _motion(self, frames: slice, alone: bool = False) -> Motion:
        """The motion of some frames; what the prior says of the first bias is not said again,
        but where these frames are looked at ``alone``."""
        names = Motion.__dataclass_fields__
        part = Motion(**{n: getattr(self.motion, n)[frames] for n in names})
        if self.prior is None or alone:
            return part
        return replace(part, slow=np.concatenate([np.full((1, 3), np.inf), part.slow[1:]]))

    # ---- one round

    def round(self) -> None:
        """Linearize the frames that are due, then one step of Gauss–Newton."""
        rules = list(zip(self.settings.smooth_gates_m, self.settings.smooth_doubts_m, strict=True))
        due: dict[int, list[int]] = {}
        for t, frame in self.frames.items():
            moved = (np.abs(self.pose[t] - frame.at) > _MOVED).any()
            if not frame.fixed and (frame.rounds < len(rules) or moved):
                due.setdefault(min(frame.rounds, len(rules) - 1), []).append(t)
        now = slice(self.first, self.last + 1)
        spacing = self._motion(now).spacing
        for k, rows in due.items():
            frames = np.array(rows)
            terms = frame_terms(
                self.lines,
                picked(self.seen, frames),
                self.pose[frames],
                [self.frames[t] for t in rows],
                rules[k],
                spacing[frames - self.first],
                self.chunk[frames],
                self.bumps,
                self.model,
                self.settings.smooth_huber,
            )
            self.frames |= dict(zip(rows, terms, strict=True))
        self.step(apply=True)

    def step(self, apply: bool = False) -> Array:
        """(k, 6) what one step of Gauss–Newton would change of the states in the window."""
        layout = self._layout()
        step = self._system(layout, "solved").solve()
        state = step[layout.frame[:, None] + np.arange(STATE)]
        if apply:
            now = slice(self.first, self.last + 1)
            self.pose[now] += state[:, :3]
            self.bias[now] += state[:, 3:]
            field = step[layout.of_bumps(layout.bumps)].reshape(-1, 2)
            self.bumps.weights[layout.bumps] += field
        return state

    def _groups(self) -> list[tuple[int, Group]]:
        return [(t, g) for t, frame in self.frames.items() for g in frame.groups]

    def _layout(self) -> _Layout:
        touched = [g.bumps for _, g in self._groups()]
        touched += [] if self.prior is None else [self.prior.bumps]
        bumps = np.unique(np.concatenate([*touched, np.zeros(0, np.int64)]))
        return _Layout(bumps, self.bumps.born, self.chunk[self.first : self.last + 1])

    def _system(self, layout: _Layout, which: str) -> BlockSystem:
        """The factored system of all that is known; ``which`` of the two weightings."""
        motion = self._motion(slice(self.first, self.last + 1))
        system = self._filled(layout, which, self._groups(), layout.bumps, motion)
        system.factor()
        return system

    def _filled(
        self,
        layout: _Layout,
        which: str,
        groups: list[tuple[int, Group]],
        bumps: Index,
        motion: Motion,
    ) -> BlockSystem:
        """The past, some groups, the prior of some bumps and the motion of the first frames."""
        system = BlockSystem(layout.sizes)
        weights = self.bumps.weights
        for t, g in groups:
            index = layout.frame[t - self.first] + np.arange(3)
            index = np.concatenate([layout.of_bumps(g.bumps), index])
            gradient = g.gradient(np.concatenate([weights[g.bumps].ravel(), self.pose[t]]))
            order = np.argsort(index)
            matrix = getattr(g, which)[:-1, :-1]
            system.add(index[order], matrix[np.ix_(order, order)], gradient[order])
        if self.prior is not None:
            p = self.prior
            index = layout.of(p.bumps, p.frames - self.first)
            gradient = p.gradient + p.solved @ (self._values(p.bumps, p.frames) - p.at)
            order = np.argsort(index)
            matrix = getattr(p, which)
            system.add(index[order], matrix[np.ix_(order, order)], gradient[order])
        own = layout.of_bumps(bumps)
        system.add_prior(own, np.ones(len(own)), weights[bumps].ravel())
        now = slice(self.first, self.first + len(motion.step))
        terms = motion_terms(motion, self.pose[now], self.bias[now])
        first = layout.frame[: len(motion.step)]
        system.add_chain(first, terms.own, terms.below, terms.gradient)
        return system

    def _values(self, bumps: Index, frames: Index) -> Array:
        """(2 m + 6 k,) current weights and states."""
        states = np.concatenate([self.pose[frames], self.bias[frames]], axis=-1)
        return np.concatenate([self.bumps.weights[bumps].ravel(), states.ravel()])

    # ---- answers

    def answers(self, frames: range) -> Solution:
        """What is known now of some frames of the window."""
        layout = self._layout()
        system = self._system(layout, "stated")
        n = len(frames)
        covariance, information, chi2 = np.empty((n, 3, 3)), np.zeros((n, 3, 3)), np.zeros(n)
        for k, t in enumerate(frames):
            own = layout.frame[t - self.first] + np.arange(3)
            for axis in range(3):
                system.gradient[:] = 0.0
                system.gradient[own[axis]] = -1.0
                covariance[k, axis] = system.solve()[own]
            for g in self.frames[t].groups:
                information[k] += g.stated[-4:-1, -4:-1]
                chi2[k] += g.chi2(self.bumps.weights[g.bumps].ravel())
        rows = np.array(frames)
        used = np.array([self.frames[t].used for t in frames], np.int64)
        covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
        return Solution(self.pose[rows], covariance, information, chi2, used, np.zeros((n, 3, 3)))

    # ---- frames go

    def leave_behind(self, unanswered: int) -> None:
        """Eliminate chunks that lie two before that of the first unanswered frame."""
        while self.chunk[unanswered] - self.chunk[self.first] >= 2:
            self._eliminate()

    def _eliminate(self) -> None:
        """The first chunk becomes a prior of the second.

        What frames of the second say about bumps of the first goes with it.
        """
        chunk, born = int(self.chunk[self.first]), self.bumps.born
        follower = int(np.searchsorted(self.chunk, chunk + 1))
        going = [
            (t, g) for t, g in self._groups() if t < follower or (born[g.bumps] == chunk).any()
        ]
        touched = [g.bumps for _, g in going] + ([self.prior.bumps] if self.prior else [])
        bumps = np.unique(np.concatenate([*touched, np.zeros(0, np.int64)]))
        gone, kept = bumps[born[bumps] == chunk], bumps[born[bumps] > chunk]
        known = self.prior.frames if self.prior else np.zeros(0, np.int64)
        last = max([follower, *(t for t, _ in going), *known.tolist()])
        states = np.arange(follower, last + 1)
        layout = _Layout(bumps, born, self.chunk[self.first : last + 1])
        # GNSS of the follower stays with it.
        motion = self._motion(slice(self.first, follower + 1))
        white = np.concatenate([motion.white[:-1], np.full((1, 3), np.inf)])
        motion = replace(motion, white=white)
        solved, stated = (
            self._filled(layout, which, going, gone, motion) for which in ("solved", "stated")
        )
        matrix, gradient = _marginal(solved)
        at = self._values(kept, states)
        self.prior = _Prior(kept, states, matrix, _marginal(stated)[0], gradient, at)
        for t in range(self.first, follower):
            del self.frames[t]
        for t, g in going:
            if t >= follower:
                self.frames[t].groups.remove(g)
                self.frames[t].fixed = True
        self.bumps.forget(chunk)
        self.first = follower


def _part(solution: Solution, frames: slice) -> Solution:
    names = Solution.__dataclass_fields__
    return Solution(*(getattr(solution, n)[frames] for n in names))


def _marginal(system: BlockSystem) -> tuple[Array, Array]:
    """Information and gradient that the first of two chunks leaves on the second."""
    own, cross = cho_factor(system.diagonal[0], lower=True, check_finite=False), system.lower[0]
    split = len(system.diagonal[0])
    gain = cho_solve(own, cross.T, check_finite=False).T
    gradient = system.gradient[split:] - gain @ system.gradient[:split]
    return system.diagonal[1] - gain @ cross.T, gradient
