"""Single-frame MAP with associations and weights held, solved to the end.

With the line of every vertex known, its residual is linear in sin δ, cos δ and the shift d from the
poses of linearization (δ the turn from there, p⊥ the vertex turned left by 90 degrees):

    r(d, δ) = r₀ + n · d + (n · R p) (cos δ - 1) + (n · R p⊥) sin δ

so that the vertices enter one Gram of five columns per frame, and Gauss–Newton runs on these.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.geometry.poses import wrap_angle
from rtmap_cli.steps.localize.frames import Detections
from rtmap_cli.steps.localize.residuals import Linear, Noise, woodbury_root

Array = NDArray[np.float64]

# Frames whose vertices stay in the cache together.
_BATCH = 64

_ROUNDS = 30


def solve_held(
    seen: Detections, linear: Linear, at: Array, noise: Noise, done: float = 1e-5
) -> tuple[Array, Array]:
    """Poses (T, 3) and their information (T, 3, 3), GNSS prior included.

    ``linear`` are the residuals at the poses ``at`` (T, 3); ``noise`` their covariance, with
    robust weights multiplied in. Rounds end when no step is longer than ``done`` (m, rad): the
    next one would be about its square.
    """
    q = np.ascontiguousarray(np.moveaxis(_grams(seen, linear, noise), 0, -1))
    prior = seen.sigma.T**-2.0
    from_prior = (at - seen.pose).T
    from_prior[2] = wrap_angle(from_prior[2])
    # GNSS is where the search begins.
    x = -from_prior
    for _ in range(_ROUNDS):
        h, gradient = _normal(q, x)
        h[[0, 1, 2], [0, 1, 2]] += prior
        gradient += prior * (x + from_prior)
        step = _solve3(h, gradient)
        x = x - step
        if np.abs(step).max(initial=0.0) <= done:
            break
    return at + x.T, np.moveaxis(h, -1, 0)


def _grams(seen: Detections, linear: Linear, noise: Noise) -> Array:
    """(T, 5, 5) Grams of the columns n · R p, the Jacobian and r of every frame."""
    out = np.zeros((len(seen), 5, 5))
    rows = np.searchsorted(seen.frame, np.arange(len(seen) + 1))
    for first in range(0, len(seen), _BATCH):
        here = rows[first : first + _BATCH + 1]
        e = slice(here[0], here[-1])
        # Columns first: vertices of a frame then lie side by side, for one product per frame.
        x = np.empty((7, *noise.weight[e].shape))
        turned = linear.normal[e] * seen.points[e]
        np.add(turned[..., 0], turned[..., 1], out=x[0])
        x[1:4] = np.moveaxis(linear.jacobian[e], -1, 0)
        x[4] = linear.r[e]
        x[5:] = np.moveaxis(noise.shared[e], -1, 0)
        y = x * noise.weight[e]
        common = np.moveaxis(y[5:], 0, 1) @ np.moveaxis(x, 0, -1)
        b = (woodbury_root(common[..., 5:])[0] @ common[..., :5]).reshape(-1, 5)
        vertices, weighted = x[:5].reshape(5, -1), y[:5].reshape(5, -1)
        count = x.shape[-1]
        for t, (low, high) in enumerate(pairwise((here - here[0]).tolist()), first):
            v, o = slice(low * count, high * count), b[2 * low : 2 * high]
            out[t] = vertices[:, v] @ weighted[:, v].T - o.T @ o
    return out


def _normal(q: Array, x: Array) -> tuple[Array, Array]:
    """Normal equations (3, 3, T) and gradient (3, T) of Grams (5, 5, T) at (3, T)."""
    c, s = np.cos(x[2]), np.sin(x[2])
    z = np.stack([c - 1.0, x[0], x[1], s, np.ones_like(c)])
    v = (q[:4] * z).sum(1)
    gradient = np.stack([v[1], v[2], c * v[3] - s * v[0]])
    h = np.empty((3, 3, len(c)))
    h[:2, :2] = q[1:3, 1:3]
    h[:2, 2] = h[2, :2] = c * q[1:3, 3] - s * q[1:3, 0]
    h[2, 2] = c * c * q[3, 3] - 2.0 * s * c * q[0, 3] + s * s * q[0, 0]
    return h, gradient


def _solve3(h: Array, b: Array) -> Array:
    """Solve (3, 3, T) symmetric systems for (3, T) by Cholesky, all at once."""
    a = np.sqrt(h[0, 0])
    d, g = h[0, 1] / a, h[0, 2] / a
    e = np.sqrt(h[1, 1] - d * d)
    k = (h[1, 2] - d * g) / e
    m = np.sqrt(h[2, 2] - g * g - k * k)
    u = b[0] / a
    v = (b[1] - d * u) / e
    w = (b[2] - g * u - k * v) / m / m
    v = (v - k * w) / e
    return np.stack([(u - d * v - g * w) / a, v, w])
