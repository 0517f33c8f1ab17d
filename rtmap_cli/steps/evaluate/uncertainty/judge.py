"""The uncertainties of a run or a map against the true map and the true poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer, UsageError
from rtmap_cli.geometry.polylines import is_ring
from rtmap_cli.geometry.poses import se3_from_xyyaw, xyyaw_of
from rtmap_cli.logs.run import OUTDATED, Observations, Run
from rtmap_cli.logs.traversal import range_box
from rtmap_cli.maps.crop import DEFAULT_RANGE, joined
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.evaluate.drives import Drive, drive_of, read_drives
from rtmap_cli.steps.evaluate.judge import pose_pairs, true_poses_of
from rtmap_cli.steps.evaluate.maps.frames import MapSide, in_crs, probability
from rtmap_cli.steps.evaluate.maps.precision import Detection
from rtmap_cli.steps.evaluate.maps.whole import CELL, cells_in, region_in_range
from rtmap_cli.steps.evaluate.poses import (
    chi_squares,
    effective_count,
    planar_residuals,
    stated,
    whitened_errors,
)
from rtmap_cli.steps.evaluate.uncertainty.existence import World
from rtmap_cli.steps.evaluate.uncertainty.measure import (
    gaussian_nll,
    gaussian_ranks,
    line_figures,
    rank_figures,
    share_figures,
)
from rtmap_cli.steps.evaluate.uncertainty.vertices import (
    Vertices,
    compare_vertices,
    map_vertices,
    real_ones,
)

Array = NDArray[np.float64]


def judge_run(
    run: Run,
    truth: VectorMap | None,
    poses: str | Path,
    traversal: str | None = None,
    threshold: float = 1.5,
) -> dict[str, Any]:
    """What a run states, section by section: poses and, with the true map, vertices, scores and
    the existence of prior elements."""
    drive = drive_of(read_drives(poses, traversal), run.log_id, poses)
    true = true_poses_of(run, drive, poses)
    out = {}
    if truth is not None:
        check_shares(run)
        out = _run_elements(run, in_crs(truth, run.crs), true, threshold)
    return out | _run_poses(run, drive, poses, true)


def check_shares(run: Run) -> None:
    """BadInput naming the first score or existence outside [0, 1] (existence may be unknown)."""
    o, where = run.observations, (run.path or Path(run.log_id)) / "observations.parquet"
    for name, values in (("score", o.score), ("existence", o.existence)):
        wrong = ~((values >= 0) & (values <= 1))
        if name == "existence":
            wrong &= ~np.isnan(values)
        if wrong.any():
            k = int(np.flatnonzero(wrong)[0])
            place = f"frame {int(o.frame[k])}, query {int(o.query[k])}"
            raise BadInput(where, f"{place}: {name} {values[k]:g} is outside [0, 1]")


def _run_elements(run: Run, truth: VectorMap, true: Array, threshold: float) -> dict[str, Any]:
    side, box = MapSide(truth, False), range_box(run)
    o = run.observations.select(run.observations.state != OUTDATED)
    parts, real = [], np.zeros(len(o), dtype=bool)
    seen = False
    for frame, pose in zip(run.frames.frame.tolist(), true, strict=True):
        local = side.crop(pose, box)
        seen |= bool(local)
        rows = np.flatnonzero(o.frame == frame)
        hits = real_ones(_detections(o, rows), local, threshold)
        real[rows] = hits >= 0
        for k, hit in zip(rows.tolist(), hits.tolist(), strict=True):
            if hit >= 0:
                parts.append(_vertices(o, k, local[hit][1]))
    if not seen:
        raise NoAnswer("nothing of the true map lies in range of the poses")
    vertices = Vertices.together(parts)
    return {
        "vertices": _vertex_section(vertices, int(real.sum()), len(o), True)
        | {"group": "frame", "threshold_m": threshold},
        "scores": share_section(o.score.astype(np.float64), real, o.class_name)
        | {"claim": "the detection is real"},
        "existence": _asked(run.observations, truth),
    }


def _detections(o: Observations, rows: NDArray[np.intp]) -> list[Detection]:
    return [(str(o.class_name[k]), o.points[k].astype(float), float(o.score[k])) for k in rows]


def _vertices(o: Observations, k: int, line: Array) -> Vertices:
    points, variance = o.points[k].astype(np.float64), o.sigma[k].astype(np.float64) ** 2
    last = -1 if is_ring(points) else None
    covariance = np.column_stack([variance[:, 0], np.zeros(len(points)), variance[:, 1]])
    name, frame = str(o.class_name[k]), int(o.frame[k])
    return compare_vertices(points[:last], covariance[:last], line, name, frame)


def _asked(o: Observations, truth: VectorMap) -> dict[str, Any]:
    """Prior elements about which the network was asked: do they still exist?"""
    o = o.select(np.isfinite(o.existence) & np.isfinite(o.prior_points).all(axis=(1, 2)))
    world = World(truth)
    there = np.array(
        [world.holds(p, str(n)) for p, n in zip(o.prior_points, o.class_name, strict=True)], bool
    )
    claim = {"claim": "the prior element still exists"}
    return share_section(o.existence.astype(np.float64), there, o.class_name) | claim


def _vertex_section(
    vertices: Vertices, real: int, elements: int, laplace: bool = False
) -> dict[str, Any]:
    v = vertices
    out = line_figures(v.error, v.sigma, v.group, laplace)
    out["elements"] = {"real": real, "not_real": elements - real}
    out["beyond_end"], out["without_sigma"] = v.beyond, v.silent
    out["by_class"] = {
        name: line_figures(v.error[of], v.sigma[of], v.group[of], laplace)
        for name in dict.fromkeys(v.class_name.tolist())
        for of in (v.class_name == name,)
    }
    return out


def share_section(shares: Array, true: NDArray[np.bool_], names: NDArray[Any]) -> dict[str, Any]:
    """``share_figures`` of all and class by class."""
    classes = dict.fromkeys(names.tolist())
    by_class = {str(c): share_figures(shares[names == c], true[names == c]) for c in classes}
    return share_figures(shares, true) | {"by_class": by_class}


def _run_poses(run: Run, drive: Drive, poses: str | Path, true: Array) -> dict[str, dict[str, Any]]:
    """Localized poses, the initial ones and those of the network (T^E), where there are any."""
    out = {}
    if run.poses is not None:
        p = pose_pairs(run, drive, poses)
        out["poses"] = pose_section(p.true, p.estimate, p.covariance, p.status != "no-match")
    p = pose_pairs(run, drive, poses, initial=True)
    out["initial_poses"] = pose_section(p.true, p.estimate, p.covariance)
    xyyaw = run.frames.end_to_end
    known = np.isfinite(xyyaw).all(axis=1)
    if known.any():
        estimate = se3_from_xyyaw(*xyyaw[known].T)
        covariance = run.frames.end_to_end_covariance[known]
        out["end_to_end_poses"] = pose_section(true[known], estimate, covariance)
    return out


def pose_section(
    true: Array,
    estimate: Array,
    covariance: Array,
    answered: NDArray[np.bool_] | None = None,
) -> dict[str, Any]:
    """Ranks of planar poses: x, y and yaw together (``all``, 3 degrees of freedom) and by axis.

    Intervals take the frames for as many as they are worth (``effective_count``).
    """
    usable = stated(covariance)
    if answered is not None:
        usable = usable[answered[usable]]
    if not len(usable):
        return {"n": 0}
    true, estimate, covariance = true[usable], estimate[usable], covariance[usable]
    squares = chi_squares(true, estimate, covariance)
    worth = effective_count(whitened_errors(true, estimate, covariance))
    yaw = xyyaw_of(true)[:, 2]
    c, s, one = np.cos(yaw), np.sin(yaw), np.ones(len(yaw))
    zero = np.zeros(len(yaw))
    axes = {
        "longitudinal": np.column_stack([c, s, zero]),
        "lateral": np.column_stack([-s, c, zero]),
        "yaw": np.column_stack([zero, zero, one]),
    }
    group = np.arange(len(usable))
    log_det = np.linalg.slogdet(covariance)[1]
    out: dict[str, Any] = {"n": len(usable), "worth": worth}
    out["all"] = {"nll": gaussian_nll(squares["all"], log_det, 3)} | rank_figures(
        gaussian_ranks(squares["all"], 3), group, worth
    )
    out["all"]["scale"] = float(np.sqrt(squares["all"].mean() / 3))
    residual = planar_residuals(true, estimate)
    for name, d in axes.items():
        variance = np.einsum("ni,nij,nj->n", d, covariance, d)
        out[name] = {"nll": gaussian_nll(squares[name], np.log(variance), 1)} | rank_figures(
            gaussian_ranks(squares[name], 1), group, worth
        )
        out[name]["scale"] = float(np.sqrt(squares[name].mean()))
        out[name]["error_rms"] = float(np.sqrt(((d * residual).sum(axis=1) ** 2).mean()))
        out[name]["sigma_rms"] = float(np.sqrt(variance.mean()))
    return out


def judge_map(
    fused: VectorMap,
    truth: VectorMap,
    drives: Sequence[Drive] = (),
    threshold: float = 1.5,
) -> dict[str, Any]:
    """What a map states: covariances of vertices and the probability that elements exist.

    With ``drives`` only what was in range of their poses (72 × 36 m) counts.
    """
    truth = in_crs(truth, fused.crs)
    region = None
    if drives:
        if len({d.crs for d in drives}) > 1:
            raise UsageError("the drives of --poses lie in several CRS: pick one with --traversal")
        fused, truth = in_crs(fused, drives[0].crs), in_crs(truth, drives[0].crs)
        region = region_in_range(np.concatenate([d.pose for d in drives]), DEFAULT_RANGE)
    cells = _cells(fused, region)
    scores = {e.element_id: probability(e) for e in fused}
    whole = joined(truth)
    vertices, real, pieces = map_vertices(fused, scores, whole, cells, CELL)
    existence = _existence(fused, World(truth), region)
    if not pieces and not existence["n"] + existence["not_stated"]:
        raise NoAnswer("nothing of the map lies in range of the poses")
    section = _vertex_section(vertices, real, pieces)
    section |= {"group": f"cell of {CELL:g} m", "threshold_m": threshold}
    return {"vertices": section, "existence": existence}


def _cells(fused: VectorMap, region: Any | None) -> Array:
    """(n, 2) centres of the cells in a region, or of all that the map touches."""
    if region is not None:
        return np.asarray(cells_in(region)[:, :2, 3])
    spans = [
        np.floor([e.xy.min(axis=0) / CELL, e.xy.max(axis=0) / CELL]).astype(int) for e in fused
    ]
    touched = {
        (i, j)
        for low, high in spans
        for i in range(low[0], high[0] + 1)
        for j in range(low[1], high[1] + 1)
    }
    return (np.array(sorted(touched), float).reshape(-1, 2) + 0.5) * CELL


def _existence(fused: VectorMap, world: World, region: Any | None) -> dict[str, Any]:
    import shapely

    if region is not None:
        shapely.prepare(region)
    stated_shares, there, names = [], [], []
    silent = 0
    for element in fused:
        held = world.holds(element.xy, element.class_name, region)
        # Even odds without any evidence are what an element has of which nothing is known.
        if held is not None and not (element.existence or element.in_view or element.traversals):
            silent += 1
        elif held is not None:
            stated_shares.append(probability(element))
            there.append(held)
            names.append(element.class_name)
    section = share_section(np.array(stated_shares), np.array(there, bool), np.array(names, object))
    return section | {"claim": "the element is in the world", "not_stated": silent}
