"""How well could drives of the presets be localized at best?

    python -m benchmarks.localize.floor                 on the Argoverse 2 maps (RTMAP_DATA)
    python -m benchmarks.localize.floor --towns         on simulated towns

A Bayesian Cramér-Rao bound: what an estimator reaches that knows everything about the simulated
detections but the errors themselves: which line every vertex belongs to, how large and how
correlated all errors are (vertices, elements, places, the shift of the drive, the prior map, GNSS,
odometry), and that no detection is false. Linearised at the truth. Left out is only what ends of
lines tell along them. Beside it `rtmap localize` on the same drives. Mean absolute errors, of the
bound sqrt(2/pi) times its standard deviation. One JSON object per kind of drive.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from benchmarks.localize.robust import KINDS, PRIOR_SIGMA, Case, cases, errors, parser_of, places_of
from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.steps.localize.localize import localize
from rtmap_cli.steps.localize.model import Settings
from rtmap_cli.steps.localize.seeing.frames import Detections, read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines
from rtmap_cli.steps.localize.seeing.residuals import linearize
from rtmap_cli.steps.simulate.perceiving.presets import PRESETS, Preset

Array = NDArray[np.float64]
Index = NDArray[np.int64]

EVERY = 4
"""Vertices are taken by fours, with a quarter of the variance: they share all other errors."""
GATE_M = 3.0
MAP_LENGTH_M = 12.0
"""Correlation length of the prior's error (degrade_map)."""
MEAN_OF_SIGMA = float(np.sqrt(2.0 / np.pi))


@dataclass(frozen=True)
class Rows:
    """n residuals across lines: ``jacobian`` (n, 3) by the pose of their ``frame`` (n,);
    ``normal``, ``at`` (n, 2) in map axes; ``vertex`` (n,) variance; ``offset`` (n,): sd of what is
    shared; ``line``, ``thing``, ``code`` (n,): connected line, what is followed from frame to
    frame, class; ``heading`` (n,) of the vehicle."""

    frame: Index
    jacobian: Array
    normal: Array
    at: Array
    vertex: Array
    offset: Array
    line: Index
    thing: Index
    code: Index
    heading: Array


def rows_of(lines: MapLines, seen: Detections, true: Array, preset: Preset) -> Rows:
    """The residuals of a drive at its true poses (T, 3)."""
    linear = linearize(lines, seen, true, GATE_M)
    kept = linear.found.copy()
    kept[:, np.arange(kept.shape[1]) % EVERY != 0] = False
    e, v = np.nonzero(kept)
    normal = linear.normal[e, v]
    stated = ((normal * seen.spread[e, v]) ** 2).sum(-1)
    drive = ((normal * preset.drive_shift) ** 2).sum(-1)
    laplace, offset = preset.vertex_scale**2, preset.offset_sd**2
    scale2 = np.maximum(stated - drive, 1e-4) / (2.0 * laplace + offset)
    sample = linear.sample[e, v]
    return Rows(
        frame=seen.frame[e],
        jacobian=linear.jacobian[e, v],
        normal=linear.jacobian[e, v, :2],
        at=lines.xy[sample],
        # Fisher information of a Laplace error is that of a normal one with half its variance.
        vertex=laplace * scale2 / EVERY,
        offset=np.sqrt(offset * scale2),
        line=lines.chain[sample],
        thing=things(e, seen.frame[e], lines.chain[sample]),
        code=seen.code[e],
        heading=true[seen.frame[e], 2],
    )


def things(element: Index, frame: Index, line: Index) -> Index:
    """(n,) what each detection is of: the line that most of its vertices are on. A second
    detection of it in the same frame is another thing."""
    out = np.empty(len(element), np.int64)
    taken: set[tuple[int, int]] = set()
    for e in np.unique(element):
        rows = np.flatnonzero(element == e)
        thing, frame_of = int(np.bincount(line[rows]).argmax()), int(frame[rows[0]])
        out[rows] = -1 - e if (frame_of, thing) in taken else thing
        taken.add((frame_of, thing))
    return out


def covariance(r: Rows, preset: Preset) -> Array:
    """(n, n) of all errors in the residuals."""
    d2 = ((r.at[:, None] - r.at) ** 2).sum(-1)
    toward = r.normal @ r.normal.T
    place, drive_place, element = preset.shares
    field = (place + drive_place) * np.exp(-0.5 * d2 / preset.field_length**2)
    field *= r.code[:, None] == r.code
    apart = np.abs(r.frame[:, None] - r.frame)
    own = element * preset.element_memory**apart * (r.thing[:, None] == r.thing)
    out = toward * r.offset[:, None] * r.offset * (field + own)
    error = PRIOR_SIGMA**2 * np.exp(-0.5 * d2 / MAP_LENGTH_M**2)
    out += toward * error * (r.line[:, None] == r.line)
    c, s = np.cos(r.heading), np.sin(r.heading)
    along = (r.normal * np.column_stack([c, s])).sum(-1)
    across = (r.normal * np.column_stack([-s, c])).sum(-1)
    for way, sd in zip((along, across), preset.drive_shift, strict=True):
        out += sd**2 * np.outer(way, way)
    out[np.diag_indices(len(out))] += r.vertex
    return out


