"""rtmap localize: where each frame of a run stands on a map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options
from rtmap_cli.errors import UsageError

if TYPE_CHECKING:
    from rtmap_cli.logs.residuals import Residuals
    from rtmap_cli.logs.run import Poses, Run
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.localize.relocate import Reach


_AGREED = 0.3
"""Poses that were fitted to the wrong map, or to one with mirrored axes, bring up to a fifth of the
detections onto lines; on the right one it is most of them."""


@click.command("localize")
@click.argument("run", type=options.PATH)
@options.map_path
@options.map_version
@click.option("--smooth", is_flag=True, help="Solve the whole log at once, with odometry.")
@click.option(
    "--lag",
    type=options.FiniteRange(0),
    metavar="SECONDS",
    help="With --smooth: a frame's answer knows what is seen up to so much later, as live.",
)
@click.option(
    "--method",
    type=click.Choice(["auto", "matches", "geometry", "end-to-end"]),
    default="auto",
    show_default=True,
    help="What ties a detection to the map: the run's own matches, geometry, or the pose "
    "that the network gave. auto: matches where the run has any.",
)
@click.option(
    "--prior",
    type=click.Choice(["initial", "end-to-end", "both"]),
    default="initial",
    show_default=True,
    help="What the solve leans on: the initial pose, the pose that the network gave with its "
    "covariance (which counts the same detections twice), or both.",
)
@click.option(
    "--start",
    type=click.Choice(["initial", "end-to-end"]),
    default="initial",
    show_default=True,
    help="Where the solve begins. The network's pose as a start counts nothing twice.",
)
@click.option("--with-outdated", is_flag=True, help="Ablation: nothing is outdated (Q_prior).")
@click.option(
    "--without-sigma",
    is_flag=True,
    help="Ablation: without covariances, all detections have the same sigma.",
)
@click.option(
    "--search",
    type=(click.FloatRange(0, 40), click.FloatRange(0, 180)),
    metavar="METRES DEGREES",
    help="How far the initial poses may be off: the place is searched for first. By itself where "
    "they state sigmas above 2 m or 5°.",
)
@click.option(
    "--ground-z",
    type=options.FiniteRange(-5, 5),
    metavar="METRES",
    help="Height of the road in the ego frame, for maps with heights (default: what run.json or "
    "the initial heights say).",
)
@click.option("--residuals", is_flag=True, help="Also write RUN/residuals.parquet: why.")
@options.as_json
def command(
    run: Path,
    map_path: Path,
    map_version: int | None,
    smooth: bool,
    lag: float | None,
    method: str,
    prior: str,
    start: str,
    with_outdated: bool,
    without_sigma: bool,
    search: tuple[float, float] | None,
    ground_z: float | None,
    residuals: bool,
    as_json: bool,
) -> None:
    """Find where each frame of RUN stands on the map, how sure that is, and where it is not.

    Writes RUN/poses.parquet: per frame the pose, its covariance, the eigenvalues of what the map
    says about it with the weakest direction, and a status: ok, degenerate (some direction is not
    known to a metre) or no-match. An older answer is replaced. Exit code 4: no frame matches.

    \b
    Example:
      rtmap localize runs/drive-00 --map map --smooth
    """
    from rtmap_cli.logs.residuals import write_residuals
    from rtmap_cli.logs.run_files import read_run, read_run_info, write_poses
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.maps.store import map_crs, read_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.steps.localize import given
    from rtmap_cli.steps.localize.localize import bounds, localize

    # The CRS first: a box in one CRS cannot ask a map in another.
    check_same_crs(map_crs(map_path), str(read_run_info(run)["crs"]), map_path)
    loaded = read_run(run)
    reach = _reach(loaded, search, method)
    _check(smooth, lag, method, (prior, start), reach, search is not None)
    box = bounds(loaded, reach) if len(loaded.frames) else None
    vector_map = read_map(map_path, map_version, box)
    if residuals and method == "end-to-end":
        raise UsageError("--residuals has no use for --method end-to-end")
    if (prior, start) != ("initial", "initial") and (method == "end-to-end" or reach is not None):
        raise UsageError(
            "--prior and --start have no use for --method end-to-end, nor for a search"
        )
    asked, known = loaded, vector_map
    if with_outdated:
        asked = given.credulous(asked)
    if without_sigma:
        asked, known = given.without_sigma(asked, known)
    why: list[Residuals] = []
    explain = why.append if residuals else None
    poses = localize(
        asked,
        known,
        method,
        smooth,
        where=map_path,
        search=reach,
        explain=explain,
        lag=lag,
        ground_z=ground_z,
        prior=prior,
        begin=start,
    )
    replaced = loaded.poses is not None
    for rows in why:
        write_residuals(rows, run, loaded.crs)
    write_poses(poses, run, loaded.crs)
    if replaced:
        log(f"{run / 'poses.parquet'}: replaced")
    if doubt := _doubt(loaded, poses, vector_map, map_path):
        log(doubt)
    result = _summary(poses) | {
        "run": str(run),
        "log_id": loaded.log_id,
        "map_version": vector_map.version,
        "replaced": replaced,
        "lag_s": lag,
        "prior": prior,
        "start": start,
        "ablation": {"with_outdated": with_outdated, "without_sigma": without_sigma},
        "search": reach and {"metres": reach.metres, "degrees": math.degrees(reach.radians)},
    }
    emit(result, as_json, _lines(result))


def _reach(run: Run, search: tuple[float, float] | None, method: str) -> Reach | None:
    """How far to search: as asked for, or as far as the stated sigmas of the initial poses say."""
    from rtmap_cli.steps.localize.relocate import Reach, needs_search, reach_of

    if search is not None and method == "end-to-end":
        raise UsageError("--search has no use for --method end-to-end")
    if search is not None:
        return Reach(search[0], math.radians(search[1]))
    if method == "end-to-end" or not len(run.frames) or not needs_search(run.frames.sigma):
        return None
    return reach_of(run.frames.sigma)


def _check(
    smooth: bool,
    lag: float | None,
    method: str,
    leans: tuple[str, str],
    reach: Reach | None,
    asked: bool,
) -> None:
    """UsageError for options that exclude each other; ``asked`` for the search, or implied."""
    if leans != ("initial", "initial") and (method == "end-to-end" or reach is not None):
        raise UsageError(
            "--prior and --start have no use for --method end-to-end, nor for a search"
        )
    if lag is None:
        return
    if not smooth or method == "end-to-end":
        raise UsageError("--lag needs --smooth, and detections to smooth")
    if reach is not None:
        why = "--search" if asked else "a search, which the sigmas of the initial poses ask for,"
        raise UsageError(f"{why} looks at the whole log and cannot be had with --lag")


def _doubt(run: Run, poses: Poses, vector_map: VectorMap, where: Path) -> str | None:
    """A warning when the map does not look like that of this place; frames without an answer are
    judged at their initial poses."""
    from dataclasses import replace

    import numpy as np

    from rtmap_cli.logs.agreement import warning
    from rtmap_cli.logs.traversal import traversal_of

    every = replace(poses, status=np.full(len(poses), "ok", object))
    return warning([traversal_of(replace(run, poses=every))], vector_map, where, _AGREED)


def _summary(poses: Poses) -> dict[str, Any]:
    """Counts by status and the middle stated sigma of each axis."""
    import numpy as np

    from rtmap_cli.geometry.poses import yaw_of
    from rtmap_cli.logs.run import POSE_STATUS

    known = poses.status != "no-match"
    yaw = yaw_of(poses.pose[known])
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
    planar = poses.covariance[known][:, :2, :2]
    lateral = np.sqrt(np.einsum("ti,tij,tj->t", left, planar, left))
    along = np.sqrt(np.einsum("ti,tij,tj->t", forward, planar, forward))
    return {
        "method": poses.method,
        "frames": len(poses),
        "status": {s: int((poses.status == s).sum()) for s in POSE_STATUS},
        "median_sigma": {
            "lateral_m": float(np.median(lateral)),
            "longitudinal_m": float(np.median(along)),
            "yaw_deg": float(np.degrees(np.median(np.sqrt(poses.covariance[known][:, 5, 5])))),
        },
    }


def _lines(result: dict[str, Any]) -> list[str]:
    searched = result["search"]
    how = (
        f", searched {searched['metres']:.0f} m and {searched['degrees']:.0f}° around"
        if searched
        else ""
    )
    if result["lag_s"] is not None:
        how = f" of {result['lag_s']:g} s"
    told = ", ".join(f"{n} {s}" for s, n in result["status"].items() if n)
    sigma = result["median_sigma"]
    return [
        f"{result['run']}: {result['frames']} frames by {result['method']}{how}: {told}",
        f"stated sigma (median): lateral {sigma['lateral_m']:.3f} m, "
        f"longitudinal {sigma['longitudinal_m']:.3f} m, yaw {sigma['yaw_deg']:.3f}°",
    ]
