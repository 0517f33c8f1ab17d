"""Detections of the frames of a run as flat arrays, sorted by frame and class."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.logs.run import MATCHED, OUTDATED, Observations, Run
from rtmap_cli.maps.element import RING_CLASSES
from rtmap_cli.steps.localize.model import Settings
from rtmap_cli.steps.localize.seeing.lines import MapLines

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Detections:
    """T frames with E detected elements of V vertices.

    ``pose`` (T, 3): initial x, y (relative to the origin of the lines), yaw; ``sigma`` (T, 3).
    Per element: ``frame``, ``code`` (E,) frame and class, in this order; ``points``, ``tangent``,
    ``spread`` (E, V, 2): vertices, directions and stated sigmas in the ego frame; ``common``
    (E, 2): rms of its sigmas; ``length`` (E,) metres; ``logit`` (E,): prior log-odds that it is on
    the map; ``chain`` (E,): the chain of lines that it was matched with, or -1; ``row`` (E,): its
    row in the observations of the run.
    """

    pose: Array
    sigma: Array
    frame: Index
    code: Index
    points: Array
    tangent: Array
    spread: Array
    common: Array
    length: Array
    logit: Array
    chain: Index
    row: Index

    def __len__(self) -> int:
        return len(self.pose)

    def repeated(self, times: int, every: int = 1) -> Detections:
        """All frames ``times`` times (copy h of frame t is h T + t), every n-th vertex."""
        shift = np.repeat(np.arange(times) * len(self), len(self.frame))
        many = {
            name: np.concatenate([getattr(self, name)] * times)
            for name in self.__dataclass_fields__
        }
        for name in ("points", "tangent", "spread"):
            many[name] = many[name][:, ::every]
        return Detections(**many | {"frame": many["frame"] + shift})

    def sum_by_frame(self, values: Array) -> Array:
        """(E, ...) → (T, ...)."""
        out = np.zeros((len(self), *values.shape[1:]))
        if len(self.frame):
            start = np.flatnonzero(np.diff(self.frame, prepend=-1))
            out[self.frame[start]] = np.add.reduceat(values, start, axis=0)
        return out

    def groups(self) -> list[tuple[int, int, slice]]:
        """Frame, class and elements of every (frame, class) that has any."""
        if not len(self.frame):
            return []
        key = self.frame * (int(self.code.max()) + 1) + self.code
        start = np.flatnonzero(np.diff(key, prepend=-1))
        stop = np.append(start[1:], len(key))
        return [
            (int(self.frame[a]), int(self.code[a]), slice(int(a), int(b)))
            for a, b in zip(start, stop, strict=True)
        ]

    def between(self, first: int, last: int) -> Detections:
        """Frames ``first`` to ``last`` - 1."""
        e = slice(*np.searchsorted(self.frame, (first, last)))
        parts = {
            name: getattr(self, name)[slice(first, last) if name in ("pose", "sigma") else e]
            for name in self.__dataclass_fields__
        }
        return Detections(**parts | {"frame": parts["frame"] - first})


def directions(points: Array, ring: NDArray[np.bool_]) -> Array:
    """(n, V, 2) unit directions of n polylines by central differences; rings wrap around."""
    d = np.empty_like(points)
    d[:, 1:-1] = points[:, 2:] - points[:, :-2]
    d[:, 0] = np.where(ring[:, None], points[:, 1] - points[:, -2], points[:, 1] - points[:, 0])
    d[:, -1] = np.where(ring[:, None], d[:, 0], points[:, -1] - points[:, -2])
    return d / np.maximum(np.hypot(d[..., 0], d[..., 1]), 1e-9)[..., None]


def has_matches(run: Run) -> bool:
    """True when the run says which map element a detection is (the paper's D)."""
    return bool((run.observations.state == MATCHED).any())


def _usable(
    o: Observations, lines: MapLines, settings: Settings, matched: bool
) -> tuple[NDArray[np.bool_], Index, Array]:
    """Which observations take part, the chain that each is bound to, prior log-odds.

    With D only matched ones do, and the probability that the prior element still exists counts.
    Without, every detection does that is not an outdated element.
    """
    keep = np.isin(o.class_name, lines.classes) & (o.score >= settings.min_score)
    logit = _logit(o.score) + settings.score_logit
    if not matched:
        return keep & (o.state != OUTDATED), np.full(len(o), -1, np.int64), logit
    chain = np.array([lines.chain_of_id.get(i, -1) for i in o.element_id], np.int64)
    exists = np.where(np.isfinite(o.existence), o.existence, 0.9)
    return keep & (o.state == MATCHED), chain, _logit(exists) + settings.score_logit


def _logit(probability: NDArray[Any]) -> Array:
    p = np.clip(np.asarray(probability, np.float64), 1e-3, 1.0 - 1e-3)
    return np.log(p / (1.0 - p))


def read_detections(run: Run, lines: MapLines, settings: Settings, matched: bool) -> Detections:
    """The detections of a run that take part; ``matched`` binds them to the elements of D."""
    o, frames = run.observations, run.frames
    keep, chain, logit = _usable(o, lines, settings, matched)
    row_of = {int(f): i for i, f in enumerate(frames.frame)}
    code_of = {name: k for k, name in enumerate(lines.classes)}
    frame = np.array([row_of.get(int(f), -1) for f in o.frame], np.int64)
    code = np.array([code_of.get(name, -1) for name in o.class_name], np.int64)
    rows = np.flatnonzero(keep & (frame >= 0))
    rows = rows[np.lexsort((rows, code[rows], frame[rows]))]
    points = o.points[rows].astype(np.float64)
    spread = o.sigma[rows].astype(np.float64)
    steps = np.hypot(*np.moveaxis(np.diff(points, axis=1), -1, 0))
    pose = xyyaw_of(frames.initial)
    pose[:, :2] -= lines.origin
    return Detections(
        pose=pose,
        sigma=frames.sigma.astype(np.float64),
        frame=frame[rows],
        code=code[rows],
        points=points,
        tangent=directions(points, np.isin(o.class_name[rows], list(RING_CLASSES))),
        spread=spread,
        common=np.sqrt((spread**2).mean(axis=1)),
        length=np.maximum(steps.sum(axis=1), 0.1),
        logit=np.clip(logit[rows], -3.0, 5.0),
        chain=chain[rows],
        row=rows,
    )
