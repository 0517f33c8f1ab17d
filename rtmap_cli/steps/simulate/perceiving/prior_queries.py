"""The perception model with a prior map: matched, outdated and new elements.

It imitates a network with prior queries (RTMap §3.2): elements of the prior in range of the
*noisy* initial pose become queries; each answers whether it still exists and where its vertices
are. Across a line a query helps (errors shrink by ``gain``); along it the image says little, so
that ``1 - along_gain`` of the initial pose's error stays in the vertices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rtmap_cli.geometry.polylines import (
    is_ring,
    length,
    resample_step,
    tangents,
)
from rtmap_cli.geometry.poses import invert, transform, yaw_of
from rtmap_cli.logs.run import MATCHED, OUTDATED
from rtmap_cli.maps.crop import MapIndex
from rtmap_cli.maps.element import CLASSES, RING_CLASSES, VectorMap
from rtmap_cli.maps.prior import PriorSlots, prior_slots
from rtmap_cli.steps.simulate.driving.traffic import visible
from rtmap_cli.steps.simulate.perceiving.noise import FirstOrder, generator
from rtmap_cli.steps.simulate.perceiving.perception import (
    VERTICES,
    Detection,
    Perception,
    SeenPiece,
    View,
    sigmoid,
    stretch,
)

Array = NDArray[np.float64]

STEP = 0.25
REAL_SHARE = 0.6
"""A query is real when this share of its vertices still has a line of its class in place."""
SEEN_SHARE = 0.3
"""A query of which less than this share can be seen counts as hidden."""
NEW_LENGTH = 2.0
"""Shortest stretch (m) of a world line without a prior that is looked for."""


@dataclass(frozen=True)
class _Lines:
    """Dense samples of the lines of one class: places and unit tangents, (n, 2) in the map."""

    tree: cKDTree
    xy: Array
    tangent: Array

    @staticmethod
    def of(elements: list[Array]) -> _Lines | None:
        """Samples STEP apart; None without lines."""
        if not elements:
            return None
        dense = [resample_step(e[:, :2], STEP) for e in elements]
        xy = np.concatenate(dense)
        return _Lines(cKDTree(xy), xy, np.concatenate([tangents(d) for d in dense]))

    def feet(self, points: Array) -> tuple[Array, Array, Array]:
        """Nearest places on the lines (n, 2), distances (n,) and tangents there (n, 2)."""
        _, near = self.tree.query(points)
        t = self.tangent[near]
        slide = np.clip(((points - self.xy[near]) * t).sum(-1), -STEP / 2, STEP / 2)
        feet = self.xy[near] + slide[:, None] * t
        return feet, np.hypot(*(points - feet).T), t


def _by_class(index: MapIndex) -> dict[str, _Lines | None]:
    lines: dict[str, list[Array]] = {name: [] for name in CLASSES}
    for element in index.elements:
        lines.setdefault(element.class_name, []).append(element.points)
    return {name: _Lines.of(points) for name, points in lines.items()}


class PriorPerception:
    """What a drive reports when its network is given the prior map."""

    def __init__(self, perception: Perception, prior: VectorMap, start_sigma: Array) -> None:
        """``start_sigma`` (3,): sd of the initial pose, metres, metres, radians."""
        self.perception, self.preset = perception, perception.preset.prior
        self.key, self.errors = perception.key, perception.errors
        self.start_sigma = start_sigma
        self.prior = MapIndex(prior)
        self.prior_lines = _by_class(self.prior)
        self.world_lines = _by_class(perception.index)
        memory = perception.preset.element_memory
        self.doubt = FirstOrder((*self.key.drive, "doubt"), memory, 1)

    def queries(self, view: View, initial: Array) -> list[Detection]:
        """The answers of the prior queries of one frame; ``initial`` is T⁰ (4, 4)."""
        local = self.prior.crop(initial, self.perception.range)
        slots = prior_slots(local, initial, list(CLASSES), VERTICES, self.preset.slots)
        names: dict[str, int] = {}
        out = []
        for k, element_id in enumerate(slots.element_ids):
            number = names[element_id] = names.get(element_id, -1) + 1
            out.append(self._answer(slots, k, f"prior:{element_id}#{number}", view))
        return out

    def _answer(self, slots: PriorSlots, k: int, name: str, view: View) -> Detection:
        rng = generator(*self.key.drive, "query", view.frame, name)
        class_name = CLASSES[int(slots.class_index[k])]
        placed, asked = slots.points[k], slots.map_points[k]
        lines = self.world_lines[class_name]
        feet, distance, tangent = (
            lines.feet(asked) if lines else (asked, np.full(20, np.inf), asked)
        )
        there = distance < self.preset.same_place_m
        real = bool(there.mean() >= REAL_SHARE)
        looked_at = transform(invert(view.pose), asked)
        share = float(visible(looked_at, view.occluders).mean())
        hardness = self.errors.hardness(class_name, asked)
        seen = real and rng.random() < self.perception.chance(
            class_name, looked_at, share, hardness
        )
        existence = self._existence(real, seen, share, name, view)
        points, sigma = placed, self._start_sd(placed)
        score = sigmoid(existence - 1.0)
        if seen and lines is not None:
            q = self.errors.spread(hardness, rng)
            gain = self.preset.gain
            places, stuck = self._places(lines, feet, tangent, placed, asked, view)
            if is_ring(placed):
                places, stuck = feet, np.zeros((VERTICES, 2))
            at = transform(invert(view.pose), places)
            got, sd, offset = self.errors.measure(class_name, name, view, at, q, gain)
            points = np.where(there[:, None], got, points)
            sigma = np.where(there[:, None], np.sqrt(sd**2 + stuck**2), sigma)
            score = self.errors.score(offset, rng)
        return Detection(
            class_name,
            points,
            self.errors.stated(sigma, rng),
            score,
            MATCHED if existence > 0 else OUTDATED,
            sigmoid(existence),
            slots.element_ids[k],
            asked,
        )

    def _existence(self, real: bool, seen: bool, share: float, name: str, view: View) -> float:
        """Logit that the element still exists; what is hidden cannot be told apart."""
        if seen:
            mean, sd = self.preset.seen
        elif share < SEEN_SHARE:
            mean, sd = self.preset.hidden
        else:
            mean, sd = self.preset.missed if real else self.preset.vanished
        return mean + sd * float(self.doubt.at(name, view.frame)[0])

    def _start_sd(self, points: Array) -> Array:
        """(n, 2) sd along ego x and y of vertices (n, 2) placed by the initial pose."""
        x, y, yaw = self.start_sigma
        return np.stack([np.hypot(x, yaw * points[:, 1]), np.hypot(y, yaw * points[:, 0])], axis=-1)

    def _places(
        self, lines: _Lines, feet: Array, tangent: Array, placed: Array, asked: Array, view: View
    ) -> tuple[Array, Array]:
        """Where on the world's lines the vertices of a query are seen, and its error along them.

        A vertex keeps ``1 - along_gain`` of the initial pose's error along the line. Returns the
        places (n, 2) in the map frame and the sd (n, 2) of that error along ego x and y.
        """
        start_error = transform(view.pose, placed) - asked
        kept = 1.0 - self.preset.along_gain
        slide = kept * (start_error * tangent).sum(-1)
        places, _, tangent = lines.feet(feet + slide[:, None] * tangent)
        yaw = float(yaw_of(view.pose))
        c, s = np.cos(yaw), np.sin(yaw)
        along = tangent @ np.array([[c, -s], [s, c]])
        sd = self.start_sigma
        arm = along[:, 1] * placed[:, 0] - along[:, 0] * placed[:, 1]
        total = np.sqrt(((sd[:2] * along) ** 2).sum(-1) + (sd[2] * arm) ** 2)
        return places, kept * total[:, None] * np.abs(along)

    def new_pieces(self, view: View) -> list[SeenPiece]:
        """The world's elements in range, as far as the prior does not hold them."""
        out = []
        for piece in self.perception.pieces(view):
            lines = self.prior_lines.get(piece.class_name)
            if lines is None:
                out.append(piece)
                continue
            dense = resample_step(piece.points, 0.5)
            _, distance, _ = lines.feet(transform(view.pose, dense))
            missing = distance >= self.preset.same_place_m
            if piece.class_name in RING_CLASSES:
                if missing.mean() > 1.0 - REAL_SHARE:
                    out.append(piece)
                continue
            for number, run in enumerate(_runs(missing)):
                step = length(piece.points) / (len(dense) - 1)
                if (run[1] - run[0] - 1) * step >= NEW_LENGTH:
                    part = stretch(piece.points, run[0] * step, (run[1] - 1) * step)
                    name = f"{piece.name}/{number}"
                    out.append(SeenPiece(piece.class_name, part, piece.share, name))
        return out


def _runs(mask: NDArray[np.bool_]) -> list[list[int]]:
    """Half-open index ranges where a mask is True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [list(map(int, r)) for r in edges.reshape(-1, 2)]
