"""The perception model: what a network would report of the world from one pose.

Errors have parts that stay fixed to the place (the same in every drive through one world), parts
fixed to the drive, to the element in the drive, and to the vertex; see docs/simulate.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.polylines import (
    arc_length,
    clip_to_box,
    is_ring,
    length,
    resample,
    resample_step,
)
from rtmap_cli.geometry.poses import invert, transform, yaw_of
from rtmap_cli.logs.log import Occluder
from rtmap_cli.logs.run import NEW
from rtmap_cli.maps.crop import DEFAULT_RANGE, MapIndex, Range
from rtmap_cli.maps.element import CLASSES, RING_CLASSES, Element, VectorMap
from rtmap_cli.steps.simulate.driving.traffic import visible
from rtmap_cli.steps.simulate.perceiving.noise import FirstOrder, generator, smooth_field
from rtmap_cli.steps.simulate.perceiving.presets import Preset

Array = NDArray[np.float64]

VERTICES = 20
BRIDGED_GAP = 8.0
OWN_RUN = 10.0
"""Hidden gaps up to BRIDGED_GAP m are bridged; further visible runs from OWN_RUN m on are
detections of their own."""


@dataclass(frozen=True)
class Detection:
    """One reported element: ``points``, ``sigma`` (V, 2) in the ego frame, metres, standard
    deviations; ``existence``, ``element_id`` and ``prior_points`` (V, 2; map frame) where a
    prior query reported it."""

    class_name: str
    points: Array
    sigma: Array
    score: float
    state: int = NEW
    existence: float = np.nan
    element_id: str | None = None
    prior_points: Array | None = None


@dataclass(frozen=True)
class View:
    """One moment: the true pose map_SE3_ego (4, 4), what hides, and which frame it is."""

    frame: int
    pose: Array
    occluders: tuple[Occluder, ...]


@dataclass(frozen=True)
class DriveKey:
    """What the random numbers of a drive hang on."""

    world_seed: int
    seed: int
    traversal: int

    @property
    def drive(self) -> tuple[str | int, ...]:
        """Key of what belongs to this drive alone."""
        return ("drive", self.world_seed, self.seed, self.traversal)


def sigmoid(logit: float) -> float:
    """Probability of a logit."""
    return float(1.0 / (1.0 + np.exp(-logit)))


class ErrorModel:
    """Position errors of one drive: correlated over place, drive and element."""

    def __init__(self, preset: Preset, key: DriveKey) -> None:
        self.preset, self.key = preset, key
        shift = generator(*key.drive, "shift").normal(size=2)
        self.shift = shift * np.array(preset.drive_shift)
        self.elements = FirstOrder((*key.drive, "element"), preset.element_memory, 2)

    def hardness(self, class_name: str, map_points: Array) -> float:
        """Mean of the class's hardness field over (n, 2) map points: unit variance at a point."""
        place = ("hardness", self.key.world_seed, class_name)
        return float(smooth_field(place, self.preset.field_length)(map_points).mean())

    def spread(self, hardness: float, rng: np.random.Generator) -> float:
        """The factor q = exp(a·h + b·N) on every error of an element in a frame."""
        a, b = self.preset.spread
        return float(np.exp(a * hardness + b * rng.normal()))

    def scales(self, class_name: str, points: Array, q: float) -> tuple[Array, Array]:
        """Laplace scale and offset sd, both (n, 2) m along ego x and y, of (n, 2) ego points.

        They grow with the range r as 0.5 + r / 24 and are 1.2 along and 0.8 across the ray.
        """
        reach = np.hypot(points[:, 0], points[:, 1])
        along = np.abs(points) / np.maximum(reach, 1e-9)[:, None]
        grow = self.preset.noise.get(class_name, 1.0) * q * (0.5 + reach / 24.0)
        factor = grow[:, None] * (0.8 + 0.4 * along)
        steps = np.hypot(*np.diff(points, axis=0).T)
        spacing = np.minimum(np.append(steps, np.inf), np.append(np.inf, steps))
        crowded = np.minimum(1.0, spacing / 0.8)[:, None]
        return self.preset.vertex_scale * factor * crowded, self.preset.offset_sd * factor

    def unit_offset(self, class_name: str, name: str, view: View, points: Array) -> Array:
        """(n, 2) offsets of unit variance, ego axes: place, drive and element parts together."""
        p = self.preset
        map_points = transform(view.pose, points)
        drive = (*self.key.drive, "offset", class_name)
        world = ("offset", self.key.world_seed, class_name)
        place_part = smooth_field(world, p.field_length, 2)(map_points)
        drive_part = smooth_field(drive, p.field_length, 2)(map_points)
        shares = np.sqrt(np.array(p.shares) / sum(p.shares))
        in_map = shares[0] * place_part + shares[1] * drive_part
        yaw = yaw_of(view.pose)
        c, s = np.cos(yaw), np.sin(yaw)
        in_ego = in_map @ np.array([[c, -s], [s, c]])
        return in_ego + shares[2] * self.elements.at(name, view.frame)

    def measure(
        self, class_name: str, name: str, view: View, points: Array, q: float, gain: float = 1.0
    ) -> tuple[Array, Array, float]:
        """Seen vertices (n, 2), their true sd (n, 2) and the mean sd of their common offset.

        ``points`` (n, 2) are the true places in the ego frame; ``gain`` scales every error but
        the shift of the whole drive.
        """
        rng = generator(*self.key.drive, "vertex", view.frame, name)
        scale, offset = (gain * v for v in self.scales(class_name, points, q))
        error = offset * self.unit_offset(class_name, name, view, points)
        error = error + rng.laplace(size=points.shape) * scale
        if is_ring(points):
            error[-1] = error[0]
        sigma = np.sqrt(2 * scale**2 + offset**2 + np.square(self.preset.drive_shift))
        return points + error + self.shift, sigma, float(offset.mean())

    def stated(self, sigma: Array, rng: np.random.Generator) -> Array:
        """What the network says about its scale: the true one, or blurred by sigma_spread."""
        if self.preset.sigma_spread > 0:
            sigma = sigma * np.exp(self.preset.sigma_spread * rng.normal(size=sigma.shape))
        return np.maximum(sigma, 1e-3)

    def score(self, offset_sd: float, rng: np.random.Generator) -> float:
        """Confidence of a true detection: surer where its place is surer."""
        level, slope, sd = self.preset.score
        logit = level - slope * np.log(max(offset_sd, 0.01) / 0.6) + sd * rng.normal()
        return sigmoid(logit)


