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
UPRIGHT = ("z_m", "roll_deg", "pitch_deg")
"""What a planar pose does not have."""
REGIONS = (0.5, 0.9)
"""Shares of the confidence regions that are checked."""
LEVEL = 0.95
"""Share of honest runs whose mean χ² lies in the interval that is told."""


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


def upright_errors(true: Array, estimated: Array) -> Array:
    """(n, 3) absolute z (m), roll and pitch (degrees) errors of (n, 4, 4) poses.

    z is the third part of R_trueᵀ (t_est - t_true); roll and pitch are the Z-Y-X angles of
    R_trueᵀ R_est. A column is NaN where one of the two sides does not have it: poses without
    heights have z 0 (or NaN) throughout, level ones stand upright throughout.
    """
    shift = estimated[:, :3, 3] - true[:, :3, 3]
    z = np.einsum("nj,nj->n", true[:, :3, 2], shift)
    turn = np.einsum("nji,njk->nik", true[:, :3, :3], estimated[:, :3, :3])
    roll = np.arctan2(turn[:, 2, 1], turn[:, 2, 2])
    pitch = -np.arcsin(np.clip(turn[:, 2, 0], -1.0, 1.0))
    out = np.abs(np.column_stack([z, np.degrees(roll), np.degrees(pitch)]))
    heights, tilts = zip(*(_upright(pose) for pose in (true, estimated)), strict=True)
    out[:, 0] = out[:, 0] if all(heights) else np.nan
    out[:, 1:] = out[:, 1:] if all(tilts) else np.nan
    return out


def _upright(pose: Array) -> tuple[bool, bool]:
    """Whether poses (n, 4, 4) have heights, and roll and pitch."""
    z = pose[:, 2, 3]
    heights = bool(np.isfinite(z).all() and (np.abs(z) > 1e-9).any())
    return heights, bool((np.abs(pose[:, 2, :2]) > 1e-9).any())


def summarize(errors: Array, axes: Sequence[str] = AXES) -> dict[str, Any]:
    """Mean and 90th percentile (linear between order statistics) of ``pose_errors``.

    Other columns are named by ``axes``; a column that is NaN, since there is nothing to compare,
    is left out.
    """
    out: dict[str, Any] = {"n": len(errors)}
    for k, name in enumerate(axes):
        values = errors[:, k]
        if np.isnan(values).any():
            continue
        mean = float(values.mean()) if len(values) else None
        p90 = float(np.percentile(values, 90)) if len(values) else None
        out[name] = {"mean": mean, "p90": p90}
    return out


def stated(covariance: Array) -> NDArray[np.intp]:
    """Rows of (n, k, k) covariances that are finite and positive definite."""
    usable = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    return usable[np.linalg.eigvalsh(covariance[usable]).min(axis=1) > 0]


def planar_residuals(true: Array, estimated: Array) -> Array:
    """(n, 3) estimated minus true x, y (map axes, m) and yaw (rad) of (n, 4, 4) poses."""
    turn = wrap_angle(yaw_of(estimated) - yaw_of(true))
    return np.column_stack([estimated[:, :2, 3] - true[:, :2, 3], turn])


def chi_squares(true: Array, estimated: Array, covariance: Array) -> dict[str, Array]:
    """Squared errors over their stated variances, (n,) each, NaN where no covariance is stated.

    ``covariance`` (n, 3, 3) of x, y (map axes, m) and yaw (rad). ``all`` is the χ² of x, y and yaw
    together (3 degrees of freedom); longitudinal, lateral and yaw have one each.
    """
    usable = stated(covariance)
    r, square = planar_residuals(true, estimated)[usable], covariance[usable]
    yaw = yaw_of(true[usable])
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    directions = {
        "longitudinal": np.column_stack([c, s, zero]),
        "lateral": np.column_stack([-s, c, zero]),
        "yaw": np.column_stack([zero, zero, zero + 1]),
    }
    found = {"all": (_whiten(r, square) ** 2).sum(axis=1)}
    for name, d in directions.items():
        found[name] = (d * r).sum(axis=1) ** 2 / np.einsum("ni,nij,nj->n", d, square, d)
    out = {name: np.full(len(true), np.nan) for name in found}
    for name, values in found.items():
        out[name][usable] = values
    return out


def whitened_errors(true: Array, estimated: Array, covariance: Array) -> Array:
    """(n, 3) residuals L⁻¹ r with the covariance L Lᵀ: honest ones have mean 0 and variance 1.

    NaN where no covariance is stated.
    """
    usable = stated(covariance)
    out = np.full((len(true), 3), np.nan)
    out[usable] = _whiten(planar_residuals(true, estimated)[usable], covariance[usable])
    return out


def _whiten(residual: Array, covariance: Array) -> Array:
    root = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.solve(root, residual[..., None])[..., 0])


