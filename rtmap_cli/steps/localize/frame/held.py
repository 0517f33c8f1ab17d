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
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.residuals import Linear, Noise, woodbury_root

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
    # Cholesky factors of what x and y know of each other, which is the same at all turns.
    xx, xy, yy = q[1, 1] + prior[0], q[1, 2], q[2, 2] + prior[1]
    a = np.sqrt(xx)
    d = xy / a
    e = np.sqrt(yy - d * d)
    z = np.ones((5, len(at)))
    for _ in range(_ROUNDS):
        c, s = np.cos(x[2]), np.sin(x[2])
        z[0], z[1:3], z[3] = c - 1.0, x[:2], s
        v = (q[:4] * z).sum(1)
        pull = prior * (x + from_prior)
        xt, yt = c * q[1:3, 3] - s * q[1:3, 0]
        tt = c * c * q[3, 3] - 2.0 * s * c * q[0, 3] + s * s * q[0, 0] + prior[2]
        g = xt / a
        k = (yt - d * g) / e
        first = (v[1] + pull[0]) / a
        second = (v[2] + pull[1] - d * first) / e
        turn = c * v[3] - s * v[0] + pull[2] - g * first - k * second
        turn /= tt - g * g - k * k
        second = (second - k * turn) / e
        step = np.stack([(first - d * second - g * turn) / a, second, turn])
        x = x - step
        if np.abs(step).max(initial=0.0) <= done:
            break
    information = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    return at + x.T, np.moveaxis(information, -1, 0)


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
