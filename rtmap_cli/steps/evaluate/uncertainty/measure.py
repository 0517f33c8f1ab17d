"""Are stated uncertainties honest? Coverage, calibration and likelihood of errors and shares.

An error with a stated spread becomes its *rank* u: the nominal content of the smallest central
region that holds it. Honest ranks are uniform in [0, 1], whatever the spread; the share of ranks
below p is the coverage of the p region, and over all p it is the calibration curve.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

REGIONS = (0.5, 0.9)
"""Regions whose coverage is told by name."""
LEVELS = tuple(round(0.05 * k, 2) for k in range(1, 20)) + (0.99,)
"""Nominal levels of a calibration curve."""
SIGMA_BINS = 10
"""Errors are sorted by stated sigma into so many bins of equal count."""
SHARE_BINS = 10
"""Stated probabilities are sorted into so many bins of equal width."""
LEAST_SHARE = 1e-6
"""Probabilities of 0 and 1 are taken for this far from it where the logarithm is taken."""
Z_95 = 1.959964


def gaussian_ranks(square: Array, degrees: int) -> Array:
    """Ranks of errors with χ² ``square`` (n,) of so many degrees of freedom."""
    from scipy.stats import chi2

    return np.asarray(chi2.cdf(square, degrees), dtype=np.float64)


def laplace_ranks(square: Array) -> Array:
    """Ranks of errors (e/σ)² of a Laplace distribution of standard deviation σ (b = σ/√2):
    P(|x| ≤ |e|) = 1 - exp(-√2 |e|/σ)."""
    return 1.0 - np.exp(-np.sqrt(2.0 * square))


def gaussian_nll(square: Array, log_det: Array, degrees: int) -> float:
    """Mean of ½ (χ² + log det Σ + k log 2π), natural logarithm, in the units of the errors."""
    return float((square + log_det + degrees * np.log(2 * np.pi)).mean() / 2)


def laplace_nll(square: Array, sigma: Array) -> float:
    """Mean of √2 |e|/σ + log(√2 σ), natural logarithm; σ in the unit of the errors."""
    return float((np.sqrt(2 * square) + np.log(np.sqrt(2) * sigma)).mean())


def rank_figures(ranks: Array, group: NDArray[Any], worth: float | None = None) -> dict[str, Any]:
    """Coverage of the 50 % and 90 % regions with 95 % intervals, and the calibration curve.

    ``group`` (n,) names what errs together: an interval sees as many independent pieces as there
    are groups. ``worth`` states the number of independent errors instead. ``calibration_error`` is
    the mean distance of the curve from the diagonal.
    """
    coverage = {f"{p * 100:g}": float((ranks <= p).mean()) for p in REGIONS}
    interval = {f"{p * 100:g}": share_interval(ranks <= p, group, worth) for p in REGIONS}
    curve = [{"nominal": p, "empirical": float((ranks <= p).mean())} for p in LEVELS]
    gap = float(np.mean([abs(c["empirical"] - c["nominal"]) for c in curve]))
    return {
        "coverage": coverage,
        "interval_95": interval,
        "calibration_error": gap,
        "calibration": curve,
    }


def share_interval(
    inside: NDArray[np.bool_], group: NDArray[Any], worth: float | None = None
) -> list[float] | None:
    """95 % interval of a share: p ± 1.96 s with s² = Σ_g (Σ_i (y_i - p))² / n² · G / (G - 1).

    The members of a group count as one piece of evidence (cluster-robust); with ``worth`` s² is
    p (1 - p) / worth. None for a single group.
    """
    share, n = float(inside.mean()), len(inside)
    if worth is None:
        _, index = np.unique(group, return_inverse=True)
        sums = np.bincount(index, inside - share)
        if len(sums) < 2:
            return None
        spread = np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)) / n
    else:
        spread = np.sqrt(share * (1 - share) / worth)
    low, high = np.clip([share - Z_95 * spread, share + Z_95 * spread], 0.0, 1.0).tolist()
    return [low, high]


def line_figures(
    error: Array, sigma: Array, group: NDArray[Any], laplace: bool = False
) -> dict[str, Any]:
    """Everything about errors (n,) of one dimension with stated standard deviations (n,).

    ``gaussian`` (and ``laplace``: the same sigmas read as those of a Laplace distribution) as in
    ``rank_figures`` with ``nll``. ``scale``: by what the sigmas would have to be multiplied so
    that the root mean square (``rms``) or the median of |e|/σ is that of a Gaussian.
    """
    if not len(error):
        return {"n": 0}
    square, variance = (error / sigma) ** 2, sigma**2
    out: dict[str, Any] = {
        "n": len(error),
        "groups": len(np.unique(group)),
        "error_m": {"rms": _rms(error), "median": float(np.median(np.abs(error)))},
        "sigma_m": {"rms": _rms(sigma), "median": float(np.median(sigma))},
        "scale": {
            "rms": float(np.sqrt(square.mean())),
            "median": float(np.sqrt(np.median(square)) / 0.6744898),
        },
        "gaussian": {"nll": gaussian_nll(square, np.log(variance), 1)}
        | rank_figures(gaussian_ranks(square, 1), group),
    }
    if laplace:
        figures = rank_figures(laplace_ranks(square), group)
        out["laplace"] = {"nll": laplace_nll(square, sigma)} | figures
    out["by_sigma"] = [
        {"n": len(k), "sigma_m": _rms(sigma[k]), "rms_error_m": _rms(error[k])}
        for k in np.array_split(np.argsort(sigma, kind="stable"), SIGMA_BINS)
        if len(k)
    ]
    return out


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


def share_figures(stated: Array, true: NDArray[np.bool_]) -> dict[str, Any]:
    """Whether probabilities (n,) are honest, given what happened (n,).

    ``bins`` of equal width (a probability on an edge counts in the upper bin, 1 in the last) with
    their mean stated probability and true share; ``ece`` = Σ n_b/n |stated_b - true_b|; ``brier``
    the mean square error, beside that of always stating the base rate; ``nll`` the mean of
    -log p(what happened), probabilities kept 10⁻⁶ away from 0 and 1.
    """
    n = len(stated)
    if not n:
        return {"n": 0}
    index = np.minimum((stated * SHARE_BINS).astype(int), SHARE_BINS - 1)
    bins: list[dict[str, Any]] = []
    gap = 0.0
    for k in range(SHARE_BINS):
        chosen = index == k
        told: dict[str, Any] = {"stated": None, "true": None}
        if chosen.any():
            told = {"stated": float(stated[chosen].mean()), "true": float(true[chosen].mean())}
            gap += float(chosen.mean()) * abs(told["stated"] - told["true"])
        edges = {"low": k / SHARE_BINS, "high": (k + 1) / SHARE_BINS}
        bins.append(edges | {"n": int(chosen.sum())} | told)
    base = float(true.mean())
    kept = np.clip(stated, LEAST_SHARE, 1 - LEAST_SHARE)
    return {
        "n": n,
        "base_rate": base,
        "mean_stated": float(stated.mean()),
        "ece": gap,
        "brier": float(((stated - true) ** 2).mean()),
        "brier_of_base_rate": base * (1 - base),
        "nll": float(-np.log(np.where(true, kept, 1 - kept)).mean()),
        "bins": bins,
    }
