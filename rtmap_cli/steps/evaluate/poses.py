"""Errors of estimated poses, and whether their covariances are honest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import invert, wrap_angle, yaw_of

Array = NDArray[np.float64]

AXES = ("longitudinal_m", "lateral_m", "yaw_deg")
REGIONS = (0.5, 0.9)
"""Shares of the confidence regions that are checked."""


def pose_errors(true: Array, estimated: Array) -> Array:
    """(n, 3) absolute longitudinal (m), lateral (m) and yaw (degrees) errors.

    ``true`` and ``estimated`` are (n, 4, 4) map_SE3_ego. The error is taken in the true vehicle's
    own frame: e = R_trueᵀ (t_est - t_true), longitudinal |e_x|, lateral |e_y|; the yaw error is
    the Z-Y-X yaw of R_trueᵀ R_est.
    """
    delta = invert(true) @ estimated
    # The translation is differenced first: map coordinates of 4e6 m would cost digits.
    shift = estimated[:, :3, 3] - true[:, :3, 3]
    e = np.einsum("nji,nj->ni", true[:, :3, :3], shift)
    yaw = np.abs(np.degrees(yaw_of(delta)))
    return np.column_stack([np.abs(e[:, 0]), np.abs(e[:, 1]), yaw])


def summarize(errors: Array) -> dict[str, Any]:
    """Mean and 90th percentile (linear between order statistics) of ``pose_errors``."""
    out: dict[str, Any] = {"n": len(errors)}
    for k, name in enumerate(AXES):
        values = errors[:, k]
        mean = float(values.mean()) if len(values) else None
        p90 = float(np.percentile(values, 90)) if len(values) else None
        out[name] = {"mean": mean, "p90": p90}
    return out


def chi_squares(true: Array, estimated: Array, covariance: Array) -> dict[str, Array]:
    """Squared errors over their stated variances, (n,) each, NaN where no covariance is stated.

    ``covariance`` (n, 3, 3) of x, y (map axes, m) and yaw (rad). ``all`` is the χ² of x, y and yaw
    together (3 degrees of freedom); longitudinal, lateral and yaw have one each.
    """
    n = len(true)
    usable = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    usable = usable[np.linalg.eigvalsh(covariance[usable]).min(axis=1) > 0]
    true, estimated, covariance = true[usable], estimated[usable], covariance[usable]
    yaw = yaw_of(true)
    r = np.column_stack([estimated[:, :2, 3] - true[:, :2, 3], wrap_angle(yaw_of(estimated) - yaw)])
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    directions = {
        "longitudinal": np.column_stack([c, s, zero]),
        "lateral": np.column_stack([-s, c, zero]),
        "yaw": np.column_stack([zero, zero, zero + 1]),
    }
    found = {"all": np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance), r)}
    for name, d in directions.items():
        found[name] = (d * r).sum(axis=1) ** 2 / np.einsum("ni,nij,nj->n", d, covariance, d)
    out = {name: np.full(n, np.nan) for name in found}
    for name, values in found.items():
        out[name][usable] = values
    return out


@dataclass(frozen=True)
class PoseScore:
    """Errors of the frames of one or more drives.

    ``errors`` (n, 3) as in ``pose_errors``, of the initial pose where there is no answer;
    ``status`` (n,) ok, degenerate or no-match; ``squares`` as in ``chi_squares``.
    """

    errors: Array
    status: NDArray[Any]
    squares: dict[str, Array]

    @property
    def answered(self) -> NDArray[np.bool_]:
        """(n,) frames with a pose of their own."""
        return np.asarray(self.status != "no-match", dtype=bool)

    def consistency(self) -> dict[str, Any] | None:
        """How often the truth lies inside the stated regions; None where nothing is stated.

        ``inside`` maps a region ("50", "90") to the share of answered frames inside it: an honest
        covariance gives 0.5 and 0.9. ``nees`` is the mean χ² over its 3 degrees of freedom: 1 when
        honest, larger when the covariance is too small.
        """
        from scipy.stats import chi2

        stated = self.answered & np.isfinite(self.squares["all"])
        if not stated.any():
            return None
        inside = {
            f"{region * 100:g}": {
                name: float((q[stated] <= chi2.ppf(region, 3 if name == "all" else 1)).mean())
                for name, q in self.squares.items()
            }
            for region in REGIONS
        }
        nees = float(self.squares["all"][stated].mean() / 3)
        return {"n": int(stated.sum()), "inside": inside, "nees": nees}

    def as_json(self) -> dict[str, Any]:
        """``summarize`` over the answered frames, their share, and all frames together."""
        counts = {s: int((self.status == s).sum()) for s in dict.fromkeys(self.status.tolist())}
        return summarize(self.errors[self.answered]) | {
            "frames": len(self.errors),
            "share_answered": float(self.answered.mean()) if len(self.errors) else None,
            "status": counts,
            "all_frames": summarize(self.errors),
            "consistency": self.consistency(),
        }


def pool_poses(scores: Sequence[PoseScore]) -> PoseScore:
    """The frames of several drives together."""
    return PoseScore(
        np.concatenate([s.errors for s in scores]),
        np.concatenate([s.status for s in scores]),
        {k: np.concatenate([s.squares[k] for s in scores]) for k in scores[0].squares},
    )