def single_bound(r: Rows, c: Array, sigma: Array) -> Array:
    """(T, 3, 3) covariances of every frame by itself; ``sigma`` (T, 3) of its initial pose."""
    out = np.empty((len(sigma), 3, 3))
    for t in range(len(sigma)):
        k = np.flatnonzero(r.frame == t)
        information = np.diag(sigma[t] ** -2.0)
        if len(k):
            j = r.jacobian[k]
            information = information + j.T @ np.linalg.solve(c[np.ix_(k, k)], j)
        out[t] = np.linalg.inv(information)
    return out


def whole_bound(r: Rows, c: Array, true: Array, preset: Preset) -> Array:
    """(T, 3, 3) covariances when the whole drive is known, with odometry and the kinds of error
    that GNSS has."""
    count = len(true)
    j = np.zeros((len(r.frame), 3 * count))
    j[np.arange(len(j))[:, None], 3 * r.frame[:, None] + np.arange(3)] = r.jacobian
    information = j.T @ cho_solve(cho_factor(c), j)
    step = np.hypot(*np.diff(true[:, :2], axis=0).T)
    information += _gnss(np.append(0.0, np.cumsum(step)), preset)
    share, degrees = preset.odometry
    for t, length in enumerate(step):
        cos, sin = np.cos(true[t, 2]), np.sin(true[t, 2])
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        ahead = turn @ (true[t + 1] - true[t])
        before = -turn
        before[:2, 2] += [ahead[1], -ahead[0]]
        both = np.hstack([before, turn])
        yaw = np.radians(degrees) * length
        noise = np.maximum([share * length, share * length, yaw], 1e-6)
        k = slice(3 * t, 3 * t + 6)
        information[k, k] += both.T @ (both / noise[:, None] ** 2)
    inverse = np.linalg.inv(information)
    return np.stack([inverse[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] for t in range(count)])


def _gnss(at: Array, preset: Preset) -> Array:
    """Information (3T, 3T) of the initial poses, ``at`` (T,) metres along the drive."""
    bias, drift, white = preset.gnss
    same, eye = np.ones((len(at), len(at))), np.eye(len(at))
    fading = np.exp(-np.abs(at[:, None] - at) / preset.gnss_drift_length)
    xy = bias**2 * same + drift**2 * fading + white**2 * eye
    yaw_bias, yaw_white = np.radians(preset.gnss_yaw_deg)
    parts = (xy, xy, yaw_bias**2 * same + yaw_white**2 * eye)
    order = np.arange(3 * len(at)).reshape(3, -1).T.ravel()
    whole = block_diag(*[np.linalg.inv(p) for p in parts])
    return whole[np.ix_(order, order)]


def expected(covariances: Array, true: Array) -> Array:
    """(T, 3) mean absolute lateral, longitudinal (m) and yaw (°) errors."""
    c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
    turn = np.zeros((len(true), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = -s, c, c, s
    turn[:, 2, 2] = np.degrees(1.0)
    variance = np.einsum("tij,tjk,tik->ti", turn, covariances, turn)
    return MEAN_OF_SIGMA * np.sqrt(variance)


def bounds_of(case: Case, preset: Preset) -> dict[str, Array]:
    """(T, 3) bounds of a drive, and the errors of `rtmap localize`."""
    true = xyyaw_of(case.true)
    origin = np.round(true[:, :2].mean(axis=0))
    classes = list(case.run.info["classes"])
    settings = Settings()
    lines = MapLines(case.place.world, classes, origin, settings.heading_weight_m)
    seen = read_detections(case.run, lines, settings, False)
    true[:, :2] -= origin
    rows = rows_of(lines, seen, true, preset)
    c = covariance(rows, preset)
    out = {
        "bound, single": expected(single_bound(rows, c, seen.sigma), true),
        "bound, smooth": expected(whole_bound(rows, c, true, preset), true),
    }
    for name, smooth in (("rtmap, single", False), ("rtmap, smooth", True)):
        poses = localize(case.run, case.prior, smooth=smooth)
        out[name] = np.abs(errors(poses, case.true))
    return out


def main() -> None:
    """Parse the command line."""
    a = parser_of(__doc__.splitlines()[0]).parse_args()
    places = places_of(a)
    for kind in KINDS:
        found: dict[str, list[Array]] = {}
        for case in cases(places, kind, a.drives, a.seed):
            for name, values in bounds_of(case, PRESETS[f"rtmap-{kind}"]).items():
                found.setdefault(name, []).append(values)
        means = {n: np.concatenate(v).mean(axis=0).round(3).tolist() for n, v in found.items()}
        row: dict[str, Any] = {"kind": kind, "columns": ["lateral m", "longitudinal m", "yaw deg"]}
        print(json.dumps(row | means), flush=True)


if __name__ == "__main__":
    main()
