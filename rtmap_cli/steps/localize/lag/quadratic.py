"""Map residuals of single frames as quadratic forms of their pose and of the field around them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.steps.localize.drive.smooth import shares_of
from rtmap_cli.steps.localize.model import ErrorModel
from rtmap_cli.steps.localize.seeing.field import GridField
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import (
    Linear,
    gram_sum,
    judge,
    linearize,
    noise_of,
    place_amplitude,
)

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_HALF = 1 << 24
"""Grid cells per axis that fit into a key, to either side."""


@dataclass(frozen=True, eq=False)
class Group:
    """The residuals of one class in one frame.

    ``bumps`` (m,) of the field that they see; ``elements`` of the frame; ``design`` (n V, 2 m):
    what the weights of the bumps do to residuals; ``solved``, ``stated`` (2 m + 4, 2 m + 4): Grams
    of (weights, pose, residual), weighted for the solution and for its covariance, at the weights
    and the pose ``at`` (2 m + 3,).
    """

    bumps: Index
    elements: slice
    design: Array
    solved: Array
    stated: Array
    at: Array

    def gradient(self, now: Array) -> Array:
        """(2 m + 3,) half the slope of the residuals' χ² at (2 m + 3,) weights and pose."""
        out: Array = self.solved[:-1, -1] + self.solved[:-1, :-1] @ (now - self.at)
        return out

    def chi2(self, weights: Array) -> float:
        """χ² by the stated covariance, with the weights (2 m,) and where the pose was."""
        d = np.concatenate([weights - self.at[:-3], np.zeros(3), [1.0]])
        return float(d @ self.stated @ d)


@dataclass
class FrameTerms:
    """What one frame says: its groups, ``normal`` (E, V, 2) in map axes, ``used`` vertices that
    took part, ``rounds`` of linearization so far, the pose ``at`` (3,) of the last one; ``fixed``
    when a part of it has left the window."""

    groups: list[Group] = field(default_factory=list)
    normal: Array = field(default_factory=lambda: np.zeros((0, 0, 2)))
    used: int = 0
    rounds: int = 0
    at: Array = field(default_factory=lambda: np.full(3, np.inf))
    fixed: bool = False

    def shift(self, weights: Array, shape: tuple[int, int]) -> Array:
        """(E, V, 2) how the field moves the vertices; ``weights`` (n, 2) of all bumps."""
        out = np.zeros((*shape, 1))
        for g in self.groups:
            known = g.design @ weights[g.bumps].ravel()
            out[g.elements] = known.reshape(out[g.elements].shape)
        return out * self.normal if self.groups else np.zeros((*shape, 2))


class Bumps:
    """The bumps of the field with their weights; each lives for two chunks of travel.

    ``born`` (n,) chunk of each, ``weights`` (n, 2).
    """

    def __init__(self) -> None:
        self._name: dict[tuple[int, int], int] = {}
        self._born: list[int] = []
        self.weights = np.zeros((0, 2))

    @property
    def born(self) -> Index:
        """(n,) chunk that each bump belongs to."""
        return np.array(self._born, np.int64)

    def find(self, keys: list[int], chunk: int) -> Index:
        """The bumps of some keys, seen from a chunk; a key of older chunks is a new bump."""
        out = []
        for key in keys:
            got = self._name.get((key, chunk), self._name.get((key, chunk - 1)))
            if got is None:
                got = self._name[(key, chunk)] = len(self._born)
                self._born.append(chunk)
            out.append(got)
        more = len(self._born) - len(self.weights)
        if more > 0:
            self.weights = np.concatenate([self.weights, np.zeros((more + 64, 2))])
        return np.array(out, np.int64)

    def forget(self, chunk: int) -> None:
        """No frame will ask for a bump that was born in ``chunk`` or before."""
        self._name = {k: v for k, v in self._name.items() if k[1] > chunk}


def picked(seen: Detections, frames: Index) -> Detections:
    """The detections of some frames (rising), which become frames 0, 1, …"""
    low, high = np.searchsorted(seen.frame, frames), np.searchsorted(seen.frame, frames + 1)
    e = np.concatenate([np.arange(a, b) for a, b in zip(low, high, strict=True)])
    parts = {
        name: getattr(seen, name)[frames if name in ("pose", "sigma") else e]
        for name in seen.__dataclass_fields__
    }
    return Detections(**parts | {"frame": np.searchsorted(frames, parts["frame"])})