def effective_count(whitened: Array) -> float:
    """How many independent frames the χ² of the frames (n, 3) of one drive are worth.

    n / (1 + 2 Σ (1 - k/n) r_k), r_k the correlation of the χ² at a lag of k frames. The squares of
    Gaussian errors correlate by the square of the errors' own correlation, which is taken around
    zero (the mean of honest errors), axis by axis up to the first lag at which it is not positive.
    Errors that stay for a whole drive make it one frame.
    """
    n = len(whitened)
    power = (whitened**2).sum(axis=0)
    if n < 2 or not power.all():
        return float(n)
    # All lags at once: the transform, padded so that the end does not meet the beginning.
    spectrum = np.abs(np.fft.rfft(whitened, 2 * n, axis=0)) ** 2
    left = n - np.arange(1, n)[:, None]
    rho = np.clip(np.fft.irfft(spectrum, 2 * n, axis=0)[1:n] / power * n / left, -1.0, 1.0)
    rho = np.where(np.logical_and.accumulate(rho > 0), rho, 0.0)
    alike = (rho**2 * power**2).sum(axis=1) / (power**2).sum()
    return float(max(1.0, n / (1.0 + 2.0 * (left[:, 0] / n * alike).sum())))


def mean_interval(count: float, degrees: int, level: float = LEVEL) -> list[float]:
    """Where the mean of ``count`` honest χ² over their degrees of freedom lies in a share
    ``level`` of all cases: quantiles of χ² with count · degrees degrees, over these."""
    from scipy.stats import chi2

    total = count * degrees
    return [float(chi2.ppf(p, total) / total) for p in ((1 - level) / 2, (1 + level) / 2)]


@dataclass(frozen=True)
class PoseScore:
    """Errors of the frames of one or more drives.

    ``errors`` (n, 3) as in ``pose_errors``, of the initial pose where there is no answer;
    ``status`` (n,) ok, degenerate or no-match; ``squares`` as in ``chi_squares``, ``whitened`` as
    in ``whitened_errors``, ``upright`` as in ``upright_errors``. ``drives``: how many of the frames
    belong to each drive, in order (empty: all to one).
    """

    errors: Array
    status: NDArray[Any]
    squares: dict[str, Array]
    whitened: Array
    upright: Array
    drives: tuple[int, ...] = ()

    @property
    def answered(self) -> NDArray[np.bool_]:
        """(n,) frames with a pose of their own."""
        return np.asarray(self.status != "no-match", dtype=bool)

    def consistency(self) -> dict[str, Any] | None:
        """How often the truth lies inside the stated regions; None where nothing is stated.

        ``inside`` maps a region ("50", "90") to the share of answered frames inside it: an honest
        covariance gives 0.5 and 0.9. ``nees`` is the mean χ² over its 3 degrees of freedom: 1 when
        honest, larger when the covariance is too small. ``nees_interval`` tells where honest runs
        would lie, were frames independent and with as many frames as they are worth; the
        ``verdict`` goes by the latter.
        """
        from scipy.stats import chi2

        known = self.answered & np.isfinite(self.squares["all"])
        if not known.any():
            return None
        inside = {
            f"{region * 100:g}": {
                name: float((q[known] <= chi2.ppf(region, 3 if name == "all" else 1)).mean())
                for name, q in self.squares.items()
            }
            for region in REGIONS
        }
        nees = float(self.squares["all"][known].mean() / 3)
        n, worth = int(known.sum()), self._worth(known)
        low, high = alike = mean_interval(worth, 3)
        interval = {
            "level": LEVEL,
            "independent": mean_interval(n, 3),
            "n_effective": worth,
            "correlated": alike,
        }
        verdict = "overconfident" if nees > high else "underconfident"
        return {
            "n": n,
            "inside": inside,
            "nees": nees,
            "nees_interval": interval,
            "verdict": "consistent" if low <= nees <= high else verdict,
        }

    def _worth(self, known: NDArray[np.bool_]) -> float:
        ends = np.cumsum(self.drives or (len(self.errors),))
        parts = zip(np.split(self.whitened, ends[:-1]), np.split(known, ends[:-1]), strict=True)
        return sum(effective_count(w[k]) for w, k in parts)

    def as_json(self) -> dict[str, Any]:
        """``summarize`` over the answered frames, their share, and all frames together."""
        counts = {s: int((self.status == s).sum()) for s in dict.fromkeys(self.status.tolist())}
        upright = summarize(self.upright[self.answered], UPRIGHT)
        return (
            upright
            | summarize(self.errors[self.answered])
            | {
                "frames": len(self.errors),
                "share_answered": float(self.answered.mean()) if len(self.errors) else None,
                "status": counts,
                "all_frames": summarize(self.errors),
                "consistency": self.consistency(),
            }
        )


def pool_poses(scores: Sequence[PoseScore]) -> PoseScore:
    """The frames of several drives together."""
    return PoseScore(
        np.concatenate([s.errors for s in scores]),
        np.concatenate([s.status for s in scores]),
        {k: np.concatenate([s.squares[k] for s in scores]) for k in scores[0].squares},
        np.concatenate([s.whitened for s in scores]),
        np.concatenate([s.upright for s in scores]),
        tuple(n for s in scores for n in (s.drives or (len(s.errors),))),
    )
