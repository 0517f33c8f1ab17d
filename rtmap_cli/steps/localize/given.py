"""A run taken otherwise: with other poses as the prior, or blind to what it says (ablations)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import NoAnswer
from rtmap_cli.geometry.poses import wrap_angle, xyyaw_of
from rtmap_cli.logs.run import MATCHED, OUTDATED, Run
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.localize.answer import lift
from rtmap_cli.steps.localize.frame.single import Solution

Array = NDArray[np.float64]

PRIORS = ("initial", "end-to-end", "both")
"""What the solve leans on: T⁰ with its sigmas, T^E with its covariance, their product."""
STARTS = ("initial", "end-to-end")
"""Where it begins."""


def known_end_to_end(run: Run) -> NDArray[np.bool_]:
    """(T,) frames with a T^E of finite, positive definite covariance; NoAnswer without any."""
    pose, covariance = run.frames.end_to_end, run.frames.end_to_end_covariance
    known = np.asarray(np.isfinite(pose).all(1) & np.isfinite(covariance).all((1, 2)))
    known[known] = np.linalg.eigvalsh(covariance[known])[:, 0] > 0
    if not known.any():
        raise NoAnswer(f"{run.log_id}: the run has no end-to-end poses")
    return known


def start_of(run: Run, origin: Array) -> Array:
    """(T, 3) T^E where it is known, T⁰ elsewhere; x, y relative to ``origin``, yaw."""
    known = known_end_to_end(run)
    pose = np.where(known[:, None], run.frames.end_to_end, xyyaw_of(run.frames.initial))
    pose[:, :2] -= origin
    return pose


@dataclass(frozen=True)
class Rest:
    """What a prior knows beyond the round sigmas that stand in for it: ``information``
    (T, 3, 3) at ``pose`` (T, 3: map x, y, yaw)."""

    pose: Array
    information: Array

    def joined(self, solution: Solution, origin: Array) -> Solution:
        """Single-frame answers with it; linear, since the answers are near."""
        d = solution.pose - self.pose
        d[:, :2] += origin
        d[:, 2] = wrap_angle(d[:, 2])
        every = np.linalg.inv(solution.covariance) + self.information
        covariance: Array = np.linalg.inv(every).astype(np.float64)
        step = (covariance @ self.information @ d[..., None])[..., 0]
        return replace(solution, pose=solution.pose - step, covariance=covariance)


def with_prior(run: Run, prior: str) -> tuple[Run, Rest]:
    """The run with T^E, or the product of T⁰ and T^E, in place of T⁰ where T^E is known.

    A run states one sigma per axis: in x and y the largest that the covariance has in any
    direction. What that gives away comes back as the rest.
    """
    known = known_end_to_end(run)
    frames = run.frames
    pose, sigma = xyyaw_of(frames.initial), frames.sigma.copy()
    information = np.zeros((len(pose), 3, 3))
    information[known] = np.linalg.inv(frames.end_to_end_covariance[known])
    off = np.where(known[:, None], frames.end_to_end - pose, 0.0)
    off[:, 2] = wrap_angle(off[:, 2])
    own = np.zeros_like(information)
    if prior == "both":
        own[:, [0, 1, 2], [0, 1, 2]] = sigma**-2
    every = own[known] + information[known]
    pull = information[known] @ off[known, :, None]
    pose[known] += np.linalg.solve(every, pull)[..., 0]
    covariance = np.linalg.inv(every)
    sigma[known, :2] = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, 1:])
    sigma[known, 2] = np.sqrt(covariance[:, 2, 2])
    # Of correlated x, y and yaw less than the parts may be known in some direction.
    share = np.linalg.eigvalsh(sigma[known, :, None] * every * sigma[known, None])[:, 0]
    sigma[known] /= np.sqrt(np.minimum(share, 1.0))[:, None]
    rest = np.zeros_like(information)
    rest[known] = every - sigma[known, :, None] ** -2 * np.eye(3)
    initial = lift(frames.initial, pose, np.zeros(2))
    run = replace(run, frames=replace(frames, initial=initial, sigma=sigma))
    return run, Rest(pose, rest)


def credulous(run: Run) -> Run:
    """Ablation: nothing is outdated, every answer to a prior query takes part alike."""
    o = run.observations
    state = np.where(o.state == OUTDATED, MATCHED, o.state).astype(o.state.dtype)
    existence = np.where(np.isfinite(o.existence), np.float32(1.0), o.existence)
    return replace(run, observations=replace(o, state=state, existence=existence))


def without_sigma(run: Run, vector_map: VectorMap) -> tuple[Run, VectorMap]:
    """Ablation: every detection has the run's median sigma, and the map states none."""
    o = run.observations
    sigma = np.full_like(o.sigma, np.median(o.sigma) if len(o) else 1.0)
    blind = VectorMap([replace(e, covariance=None) for e in vector_map], vector_map.crs)
    blind = VectorMap(blind.elements, vector_map.crs, vector_map.version)
    return replace(run, observations=replace(o, sigma=sigma)), blind