@dataclass(frozen=True)
class SeenPiece:
    """A stretch of a world element as far as it can be seen: ``points`` (n, 2) in the ego frame,
    ``share`` of its element's length in range that is not hidden."""

    class_name: str
    points: Array
    share: float
    name: str


class Perception:
    """What one drive through a world reports, frame by frame (frames in order)."""

    def __init__(
        self, world: VectorMap, preset: Preset, key: DriveKey, range_m: Range = DEFAULT_RANGE
    ) -> None:
        self.preset, self.key, self.range = preset, key, range_m
        self.index = MapIndex(world, join=True)
        self.names = {id(e): _place_name(e) for e in self.index.elements}
        self.errors = ErrorModel(preset, key)

    def pieces(self, view: View) -> list[SeenPiece]:
        """The world's elements in range of the true pose, split where vehicles hide them."""
        out = []
        counts: dict[str, int] = {}
        for local in self.index.crop(view.pose, self.range):
            points = local.points[:, :2]
            source = self.names[id(local.source)]
            if local.class_name in RING_CLASSES:
                dense = resample_step(points, 0.5)
                runs = [(points, float(visible(dense, view.occluders).mean()))]
            else:
                runs = visible_runs(points, view.occluders)
            for run, share in runs:
                number = counts[source] = counts.get(source, -1) + 1
                out.append(SeenPiece(local.class_name, run, share, f"{source}#{number}"))
        return out

    def chance(self, class_name: str, points: Array, share: float, hardness: float) -> float:
        """Probability that a network detects an element of which ``share`` can be seen."""
        p = self.preset
        reach = float(np.hypot(points[:, 0], points[:, 1]).mean())
        near = 1.0 - p.range_loss * (reach / 36.0) ** 2
        worn = 1.0 - p.hardness_loss * sigmoid(3.0 * (hardness - 1.2))
        return p.detected.get(class_name, 1.0) * max(near, 0.0) * min(1.0, 0.2 + share) * worn

    def detect(self, piece: SeenPiece, view: View) -> Detection | None:
        """The detection of a piece without a prior, or None when it is missed."""
        rng = generator(*self.key.drive, "detect", view.frame, piece.name)
        name = piece.class_name
        hardness = self.errors.hardness(name, transform(view.pose, resample(piece.points, 20)))
        if rng.random() >= self.chance(name, piece.points, piece.share, hardness):
            return None
        q = self.errors.spread(hardness, rng)
        points = self._sampled(piece, q, rng)
        seen, sigma, offset_sd = self.errors.measure(name, piece.name, view, points, q)
        score = self.errors.score(offset_sd, rng)
        if rng.random() < self.preset.wrong_class:
            name = str(rng.choice([c for c in CLASSES if c != name]))
        return Detection(name, seen, self.errors.stated(sigma, rng), score)

    def _sampled(self, piece: SeenPiece, q: float, rng: np.random.Generator) -> Array:
        """V vertices of a piece: rings start anywhere, open lines lose a bit of both ends."""
        points = piece.points
        if is_ring(points):
            start = int(rng.integers(len(points) - 1))
            ring = np.roll(points[:-1], -start, axis=0)
            sampled = resample(np.concatenate([ring, ring[:1]]), VERTICES)
            sampled[-1] = sampled[0]
            return sampled
        reach = np.hypot(*points[[0, -1]].T)
        mean = self.preset.end_cut * self.preset.noise.get(piece.class_name, 1.0)
        cut = rng.exponential(size=2) * mean * (0.5 + reach / 24.0)
        total = length(points)
        cut *= min(1.0, 0.6 * total / max(float(cut.sum()), 1e-9))
        return resample(stretch(points, float(cut[0]), total - float(cut[1])), VERTICES)


