"""Whole-log MAP: odometry, GNSS with a walking bias, map residuals and a field of place errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.drive.blocks import BlockSystem
from rtmap_cli.steps.localize.drive.motion import STATE, Motion, motion_terms
from rtmap_cli.steps.localize.drive.place import PlaceField
from rtmap_cli.steps.localize.frame.single import Solution
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import Noise, judge, linearize, noise_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CHUNK_FRAMES = 80
_START_ROUNDS = 6
# Single-frame answers of one drive share their systematic errors: they count a tenth.
_START_SHARE = 0.1
# What of the field's variance is unknown while elements are judged.
_FIELD_DOUBT = 0.25
# Frames in which one error of an element or of the map is seen, at most.
_MOST_REPEATS = 100.0
# An element's own offset fades on the way; what of its repeats the stated covariance counts (with
# all of them regions that should hold 90 % hold more than 95 %).
_FADING = 0.35


def solve_smooth(
    lines: MapLines,
    seen: Detections,
    motion: Motion,
    start: Solution,
    model: ErrorModel,
    settings: Settings,
    first: Array | None = None,
) -> Solution:
    """Gauss–Newton over all frames; ``start`` are the single-frame answers, ``first`` (T, 3) poses
    to begin from that are nearer than GNSS.

    What stays at the place for the whole drive is the field, and is solved for; lines are looked
    for where the vertices are without it. Other errors that several frames share are inflated by
    the number of frames that see them: the map's over ``map_persist_m`` of travel, and an
    element's own offset over ``element_length_m``. Where a detection found its line by itself that
    enters the covariance alone: in the solution it would leave to the field what frames can tell
    from it. An answer to a prior query leans on where the prior was put, in every frame alike,
    and counts once on either side of ``element_length_m``.
    """
    pose, bias = first_poses(motion, start, first)
    asked = seen.chain >= 0
    shares = shares_of(seen, motion.spacing, model)
    map_repeats = shares.map_repeats
    chunk = chunks(motion.step, settings.chunk_m)
    field: PlaceField | None = None
    shift: Array | None = None
    for gate, doubt in zip(settings.smooth_gates_m, settings.smooth_doubts_m, strict=True):
        linear = linearize(lines, seen, pose, gate, shift)
        field = PlaceField(lines, seen, linear, chunk, model, field)
        plain = noise_of(lines, seen, linear, model, shares.judged).doubted(doubt)
        judgement = judge(
            seen, linear, plain, linear.r + field.predict(), model, settings.smooth_huber
        )
        noise = noise_of(lines, seen, linear, model, shares.solved, map_repeats)
        weight, index = judgement.weight(noise), field.frame_index
        system, _, _ = _system(field, weight, noise, motion, pose, bias)
        step = system.solve()
        pose = pose + step[index[:, None] + np.arange(3)]
        bias = bias + step[index[:, None] + np.arange(3, STATE)]
        field.update(step)
        shift = field.predict()[..., None] * linear.jacobian[..., :2]
        shift[asked] = 0.0
    if field is None:
        raise ValueError("smooth_gates_m is empty")
    noise = noise_of(lines, seen, linear, model, shares.stated, map_repeats)
    weight = judgement.weight(noise)
    system, information, chi2 = _system(field, weight, noise, motion, pose, bias)
    used = seen.sum_by_frame(((weight > 0) & judgement.fits[:, None]).sum(-1))
    covariance = _pose_blocks(system, chunk, index)
    spread = np.zeros_like(covariance)
    return Solution(pose, covariance, information, chi2, used.astype(np.int64), spread)


@dataclass(frozen=True)
class Shares:
    """Shares (E,) of the stated variance that the offset of an element has: where it is
    ``judged``, ``solved`` for and in the ``stated`` covariance; ``map_repeats`` (E,): frames that
    see one error of the map."""

    judged: float
    solved: Array
    stated: Array
    map_repeats: Array


def shares_of(seen: Detections, spacing: Array, model: ErrorModel) -> Shares:
    """How often errors are counted; ``spacing`` (T,) metres between frames."""
    between = spacing[seen.frame]
    asked = seen.chain >= 0
    repeats = np.clip(model.element_length_m / between, 1.0, _MOST_REPEATS)
    of_asked = np.minimum(2.0 * repeats, _MOST_REPEATS)
    persist = np.where(asked, model.asked_persist_m, model.map_persist_m)
    return Shares(
        judged=model.element_share + _FIELD_DOUBT * model.place_share,
        solved=model.element_share * np.where(asked, of_asked, 1.0),
        stated=model.element_share * np.where(asked, of_asked, np.maximum(_FADING * repeats, 1.0)),
        map_repeats=np.clip(persist / between, 1.0, _MOST_REPEATS),
    )


def _system(
    field: PlaceField, weight: Array, noise: Noise, motion: Motion, pose: Array, bias: Array
) -> tuple[BlockSystem, Array, Array]:
    """The factored system of map residuals, field and motion; information (T, 3, 3) and χ² (T,)
    of the map residuals alone."""
    system = BlockSystem(field.sizes)
    information, chi2 = field.add(system, weight, noise.shared)
    terms = motion_terms(motion, pose, bias)
    system.add_chain(field.frame_index, terms.own, terms.below, terms.gradient)
    system.factor()
    return system, information, chi2


def chunks(step: Array, length_m: float) -> Index:
    """(T,) chunk of each frame: ``length_m`` of travel, or many frames of a vehicle that waits."""
    out = np.zeros(len(step), np.int64)
    travelled, count = 0.0, 0
    for t in range(1, len(step)):
        travelled += step[t]
        count += 1
        out[t] = out[t - 1]
        if travelled > length_m or count >= _CHUNK_FRAMES:
            out[t] += 1
            travelled, count = 0.0, 0
    return out


def _pose_blocks(system: BlockSystem, chunk: Index, index: Index) -> Array:
    """(T, 3, 3) marginal covariances of the poses."""
    blocks = system.marginals()
    out = np.empty((len(chunk), 3, 3))
    for t, b in enumerate(chunk):
        k = index[t] - system.offset[b]
        out[t] = blocks[b][k : k + 3, k : k + 3]
    return out


def first_poses(motion: Motion, single: Solution, first: Array | None) -> tuple[Array, Array]:
    """Poses and biases from GNSS, odometry and single-frame answers, with robust weights.

    A frame that fell for the next lane disagrees with its neighbours and loses its vote.
    """
    frames = len(motion.gnss)
    pose, bias = (motion.gnss if first is None else first).copy(), np.zeros((frames, 3))
    pose[:, 2] = np.unwrap(pose[:, 2])
    information = np.linalg.inv(single.covariance)
    information[single.residuals == 0] = 0.0
    trust = np.ones(frames)
    for _ in range(_START_ROUNDS):
        terms = motion_terms(motion, pose, bias)
        d = pose - single.pose
        d[:, 2] = wrap_angle(d[:, 2])
        share = _START_SHARE * trust
        pull = (information @ d[..., None])[..., 0]
        terms.add(share[:, None, None] * information, share[:, None] * pull)
        step = terms.solve()
        pose, bias = pose + step[:, :3], bias + step[:, 3:]
        d = pose - single.pose
        d[:, 2] = wrap_angle(d[:, 2])
        # Cauchy weights: a frame six sigmas (three degrees of freedom) off has half a vote.
        trust = 1.0 / (1.0 + np.einsum("ti,tij,tj->t", d, information, d) / 6.0)
    return pose, bias
