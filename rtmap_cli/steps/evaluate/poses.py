"""Errors of estimated poses, and whether their covariances are honest."""

from __future__ import annotations

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


@dataclass(frozen=True)
class Consistency:
    """How often the truth lies inside the stated regions.

    ``inside`` maps a region ("50", "90") to the share of frames inside it, for x, y and yaw
    together (χ² of 3) and for each axis of the vehicle alone; an honest covariance gives 0.5 and
    0.9. ``nees`` is the mean χ² over its 3 degrees of freedom: 1 when honest, larger when the
    covariance is too small.
    """

    n: int
    inside: dict[str, dict[str, float]]
    nees: float

    def as_json(self) -> dict[str, Any]:
        """For reports."""
        return {"n": self.n, "inside": self.inside, "nees": self.nees}


def consistency(true: Array, estimated: Array, covariance: Array) -> Consistency | None:
    """χ² consistency of planar poses; ``covariance`` (n, 3, 3) of x, y (map axes, m) and yaw (rad).

    Frames whose covariance is not finite and positive definite are left out; None if none is left.
    """
    from scipy.stats import chi2

    usable = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    usable = usable[np.linalg.eigvalsh(covariance[usable]).min(axis=1) > 0]
    if not len(usable):
        return None
    true, estimated, covariance = true[usable], estimated[usable], covariance[usable]
    r = np.column_stack(
        [
            estimated[:, :2, 3] - true[:, :2, 3],
            wrap_angle(yaw_of(estimated) - yaw_of(true)),
        ]
    )
    squares = {"all": np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance), r)}
    c, s = np.cos(yaw_of(true)), np.sin(yaw_of(true))
    zero = np.zeros_like(c)
    directions = {
        "longitudinal": np.column_stack([c, s, zero]),
        "lateral": np.column_stack([-s, c, zero]),
        "yaw": np.column_stack([zero, zero, zero + 1]),
    }
    for name, d in directions.items():
        variance = np.einsum("ni,nij,nj->n", d, covariance, d)
        squares[name] = (d * r).sum(axis=1) ** 2 / variance
    inside = {
        f"{region * 100:g}": {
            name: float((q <= chi2.ppf(region, 3 if name == "all" else 1)).mean())
            for name, q in squares.items()
        }
        for region in REGIONS
    }
    return Consistency(len(r), inside, float(squares["all"].mean() / 3))