def visible_runs(points: Array, occluders: tuple[Occluder, ...]) -> list[tuple[Array, float]]:
    """An open line split into what can be seen of it, with the visible share of the whole.

    The longest run always comes back, further ones from OWN_RUN m on; where (almost) nothing can
    be seen the line comes back whole.
    """
    dense = resample_step(points, 0.5)
    seen = visible(dense, occluders)
    if seen.all():
        return [(points, 1.0)]
    step = length(points) / (len(dense) - 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    runs = edges.reshape(-1, 2).tolist()
    merged: list[list[int]] = []
    for start, stop in runs:
        if merged and (start - merged[-1][1]) * step <= BRIDGED_GAP:
            merged[-1][1] = stop
        else:
            merged.append([start, stop])
    merged.sort(key=lambda r: r[0] - r[1])
    share = float(seen.mean())
    kept = [r for k, r in enumerate(merged) if k == 0 or (r[1] - r[0]) * step >= OWN_RUN]
    if not kept or (kept[0][1] - kept[0][0]) * step < 2.0:
        return [(points, share)]
    at = arc_length(points)[-1] / (len(dense) - 1)
    return [(stretch(points, r[0] * at, (r[1] - 1) * at), share) for r in kept]


def stretch(points: Array, start: float, stop: float) -> Array:
    """The part of a line between two arc lengths, metres; its own vertices are kept."""
    s = arc_length(points)
    inner = (s > start + 1e-9) & (s < stop - 1e-9)
    ends = np.stack([np.interp([start, stop], s, points[:, k]) for k in range(points.shape[1])], -1)
    return np.concatenate([ends[:1], points[inner], ends[1:]])


def _place_name(element: Element) -> str:
    """A name that depends on where an element lies, not on its number in the map."""
    xy = element.xy
    first, last = sorted(map(tuple, np.round(xy[[0, len(xy) // 2]], 2).tolist()))
    return f"{element.class_name}@{first}{last}"


class FalseElements:
    """What a drive reports though it is not there: noise per frame, and ghosts that stay."""

    def __init__(self, perception: Perception, true_poses: Array) -> None:
        self.perception, self.preset = perception, perception.preset
        self.key = perception.key
        rng = generator(*self.key.drive, "ghosts")
        self.ghosts: list[tuple[str, Array]] = []
        for _ in range(rng.poisson(self.preset.ghosts_per_drive)):
            pose = true_poses[rng.integers(len(true_poses))]
            name = str(rng.choice(CLASSES))
            self.ghosts.append((name, transform(pose, self._shape(name, rng))))

    def _shape(self, class_name: str, rng: np.random.Generator) -> Array:
        """(V, 2) of a plausible element somewhere in range: a rectangle or a slightly bent line."""
        x0, y0, x1, y1 = self.perception.range
        centre = np.array([rng.uniform(x0, x1), rng.uniform(y0, y1)]) * 0.9
        if class_name in RING_CLASSES:
            half = np.array([rng.uniform(1.5, 2.5), rng.uniform(3.0, 8.0)])
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
            line = resample(corners, VERTICES)
            heading = rng.normal(0, 0.2)
        else:
            s = np.linspace(-0.5, 0.5, VERTICES) * rng.uniform(6.0, 30.0)
            line = np.stack([s, rng.normal(0, 0.004) * s**2], axis=-1)
            heading = rng.normal(0, 0.25)
        c, s = np.cos(heading), np.sin(heading)
        line = line @ np.array([[c, s], [-s, c]]) + centre
        if class_name in RING_CLASSES:
            return np.clip(line, [x0, y0], [x1, y1])
        inside = clip_to_box(line, self.perception.range)
        return resample(max(inside, key=length), VERTICES)

    def of(self, view: View) -> list[Detection]:
        """The false detections of one frame."""
        rng = generator(*self.key.drive, "false", view.frame)
        out = []
        for name, mean in self.preset.false_per_frame.items():
            for _ in range(rng.poisson(mean)):
                shape = self._shape(name, rng)
                out.append(self._reported(name, shape, shape, self.preset.false_score, rng))
        for number, (name, ghost) in enumerate(self.ghosts):
            points = transform(invert(view.pose), ghost)
            x0, y0, x1, y1 = self.perception.range
            inside = ((points >= [x0, y0]) & (points <= [x1, y1])).all()
            if inside and rng.random() < 0.5:
                errors = self.perception.errors
                seen, _, _ = errors.measure(name, f"ghost{number}", view, points, 1.0)
                out.append(self._reported(name, points, seen, self.preset.ghost_score, rng))
        return out

    def _reported(
        self,
        class_name: str,
        place: Array,
        points: Array,
        score: tuple[float, float],
        rng: np.random.Generator,
    ) -> Detection:
        errors = self.perception.errors
        scale, offset = errors.scales(class_name, place, errors.spread(0.0, rng))
        sigma = np.sqrt(2 * scale**2 + offset**2 + np.square(self.preset.drive_shift))
        logit = score[0] + score[1] * rng.normal()
        return Detection(class_name, points, errors.stated(sigma, rng), sigmoid(logit))
