"""Where the frames of a run stand on a map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer, UsageError
from rtmap_cli.geometry.poses import xyyaw_of
from rtmap_cli.logs.residuals import Residuals
from rtmap_cli.logs.run import Poses, Run, RunFrames
from rtmap_cli.maps.crs import check_same_crs
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.steps.localize.answer import poses_of
from rtmap_cli.steps.localize.drive.motion import motion_of
from rtmap_cli.steps.localize.drive.smooth import solve_smooth
from rtmap_cli.steps.localize.explain import residuals_at
from rtmap_cli.steps.localize.frame.begin import single_frames
from rtmap_cli.steps.localize.frame.single import Solution
from rtmap_cli.steps.localize.given import Rest, known_end_to_end, start_of, with_prior
from rtmap_cli.steps.localize.heights import with_heights
from rtmap_cli.steps.localize.lag.live import solve_live
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.relocate import Found, Reach, moved, relocate, widened
from rtmap_cli.steps.localize.seeing.frames import Detections, has_matches, read_detections
from rtmap_cli.steps.localize.seeing.lines import MapLines

Array = NDArray[np.float64]

METHODS = ("auto", "matches", "geometry", "end-to-end")
"""How vertices find their lines: by D where the run has it, by D, by geometry; or T^E as it is."""

MAP_MARGIN_M = 60.0
"""The map is read so far around the initial poses."""


def localize(
    run: Run,
    vector_map: VectorMap,
    method: str = "auto",
    smooth: bool = False,
    model: ErrorModel | None = None,
    settings: Settings | None = None,
    where: str | Path = "map",
    search: Reach | None = None,
    explain: Callable[[Residuals], None] | None = None,
    lag: float | None = None,
    ground_z: float | None = None,
    prior: str = "initial",
    begin: str = "initial",
) -> Poses:
    """Localize every frame of a run on a map (Eq. 4 of the paper; ``smooth``: all frames at once).

    ``method`` is one of METHODS. ``search``: how far the initial poses may be off, where that is
    more than the solver reaches by itself; their sigmas are then taken as half of it at least.
    ``explain`` is called with the residuals at the poses. ``lag``: seconds after which a smoothed
    frame must be answered; ``ground_z``: height of the road in the ego frame (m), else the run's.
    ``prior`` (PRIORS) and ``begin`` (STARTS): what the solve leans on and where it begins.

    BadInput when the map has another CRS or lies elsewhere, or when initial poses or sigmas are
    unusable; NoAnswer when no frame has an answer.
    """
    settings = settings or Settings()
    check_same_crs(vector_map.crs, run.crs, where)
    _check_frames(run)
    ground = _ground_z(run) if ground_z is None else ground_z
    lines, origin = _lines(run, vector_map, settings, where)
    if method == "end-to-end":
        return _end_to_end(run, origin, smooth, settings)
    if method == "matches" and not has_matches(run):
        raise UsageError("--method matches: the run has no matched elements; use geometry")
    rest: Rest | None = None
    if prior != "initial":
        run, rest = with_prior(run, prior)
    if search is not None:
        run = replace(run, frames=_doubted(run.frames, search))
    matched = method == "matches" or (method == "auto" and has_matches(run))
    seen = read_detections(run, lines, settings, matched)
    if not len(seen.frame):
        raise NoAnswer(f"{run.log_id}: no detection can be compared with the map")
    gnss, place, around = seen.pose, None, None
    if search is not None:
        place = _searched(run, lines, seen, search, model or ErrorModel(), settings)
        around, seen = place.pose, moved(seen, place)
    if begin == "end-to-end":
        around = start_of(run, origin)
    name = "matches" if matched else "geometry"
    if lag is not None:
        start, model = solve_live(lines, seen, run.frames, lag, model, settings, around)
        name = "fixed-lag"
    else:
        start, model = single_frames(lines, seen, model, settings, around)
    if smooth and lag is None:
        motion = motion_of(run.frames, gnss, model, settings)
        start = solve_smooth(lines, seen, motion, start, model, settings, around)
        name = "smooth"
    elif rest is not None and lag is None:
        start = rest.joined(start, origin)
    if place is not None:
        start = widened(start, place)
    poses = poses_of(run.frames, start, origin, name, model, settings)
    time = run.frames.timestamp_ns
    live = lag is not None and lag * 1e9 < time[-1] - time[0]
    poses = with_heights(poses, run.frames.initial, vector_map, ground, live)
    if (poses.status == "no-match").all():
        raise NoAnswer(f"{run.log_id}: nothing in any frame matches the map")
    if explain is not None:
        explain(residuals_at(run, lines, seen, start.pose, model, settings))
    return poses


def _ground_z(run: Run) -> float | None:
    """Height of the road in the ego frame (m) as run.json states it, if it does."""
    value = run.info.get("ground_z")
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        where = run.path / "run.json" if run.path else run.log_id
        raise BadInput(where, "ground_z is not a number", "give the road's height in the ego frame")
    return float(value)


def _searched(
    run: Run,
    lines: MapLines,
    seen: Detections,
    reach: Reach,
    model: ErrorModel,
    settings: Settings,
) -> Found:
    return relocate(lines, seen, motion_of(run.frames, seen.pose, model, settings), reach)


def bounds(run: Run, search: Reach | None = None) -> tuple[float, float, float, float]:
    """The box of the map frame that can matter to a run (metres)."""
    xy = run.frames.initial[:, :2, 3]
    margin = MAP_MARGIN_M + (search.metres if search else 0.0)
    low, high = xy.min(axis=0) - margin, xy.max(axis=0) + margin
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _doubted(frames: RunFrames, search: Reach) -> RunFrames:
    least = 0.5 * np.array([search.metres, search.metres, search.radians])
    return replace(frames, sigma=np.maximum(frames.sigma, least))


def _check_frames(run: Run) -> None:
    where = run.path / "frames.parquet" if run.path else run.log_id
    if not len(run.frames):
        raise BadInput(where, "the run has no frames")
    bad = ~(np.isfinite(run.frames.sigma) & (run.frames.sigma > 0)).all(axis=1)
    if bad.any():
        frame = int(run.frames.frame[bad][0])
        raise BadInput(where, f"frame {frame}: the sigma of the initial pose is not above zero")
    # An unknown sigma of odometry (NaN) is assumed, a senseless one is not.
    moved = np.isfinite(run.frames.odometry).all(axis=1)
    bad = moved & (run.frames.odometry_sigma <= 0).any(axis=1)
    if bad.any():
        frame = int(run.frames.frame[bad][0])
        raise BadInput(where, f"frame {frame}: the sigma of its odometry is not above zero")


def _lines(
    run: Run, vector_map: VectorMap, settings: Settings, where: str | Path
) -> tuple[MapLines, Array]:
    """The lines of the map around a run; BadInput when there are none."""
    # The first frame's, which a live system knows too.
    origin = np.round(run.frames.initial[0, :2, 3])
    lines = MapLines(vector_map, list(run.info["classes"]), origin, settings.heading_weight_m)
    box = bounds(run)
    if lines.count:
        xy = lines.xy + origin
        near = ((xy >= box[:2]) & (xy <= box[2:])).all(axis=1)
        if near.any():
            return lines, origin
    raise BadInput(
        where,
        f"no element within {MAP_MARGIN_M:.0f} m of the drive around "
        f"({origin[0]:.0f}, {origin[1]:.0f})",
        "check that map and run are of the same place",
    )


def _end_to_end(run: Run, origin: Array, smooth: bool, settings: Settings) -> Poses:
    """T^E of the network as the answer, for the paper's comparison of T^E and T^R."""
    if smooth:
        raise UsageError("--method end-to-end takes T^E as it is and cannot be smoothed")
    pose, covariance = run.frames.end_to_end.copy(), run.frames.end_to_end_covariance
    known = known_end_to_end(run)
    initial = xyyaw_of(run.frames.initial)
    pose = np.where(known[:, None], pose, initial)
    prior = run.frames.sigma[:, :, None] ** 2 * np.eye(3)
    covariance = np.where(known[:, None, None], covariance, prior)
    information = np.where(known[:, None, None], np.linalg.inv(covariance), 0.0)
    pose[:, :2] -= origin
    count = np.where(known, settings.min_residuals, 0)
    chi2, spread = np.full(len(pose), np.nan), np.zeros_like(covariance)
    solution = Solution(pose, covariance, information, chi2, count, spread)
    # The network states its own covariance: nothing is added to it.
    model = ErrorModel(rig_sigma_m=(0.0, 0.0), rig_sigma_rad=0.0)
    return poses_of(run.frames, solution, origin, "end-to-end", model, settings)
