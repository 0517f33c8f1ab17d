"""Fixed-lag smoothing: the answer of a frame knows what a live system knows a little later.

Cost is linear in the length of the log: a window of the last chunks moves along (``window``).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.logs.run import RunFrames
from rtmap_cli.steps.localize.drive.motion import motion_of
from rtmap_cli.steps.localize.frame.begin import single_frames
from rtmap_cli.steps.localize.frame.calibrate import calibrated
from rtmap_cli.steps.localize.frame.single import Solution, solve_single
from rtmap_cli.steps.localize.lag.window import Window
from rtmap_cli.steps.localize.model import ErrorModel, Settings
from rtmap_cli.steps.localize.seeing.frames import Detections
from rtmap_cli.steps.localize.seeing.lines import MapLines

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_DEFAULT = ErrorModel()
_ROUNDS = 2
"""Gauss–Newton steps per frame that comes."""
_FEW = 8
"""Frames that settle which of several lanes it is."""
_FIRST_STAGE = 8
"""Frames after which errors are measured for the first time; then whenever they have doubled."""


def solve_live(
    lines: MapLines,
    seen: Detections,
    frames: RunFrames,
    lag_s: float,
    model: ErrorModel | None,
    settings: Settings,
    around: Array | None = None,
) -> tuple[Solution, ErrorModel]:
    """Every frame from detections, odometry and GNSS up to ``lag_s`` seconds after it.

    So are the noise of GNSS and the error model, unless a ``model`` is given; the last one comes
    back. The frames within the lag of the first one are solved as ``solve_smooth`` does.
    ``around`` (T, 3): where to begin, if not at the initial poses.
    """
    time = frames.timestamp_ns
    until = np.searchsorted(time, time + round(lag_s * 1e9), side="right") - 1
    stages = _stages(int(until[0]) + 1, len(frames))
    first = None if around is None else around[: stages[0]]
    single, now = single_frames(lines, seen.between(0, stages[0]), model, settings, first)
    motion = motion_of(frames, seen.pose, now, settings, stages[0])
    window = Window(lines, seen, motion, now, settings)
    window.begin(stages[0] - 1, single, first)
    parts = [_widened(window.answers(_answered(until, stages[0] - 1)), single, stages[0])]
    for known, after in pairwise(stages):
        if known > stages[0]:
            now = model or calibrated(lines, seen.between(0, known), single, _DEFAULT, settings)
            window.model = now
            window.motion = motion_of(frames, seen.pose, now, settings, known)
        start = None if around is None else around[known:after]
        more = solve_single(lines, seen.between(known, after), now, settings, start=start)
        single = joined([single, more])
        for t in range(known, after):
            window.follow(_ROUNDS)
            window.reconsider(single)
            ready = _answered(until, t)
            if len(ready):
                parts.append(_widened(window.answers(ready), single, t + 1))
            window.leave_behind(min(ready.stop, t))
    return joined(parts), now


def _widened(answers: Solution, single: Solution, known: int) -> Solution:
    """While few frames are ``known``: with what the rivals of their starts leave open."""
    if known >= _FEW:
        return answers
    spread = single.spread[:known]
    least = spread[np.trace(spread, axis1=1, axis2=2).argmin()]
    return replace(answers, covariance=answers.covariance + least, spread=answers.spread + least)


def joined(parts: list[Solution]) -> Solution:
    """Solutions of consecutive frames as one."""
    names = Solution.__dataclass_fields__
    return Solution(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _stages(first: int, count: int) -> list[int]:
    """Numbers of frames known when errors are measured, from ``first`` to all of them."""
    out = [first]
    while out[-1] < count:
        out.append(min(max(2 * out[-1], _FIRST_STAGE), count))
    return out


def _answered(until: Index, last: int) -> range:
    """The frames whose answer waits for frame ``last`` and no later one."""
    first, stop = np.searchsorted(until, (last, last + 1))
    return range(int(first), int(stop))
