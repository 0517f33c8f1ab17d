"""Existence as log-odds: how often something was found where it was in view, drive by drive.

A drive gives one vote. Of ``views`` frames that could see a place, ``hits`` (fractional: a
detection counts with the probability that it is real) found something. Frames of a drive are
correlated, therefore the hit *rate* of a drive is a random quantity of its own (a beta-binomial
model) and the votes of a drive saturate: a hundred frames say little more than ten.

Two models are compared:

* *exists*: most places are found at the usual rate of the class; a share of them is hard to see
  (worn paint), in every drive alike;
* *absent*: now and then a false detection; a share of the drives carries a ghost that stays in
  place for that drive only.

So one silent drive says less than two, and a ghost loses against the drives that do not see it.

A network that is given the map (a *prompted* place) finds what is there nearly always, and is
easier to deceive where nothing is: such votes have rates of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Int = NDArray[np.int64]

LIMIT = 12.0
"""Log-odds are kept within ± this: no map is so sure that it cannot learn."""
PRIOR_LOG_ODDS = 2.5
"""Log-odds of an element of a prior map that states none (12 of 13 are there)."""


@dataclass(frozen=True)
class Prompted:
    """What of a ``VoteModel`` differs where the network was asked about an element of the map; the
    parameters are those of that model."""

    found: float = 0.9
    strength: float = 8.0
    hard_rate: float = 0.8
    false_rate: float = 0.15
    false_strength: float = 3.0


@dataclass(frozen=True)
class VoteModel:
    """Parameters of the two models; all shares and rates are probabilities.

    ``found``: usual hit rate per view; ``hard``: share of places that are hard to see, found at
    ``hard_rate`` × found; ``false_rate``: hits per view where nothing is, ``picked_rate``: the
    same at places that were picked because something was found there (``spill``: share of these
    at which that is so in all drives); ``ghost``: share of the
    drives in which a false detection stays in place, seen at ``ghost_rate`` × found;
    ``strength``: how alike the frames of a drive are (beta-binomial pseudo-count, lower = more
    alike), ``false_strength`` the same of false detections, which clump; ``most_views``: frames
    beyond which a drive's vote does not grow. ``prompted``: what differs at places that the
    network was asked about.
    """

    found: float = 0.6
    hard: float = 0.05
    hard_rate: float = 0.35
    false_rate: float = 0.02
    picked_rate: float = 0.06
    spill: float = 0.2
    ghost: float = 0.05
    ghost_rate: float = 0.4
    strength: float = 8.0
    false_strength: float = 4.0
    most_views: float = 24.0
    prompted: Prompted = Prompted()

    @property
    def of_prompted(self) -> VoteModel:
        """The model of places that the network was asked about."""
        return replace(self, **vars(self.prompted))


def _log_beta_binomial(hits: Array, misses: Array, rate: Array | float, strength: float) -> Array:
    """log of B(a + hits, b + misses) / B(a, b); fractional counts are allowed."""
    from scipy.special import betaln

    a, b = rate * strength, (1 - rate) * strength
    out: Array = betaln(a + hits, b + misses) - betaln(a, b)
    return out


def drive_log_likelihoods(
    hits: Array,
    views: Array,
    model: VoteModel,
    picked: NDArray[np.bool_] | bool = False,
    prompted: NDArray[np.bool_] | None = None,
) -> Array:
    """(3, ...) log-likelihoods of one drive's counts: exists and easy, exists and hard, absent.

    ``picked`` marks places that are there because something was found, ``prompted`` those that the
    network was asked about. Without a view all three are 0: never looked is no evidence.
    """
    if prompted is not None and prompted.any():
        out = drive_log_likelihoods(hits, views, model, picked)
        own = hits[prompted], views[prompted]
        out[:, prompted] = drive_log_likelihoods(*own, model.of_prompted)
        return out
    views = np.maximum(views, 0.0)
    rate = np.clip(np.where(views > 0, hits / np.maximum(views, 1e-9), 0.0), 0.0, 1.0)
    n = np.minimum(views, model.most_views)
    h = rate * n
    m = n - h
    s = model.strength
    easy = _log_beta_binomial(h, m, model.found, s)
    hard = _log_beta_binomial(h, m, model.hard_rate * model.found, s)
    rate_if_absent = np.where(picked, model.picked_rate, model.false_rate)
    false = _log_beta_binomial(h, m, rate_if_absent, model.false_strength)
    ghost = _log_beta_binomial(h, m, model.ghost_rate * model.found, model.false_strength)
    absent = np.logaddexp(np.log1p(-model.ghost) + false, np.log(model.ghost) + ghost)
    return np.stack([easy, hard, absent])


def joint_log_likelihoods(
    hits: Array,
    views: Array,
    model: VoteModel,
    picked: NDArray[np.bool_],
    prompted: NDArray[np.bool_] | None = None,
) -> Array:
    """(3, n) log-likelihoods of the counts (drives, n) of all drives, as ``drive_log_likelihoods``.

    A place with nothing at it was ``picked`` (n,) because of what *one* of the drives, nobody knows
    which, falsely found there, and the others have no more false detections there than elsewhere;
    or, at a share ``spill`` of the places, because all drives find false things there, which are
    detections of something beside it.
    """
    each = drive_log_likelihoods(hits, views, model, prompted=prompted)
    out: Array = each.sum(axis=1)
    looked = views[:, picked] > 0
    if looked.any():
        chosen = drive_log_likelihoods(hits[:, picked], views[:, picked], model, picked=True)
        gain = np.where(looked, chosen[2] - each[2][:, picked], -np.inf)
        some = looked.any(axis=0)
        one = _log_sum_exp(gain[:, some]) - np.log(looked[:, some].sum(axis=0))
        every = np.where(looked, gain, 0.0)[:, some].sum(axis=0)
        out[2, np.flatnonzero(picked)[some]] += np.logaddexp(
            np.log1p(-model.spill) + one, np.log(model.spill) + every
        )
    return out


def remembered(seen: Array, in_view: Array, drives: Array, model: VoteModel) -> Array:
    """(3, n) log-likelihoods to be added to those of further drives: what ``drives`` (n,) that
    are in the map already, which found a place in ``seen`` of ``in_view`` frames, say about how
    hard it is to see. What they said about its existence is in its log-odds.

    A mixture over the product of all drives needs their posterior share of hard places. It is not
    below that of ``model``: an element that is easy to see as a whole may have parts that are not.
    """
    out = np.zeros((3, len(seen)))
    some = (drives > 0) & (in_view > 0)
    if not some.any():
        return out
    n = drives[some]
    easy, hard, _ = n * drive_log_likelihoods(seen[some] / n, in_view[some] / n, model)
    odds = np.clip(np.log(model.hard) - np.log1p(-model.hard) + hard - easy, None, LIMIT)
    share = np.maximum(probability(odds), model.hard)
    out[0, some] = np.log1p(-share) - np.log1p(-model.hard)
    out[1, some] = np.log(share) - np.log(model.hard)
    return out


def log_odds_of(votes: Array, model: VoteModel) -> Array:
    """Log-likelihood ratio exists : absent of summed (3, ...) log-likelihoods of many drives.

    Whether a place is hard to see is the same in all drives, therefore the mixture is taken over
    the product of the drives and not drive by drive.
    """
    easy, hard, absent = votes
    exists = np.logaddexp(np.log1p(-model.hard) + easy, np.log(model.hard) + hard)
    out: Array = exists - absent
    return out


def probability(log_odds: Array | float) -> Array:
    """The probability of log-odds."""
    return 1.0 / (1.0 + np.exp(-np.clip(np.asarray(log_odds, np.float64), -50, 50)))


def logit(probability_: Array | float, limit: float = LIMIT) -> Array:
    """The log-odds of a probability, within ± ``limit``."""
    p = np.clip(np.asarray(probability_, np.float64), 1e-9, 1 - 1e-9)
    return np.clip(np.log(p) - np.log1p(-p), -limit, limit)


def fitted(hits: Array, views: Array, model: VoteModel, weight: Array | None = None) -> VoteModel:
    """The model whose usual rate, likeness of frames and share of hard places fit best.

    ``hits``, ``views`` (drives, n) at places of the map, most of which exist; ``weight`` (n,) how
    many independent places each of them is. Maximum of Σ weight · log p(counts of a place), each
    place being easy, hard or absent, over a grid; ``model`` itself counts as ``PSEUDO`` places of
    its own rates, so that little data changes little.
    """
    w = np.ones(hits.shape[1]) if weight is None else weight
    ok = (views >= 1).any(axis=0)
    hits, views, w = hits[:, ok], views[:, ok], w[ok]
    if not ok.any():
        return model
    trials = [(f, s) for f in FOUND_GRID for s in STRENGTH_GRID]
    best, top = model, -np.inf
    for found, strength in trials:
        trial = replace(model, found=found, strength=strength)
        votes = sum(drive_log_likelihoods(h, v, trial) for h, v in zip(hits, views, strict=True))
        for hard in HARD_GRID:
            shares = np.log([(1 - ABSENT) * (1 - hard), (1 - ABSENT) * hard, ABSENT])
            total = float((w * _log_sum_exp(votes + shares[:, None])).sum())
            total -= PSEUDO * _divergence(model, found, strength, hard)
            if total > top:
                best, top = replace(trial, hard=hard), total
    return best


FOUND_GRID = tuple(np.linspace(0.25, 0.95, 15))
STRENGTH_GRID = (4.0, 8.0, 16.0)
HARD_GRID = (0.02, 0.05, 0.1, 0.2)
ABSENT = 0.08
"""Share of the places of a map that exist no more, as ``PRIOR_LOG_ODDS`` says."""
PSEUDO = 4.0


def _log_sum_exp(values: Array) -> Array:
    top = values.max(axis=0)
    out: Array = top + np.log(np.exp(values - top).sum(axis=0))
    return out


def _divergence(model: VoteModel, found: float, strength: float, hard: float) -> float:
    """What a trial is away from the model: squared differences of logit, log and log."""
    rate = float(logit(found) - logit(model.found))
    return (
        rate**2
        + float(np.log(strength / model.strength)) ** 2 / 4
        + float(np.log(hard / model.hard)) ** 2 / 4
    ) / 2


def stretches(
    evidence: Array, weight: Array, prior: float, switch: float, ring: bool
) -> NDArray[np.bool_]:
    """Which stations of a line exist: the best two-state sequence along it (Viterbi).

    ``evidence`` (n,) log-likelihood ratio of each station, ``weight`` (n,) the share of a vote
    that the station carries (spacing / correlation length), ``prior`` log-odds of the line,
    ``switch`` the cost of a change of state. Returns (n,) True where it exists. On a ring the
    sequence runs around twice, so that its start has no special place.
    """
    n = len(evidence)
    gain = (evidence + prior) * weight
    if ring:
        gain = np.concatenate([gain, gain])
    score = np.array([0.0, 0.0])
    back = np.zeros((len(gain), 2), np.int8)
    for k, g in enumerate(gain):
        stay, change = score, score[::-1] - switch
        back[k] = np.where(stay >= change, [0, 1], [1, 0])
        score = np.maximum(stay, change) + np.array([-g / 2, g / 2])
    state = int(score[1] >= score[0])
    out = np.zeros(len(gain), bool)
    for k in range(len(gain) - 1, -1, -1):
        out[k] = bool(state)
        state = int(back[k, state])
    if ring:
        half = n // 2
        middle = out[half : half + n]
        out = np.roll(middle, half)
    return out[:n]


def runs_of(flags: NDArray[np.bool_], ring: bool = False) -> list[Int]:
    """Index runs in which ``flags`` is True; on a ring the last run continues with the first."""
    index = np.flatnonzero(flags)
    if not len(index):
        return []
    parts = np.split(index, np.flatnonzero(np.diff(index) > 1) + 1)
    if ring and len(parts) > 1 and flags[0] and flags[-1]:
        parts[0] = np.concatenate([parts.pop(), parts[0]])
    return [np.asarray(p, np.int64) for p in parts]
