"""Leak check: how much of a test area a network saw in training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer, UsageError
from rtmap_cli.maps.crop import DEFAULT_RANGE, Range
from rtmap_cli.maps.crs import is_local, to_lonlat
from rtmap_cli.maps.footprint import (
    METADATA_KEY,
    TOWNS,
    Footprint,
    footprint_of_map,
    points_in_range,
    read_footprint,
    union,
)
from rtmap_cli.steps.evaluate.drives import Drive

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Area:
    """Where the test frames are: poses (n, 4, 4) map_SE3_ego, their CRS and their range."""

    poses: Array
    crs: str
    range_m: Range


@dataclass(frozen=True)
class Leak:
    """What ``trained_on`` saw of a test area.

    ``area`` is the seen share of the area in range of the frames, ``frames`` the share of frames
    whose vehicle stood in a seen cell; both None where they cannot be known: the test area has no
    place on earth, or training has none that is known. ``certain`` is False when there was more in
    training than is known: the shares are the least then.
    """

    trained_on: str
    footprint: Footprint
    area: float | None
    frames: float | None
    certain: bool

    def as_json(self) -> dict[str, Any]:
        """The shares, of what, and whether they are certain."""
        return {
            "trained_on": self.trained_on,
            "training": self.footprint.text(),
            "area_seen": self.area,
            "frames_seen": self.frames,
            "certain": self.certain,
        }

    def sentence(self) -> str:
        """One line for people."""
        if self.area is None or self.frames is None:
            return f"leak: unknown ({self.trained_on}: {self.footprint.text()})"
        least = "" if self.certain else "at least "
        return (
            f"leak: {least}{self.area:.1%} of the test area, {self.frames:.1%} of its frames, lie "
            f"where training was ({self.trained_on}: {self.footprint.text()})"
        )

    def findings(self, most: float) -> list[str]:
        """Empty, or one sentence when more than a share ``most`` of the area was seen."""
        if self.area is None or self.area <= most:
            return []
        return [f"{self.area:.1%} of the test area was seen in training, over {most:.1%}"]

    def require_answer(self) -> None:
        """NoAnswer when it cannot be told how much was seen."""
        if not self.certain:
            raise NoAnswer(
                f"how much of the test area training saw cannot be told ({self.trained_on}: "
                f"{self.footprint.text()}); say it with --trained-on"
            )


def find_leak(trained_on: str, footprint: Footprint, test: Area) -> Leak:
    """Compare a footprint with a test area."""
    if footprint == TOWNS:
        return Leak(trained_on, footprint, 0.0, 0.0, True)
    if is_local(test.crs) or (not footprint.known and not footprint.cells):
        return Leak(trained_on, footprint, None, None, False)
    points = points_in_range(test.poses, test.range_m)
    seen, stood = (
        footprint.holds(to_lonlat(test.crs, xy)) for xy in (points, test.poses[:, :2, 3])
    )
    return Leak(trained_on, footprint, float(seen.mean()), float(stood.mean()), footprint.known)


def read_trained_on(specs: Sequence[str]) -> Footprint:
    """What ``--trained-on`` names, together: models, runs (the model that made them), maps, logs.

    BadInput when one is none of these, or its statement makes no sense.
    """
    return union(_read_one(spec) for spec in specs)


def _read_one(spec: str) -> Footprint:
    from rtmap_cli.formats.model_file import find_model, zoo_models
    from rtmap_cli.maps.store import map_exists, read_map

    path = Path(spec)
    if path.suffix == ".onnx" or (spec in zoo_models() and not path.exists()):
        return footprint_of_model(find_model(spec))
    if (path / "run.json").exists():
        from rtmap_cli.logs.run_files import read_run_info

        return footprint_of_run(read_run_info(path), path)
    if path.is_dir() and map_exists(path):
        return footprint_of_map(read_map(path))
    if not path.exists() and ":" not in spec and "#" not in spec:
        raise BadInput(spec, "no such model, run, map or log")
    from rtmap_cli.logs.footprint import footprint_of_log
    from rtmap_cli.logs.open import open_log

    return footprint_of_log(open_log(spec), DEFAULT_RANGE)


def footprint_of_model(path: Path) -> Footprint:
    """What a model file says it was trained on; unknown where it says nothing."""
    from rtmap_cli.formats.model_file import read_model_metadata

    text = read_model_metadata(path).get(METADATA_KEY, "null")
    try:
        return read_footprint(json.loads(text))
    except ValueError as error:
        raise BadInput(path, f"the model's metadata make no sense ({error})") from None


def footprint_of_run(info: dict[str, Any], where: str | Path) -> Footprint:
    """What the model behind a run was trained on, as `rtmap infer` noted it in run.json."""
    try:
        return read_footprint(info.get("model_footprint"))
    except ValueError as error:
        what = f"run.json makes no sense ({error})"
        raise BadInput(where, what, "infer it again") from None


def check_leak(
    pred: str | Path,
    truth: str | Path,
    drives: Sequence[Drive],
    range_m: Range = DEFAULT_RANGE,
    trained_on: Sequence[str] = (),
    needed: bool = False,
) -> Leak | None:
    """How much of the frames of an evaluation was seen by what ``trained_on`` names, else by the
    model that made the run ``pred``.

    None when there is nothing to compare, unless ``trained_on`` or ``needed`` ask for it: then
    UsageError says what is missing.
    """
    run = _run_info(pred)
    if trained_on:
        name, footprint = ", ".join(trained_on), read_trained_on(trained_on)
    elif run is not None and (needed or "model_footprint" in run):
        name, footprint = str(run.get("model") or pred), footprint_of_run(run, pred)
    elif needed:
        raise UsageError("a leak check needs to know what was trained on: pass --trained-on")
    else:
        return None
    area = _area(pred, truth, drives, range_m)
    if area is not None:
        return find_leak(name, footprint, area)
    if trained_on or needed:
        raise UsageError("a leak check needs to know where the frames are: pass --poses")
    return None


def _run_info(path: str | Path) -> dict[str, Any] | None:
    from rtmap_cli.logs.run_files import read_run_info

    return read_run_info(path) if (Path(path) / "run.json").exists() else None


def _area(
    pred: str | Path, truth: str | Path, drives: Sequence[Drive], range_m: Range
) -> Area | None:
    """The frames of a run (its initial poses are near enough), else those of the drives."""
    from rtmap_cli.logs.run_files import read_frames

    for path in (pred, truth):
        info = _run_info(path)
        if info is not None:
            poses = read_frames(Path(path)).initial
            return Area(poses, str(info["crs"]), range_m) if len(poses) else None
    if not drives:
        return None
    return Area(np.concatenate([d.pose for d in drives]), drives[0].crs, range_m)
