"""Single-frame MAP (Eq. 4 of the paper): several starts compete, the best one is refined."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.frame.held import solve_held
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.field import frame_basis
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import (
    Linear,
    common_offset,
    gram_sum,
    judge,
    linearize,
    noise_of,
    place_amplitude,
    turn_of,
)

Array = NDArray[np.float64]

# Frames solved together: enough to make numpy's overhead small, few enough to stay in the cache.
_BATCH = 64

# Starts that end closer than this found the same answer.
_SAME_M = 0.3


@dataclass(frozen=True)
class Solution:
    """``pose`` (T, 3) x, y, yaw relative to the lines' origin; ``covariance`` (T, 3, 3) of it;
    ``information`` (T, 3, 3) of the frame's map residuals alone; ``chi2`` (T,); ``residuals`` (T,)
    vertices that took part; ``spread`` (T, 3, 3) what rival starts added to the covariance."""

    pose: Array
    covariance: Array
    information: Array
    chi2: Array
    residuals: NDArray[np.int64]
    spread: Array


def solve_single(
    lines: MapLines,
    seen: Detections,
    model: ErrorModel,
    settings: Settings,
    before: Solution | None = None,
    start: Array | None = None,
) -> Solution:
    """Every frame on its own; the GNSS prior is the initial pose with its sigma.

    ``before``: answers to refine with another model, instead of searching for a start again.
    ``start`` (T, 3): where to search, if not at the initial poses.
    """
    parts = []
    for first in range(0, len(seen), _BATCH):
        last = min(first + _BATCH, len(seen))
        some = seen.between(first, last)
        if before is None:
            around = some.pose if start is None else start[first:last]
            pose, spread = _best_start(lines, some, around, model, settings)
        else:
            pose, spread = before.pose[first:last], before.spread[first:last]
        parts.append(_refine(lines, some, pose, spread, model, settings))
    names = Solution.__dataclass_fields__
    return Solution(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _best_start(
    lines: MapLines, seen: Detections, around: Array, model: ErrorModel, settings: Settings
) -> tuple[Array, Array]:
    """Pose (T, 3) of the start with the most evidence, and (T, 3, 3) the spread of its rivals.

    Starts lie to either side of ``around`` (T, 3).

    All starts take the first rounds with every second vertex; the best ``finalists`` that went
    different ways take the others with all.
    """
    t, starts = len(seen), len(settings.starts_m)
    many = seen.repeated(starts, every=2)
    pose = np.tile(around, (starts, 1))
    shift = np.repeat(settings.starts_m, t)
    pose[:, 0] -= np.sin(pose[:, 2]) * shift
    pose[:, 1] += np.cos(pose[:, 2]) * shift
    for rule in _rules(settings, 0):
        pose, evidence = _start_step(lines, many, pose, rule, model, settings)
    poses = _finalists(pose.reshape(starts, t, 3), evidence.reshape(starts, t), settings)
    count = len(poses)
    many, pose = seen.repeated(count), poses.reshape(-1, 3)
    for rule in _rules(settings, 1):
        pose, evidence = _start_step(lines, many, pose, rule, model, settings)
    poses, evidence = pose.reshape(count, t, 3), evidence.reshape(count, t)
    best = poses[evidence.argmax(0), np.arange(t)]
    d = poses - best
    d[..., 2] = wrap_angle(d[..., 2])
    # Starts that met share one vote.
    votes = np.exp(settings.evidence_share * (evidence - evidence.max(0)))
    votes /= (_distances(poses, poses) < _SAME_M).sum(1)
    votes /= votes.sum(0)
    return best, np.einsum("ht,hti,htj->tij", votes, d, d)


def _rules(settings: Settings, stage: int) -> Iterator[tuple[float, float]]:
    """Gate and doubt (m) of every round of a stage."""
    yield from zip(settings.start_gates_m[stage], settings.start_doubts_m[stage], strict=True)


def _distances(a: Array, b: Array) -> Array:
    """(H, G, T) metres between poses (H, T, 3) and (G, T, 3)."""
    return np.hypot(*np.moveaxis(a[:, None, :, :2] - b[None, :, :, :2], -1, 0))


def _finalists(poses: Array, evidence: Array, settings: Settings) -> Array:
    """(H, T, 3) the best of (S, T, 3) poses, preferring those that lie apart."""
    evidence = evidence.copy()
    columns = np.arange(poses.shape[1])
    out = []
    for _ in range(min(settings.finalists, len(poses))):
        best = evidence.argmax(0)
        out.append(poses[best, columns])
        near = _distances(poses, out[-1][None])[:, 0] < _SAME_M
        evidence = np.where(near, evidence - 1e6, evidence)
    return np.stack(out)


def _prior(seen: Detections, pose: Array) -> tuple[Array, Array]:
    """Information (T, 3) of the initial pose and the distance from it (T, 3)."""
    d = pose - seen.pose
    d[:, 2] = wrap_angle(d[:, 2])
    return 1.0 / seen.sigma**2, d


def _solve(g: Array, seen: Detections, pose: Array) -> tuple[Array, Array]:
    """The next pose (T, 3) and its covariance (T, 3, 3) from Grams (T, 4, 4) of jacobian and r."""
    information, d = _prior(seen, pose)
    h = g[:, :3, :3] + information[:, :, None] * np.eye(3)
    covariance: Array = np.linalg.inv(h).astype(np.float64)
    step = -(covariance @ (g[:, :3, 3] + information * d)[..., None])[..., 0]
    return pose + step, covariance


def _start_step(
    lines: MapLines,
    seen: Detections,
    pose: Array,
    rule: tuple[float, float],
    model: ErrorModel,
    settings: Settings,
) -> tuple[Array, Array]:
    """The pose with lines and weights held, elements independent; the evidence (T,) is that
    before it."""
    gate, doubt = rule
    linear = linearize(lines, seen, pose, gate)
    noise = noise_of(lines, seen, linear, model, model.offset_share)
    doubted = noise.doubted(doubt)
    judgement = judge(seen, linear, doubted, linear.r, model, settings.huber)
    information, d = _prior(seen, pose)
    evidence: Array = seen.sum_by_frame(judgement.evidence) - 0.5 * (information * d * d).sum(1)
    after, _ = solve_held(seen, linear, pose, replace(noise, weight=judgement.weight(noise)))
    return after, evidence


def _refine(
    lines: MapLines,
    seen: Detections,
    pose: Array,
    spread: Array,
    model: ErrorModel,
    settings: Settings,
) -> Solution:
    """Gauss–Newton with the field of place errors, which is eliminated class by class.

    After the first round lines are looked for where the elements are without their likely offsets:
    the nearest line of an element that is off by half a lane width (or half a crossing) is
    another one, and association to it would pull the pose along.
    """
    shift: Array | None = None
    for gate, doubt in zip(settings.gates_m, settings.doubts_m, strict=True):
        linear = linearize(lines, seen, pose, gate, shift)
        whole = noise_of(lines, seen, linear, model, model.offset_share).doubted(doubt)
        judgement = judge(seen, linear, whole, linear.r, model, settings.huber)
        noise = noise_of(lines, seen, linear, model, model.element_share)
        weight = judgement.weight(noise)
        g = _field_gram(seen, linear, weight, noise.shared, model)
        before, (pose, covariance) = pose, _solve(g, seen, pose)
        left = linear.r + (linear.jacobian @ (pose - before)[seen.frame, :, None])[..., 0]
        offset = common_offset(left, judgement.weight(whole), whole)
        shift = -offset[:, None] @ turn_of(seen, pose)
    used = seen.sum_by_frame(((weight > 0) & judgement.fits[:, None]).sum(-1))
    return Solution(
        pose,
        covariance + spread,
        g[:, :3, :3],
        g[:, 3, 3],
        used.astype(np.int64),
        spread,
    )


def _field_gram(
    seen: Detections, linear: Linear, weight: Array, shared: Array, model: ErrorModel
) -> Array:
    """Grams (T, 4, 4) of jacobian and r after the field of each class is taken out (Schur)."""
    out = np.zeros((len(seen), 4, 4))
    groups = seen.groups()
    if not groups:
        return out
    basis = frame_basis(seen.points, model.place_length_m)
    field = place_amplitude(seen, linear, model)[..., None] * basis[..., None, :]
    field = field.reshape(*basis.shape[:-1], -1)
    columns = np.concatenate([linear.jacobian, linear.r[..., None], field], axis=-1)
    g = np.stack([gram_sum(columns[e], weight[e], shared[e]) for _, _, e in groups])
    a = g[:, 4:, 4:] + np.eye(field.shape[-1])
    b = g[:, 4:, :4]
    left = g[:, :4, :4] - np.swapaxes(b, -1, -2) @ np.linalg.solve(a, b)
    np.add.at(out, [t for t, _, _ in groups], left)
    return out