def frame_terms(
    lines: MapLines,
    some: Detections,
    pose: Array,
    before: list[FrameTerms],
    rule: tuple[float, float],
    spacing: Array,
    chunk: Index,
    bumps: Bumps,
    model: ErrorModel,
    huber: float,
) -> list[FrameTerms]:
    """Associate and linearize frames at ``pose`` (n, 3), as a round of ``solve_smooth`` does.

    ``before``: what they said so far; ``rule``: gate and doubt (m); ``spacing`` (n,) metres
    between frames; ``chunk`` (n,) of each.
    """
    ends = np.searchsorted(some.frame, np.arange(len(pose) + 1))
    vertices = some.points.shape[1]
    shift = np.concatenate(
        [
            f.shift(bumps.weights, (int(b - a), vertices))
            for f, a, b in zip(before, ends[:-1], ends[1:], strict=True)
        ]
    )
    shift[some.chain >= 0] = 0.0
    linear = linearize(lines, some, pose, rule[0], shift)
    parts = _seen_bumps(lines, some, linear, chunk, bumps, model)
    rest = linear.r.copy()
    for elements, seen, design in parts:
        known = design @ bumps.weights[seen].ravel()
        rest[elements] += known.reshape(rest[elements].shape)
    shares = shares_of(some, spacing, model)
    plain = noise_of(lines, some, linear, model, shares.judged).doubted(rule[1])
    judgement = judge(some, linear, plain, rest, model, huber)
    solved, stated = (
        noise_of(lines, some, linear, model, share, shares.map_repeats)
        for share in (shares.solved, shares.stated)
    )
    weights = judgement.weight(solved), judgement.weight(stated)
    used = some.sum_by_frame(((weights[1] > 0) & judgement.fits[:, None]).sum(-1))
    out = [
        FrameTerms([], linear.jacobian[a:b, :, :2], int(n), f.rounds + 1, p.copy())
        for a, b, n, f, p in zip(ends[:-1], ends[1:], used, before, pose, strict=True)
    ]
    for e, seen, design in parts:
        t = int(some.frame[e.start])
        field_part = design.reshape(*rest[e].shape, -1)
        columns = np.concatenate([field_part, linear.jacobian[e], rest[e][..., None]], axis=-1)
        first = gram_sum(columns, weights[0][e], solved.shared[e])
        second = gram_sum(columns, weights[1][e], stated.shared[e])
        at = np.concatenate([bumps.weights[seen].ravel(), pose[t]])
        own = slice(e.start - int(ends[t]), e.stop - int(ends[t]))
        out[t].groups.append(Group(seen, own, design, first, second, at))
    return out


def _seen_bumps(
    lines: MapLines,
    some: Detections,
    linear: Linear,
    chunk: Index,
    bumps: Bumps,
    model: ErrorModel,
) -> list[tuple[slice, Index, Array]]:
    """Elements, bumps (m,) and design (n V, 2 m) of every frame and class."""
    if not len(some.frame):
        return []
    amplitude = place_amplitude(some, linear, model)
    count = some.points.shape[1]
    at = lines.xy[linear.sample.ravel()]
    cells, values = GridField(model.place_length_m).basis(at)
    code = np.repeat(some.code, count)[:, None]
    key = (code * 2 * _HALF + cells[..., 0] + _HALF) * 2 * _HALF + cells[..., 1] + _HALF
    found = linear.found.ravel()
    out = []
    for t, _, elements in some.groups():
        rows = slice(elements.start * count, elements.stop * count)
        here = np.flatnonzero(found[rows])
        if not len(here):
            continue
        names, inverse = np.unique(key[rows][here], return_inverse=True)
        basis = np.zeros((rows.stop - rows.start, len(names)))
        basis[here[:, None], inverse.reshape(len(here), -1)] = values[rows][here]
        design = basis[:, :, None] * amplitude[elements].reshape(-1, 1, 2)
        seen = bumps.find(names.tolist(), int(chunk[t]))
        out.append((elements, seen, design.reshape(len(basis), -1)))
    return out
