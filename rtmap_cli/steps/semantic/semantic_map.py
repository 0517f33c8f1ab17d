"""From a log with masks to a semantic map folder, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtmap_cli.errors import BadInput, NoAnswer
from rtmap_cli.geometry.poses import transform
from rtmap_cli.logs.log import Frame, Log
from rtmap_cli.logs.open import notes_of
from rtmap_cli.logs.semantic import CLASSES, Window
from rtmap_cli.steps.semantic.evidence import Weighting, read_confusion
from rtmap_cli.steps.semantic.labels import Labels, read_labels
from rtmap_cli.steps.semantic.masks import MaskFolder, Masks
from rtmap_cli.steps.semantic.observe import Observer, has_sweeps, rig_of
from rtmap_cli.steps.semantic.raster import Raster
from rtmap_cli.steps.semantic.segmenter import Segmenter
from rtmap_cli.steps.semantic.trajectory import given_poses, initial_trajectory
from rtmap_cli.steps.semantic.write import (
    write_cells,
    write_info,
    write_tiles,
    write_window,
    write_windows_table,
)

Array = NDArray[np.float64]
Shown = Callable[[Iterable[int], int], Iterable[int]]


@dataclass(frozen=True)
class Settings:
    """Options of `rtmap semantic-map`; metres, seconds. ``windows``: ``past`` (what had been seen
    up to each frame), ``all`` (the whole drive) or ``none``."""

    masks: Path | None = None
    segmenter: Path | None = None
    labels: Path | None = None
    confusion: Path | None = None
    poses: Path | None = None
    cell: float = 0.2
    half_x: float = 36.0
    half_y: float = 18.0
    windows: str = "past"
    reach: float = 40.0
    distance: float = 20.0
    intensity: float = 0.5
    max_delay: float = 0.2
    ground_plane: bool = False
    threads: int | None = None


def open_masks(log: Log, settings: Settings) -> tuple[Masks, Labels]:
    """The source of masks that the settings name, by default the log's own folder ``masks``."""
    rig = rig_of(log)
    if settings.segmenter is not None:
        if settings.labels is None:
            raise BadInput(
                settings.segmenter, "what its labels mean is not known", "give --labels FILE"
            )
        labels = read_labels(settings.labels)
        return Segmenter(settings.segmenter, labels, settings.threads), labels
    folder = settings.masks or (log.path if log.path.is_dir() else log.path.parent) / "masks"
    if not folder.is_dir():
        raise BadInput(
            folder, "no such folder of masks", "give --masks DIR, or --segmenter MODEL.onnx"
        )
    file = settings.labels or folder / "labels.json"
    if not file.exists():
        raise BadInput(file, "no such label list", "give --labels FILE")
    labels = read_labels(file)
    return MaskFolder(folder, labels, rig), labels


class Builder:
    """Builds the raster of a log frame by frame; `write` lays it into an empty folder."""

    def __init__(self, log: Log, settings: Settings) -> None:
        masks, self.labels = open_masks(log, settings)
        weighting = Weighting(settings.distance, settings.intensity)
        if settings.confusion is not None:
            weighting = replace(weighting, confusion=read_confusion(settings.confusion))
        self.log, self.settings, self.weighting = log, settings, weighting
        self.frames: list[Frame] = list(log.frames())
        if settings.poses is not None:
            self.poses, self.source = given_poses(settings.poses, self.frames), str(settings.poses)
        else:
            self.poses, self.source = initial_trajectory(self.frames)
        self.plane = settings.ground_plane or not has_sweeps(self.frames)
        self.observer = Observer(
            log, masks, weighting, settings.reach, settings.max_delay, self.plane
        )
        self.raster = Raster(settings.cell)
        self.window = Window(settings.half_x, settings.half_y, settings.cell)
        self._rows: list[tuple[int, int, int, str]] = []
        self._used: list[int] = []
        self._seen = np.zeros(len(CLASSES), np.int64)
        self._unused = 0

    def add(self, k: int) -> int:
        """Lay down frame ``k``; returns the number of its points (0: no sweep or no mask)."""
        sweep = self.observer.sweep(self.frames, k)
        views = self.observer.views(self.frames, k) if sweep else []
        if sweep is None or not views:
            self._unused += 1
            return 0
        points = self.observer.observe(sweep, views)
        self._seen += np.bincount(points.classes, minlength=len(CLASSES))
        xyz = transform(self.poses[k], points.xyz.astype(np.float64))
        self.raster.add(xyz, points.classes, points.weight)
        return len(xyz)

    def write(self, folder: Path, shown: Shown) -> dict[str, Any]:
        """Read every frame and write the whole folder; returns what was done."""
        counts: dict[int, int] = {}
        for k in shown(range(len(self.frames)), len(self.frames)):
            counts[k] = self.add(k)
            if self.settings.windows == "past":
                self._cut(folder, k, counts[k])
        if not self.raster.tiles:
            raise NoAnswer(f"{self.log.path}: no point of the ground has a class in any mask")
        if self.settings.windows == "all":
            for k, count in counts.items():
                self._cut(folder, k, count)
        crs = self.log.crs
        if self.settings.windows != "none":
            write_windows_table(folder, crs, self._rows, self.poses[self._used])
        cells = write_cells(folder, crs, self.raster, self.weighting)
        track = self.poses[:, :2, 3]
        tiles = write_tiles(folder, crs, self.raster, self.weighting, track)
        result = {
            "frames": len(self.frames), "windows": len(self._rows), "unused": self._unused,
            "points": dict(zip(CLASSES, self._seen.tolist(), strict=True)),
            "cells": cells, "tiles": tiles, "poses": self.source,
            "points_from": "ground plane" if self.plane else "LiDAR",
            "labels": len(self.labels), "notes": self.notes(),
        }  # fmt: skip
        said = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self.settings).items()}
        said["confusion"] = self.weighting.confusion.round(6).tolist()
        write_info(
            folder, self.log.log_id, crs, self.window, self.settings.cell,
            {"command": "rtmap semantic-map", "log": str(self.log.path), **said, "result": result},
        )  # fmt: skip
        return result

    def _cut(self, folder: Path, k: int, points: int) -> None:
        """Write the ego window of frame ``k`` from what the raster knows now."""
        planes = self.raster.window(self.window, self.poses[k], self.weighting)
        frame = self.frames[k]
        path = write_window(folder, frame.index, planes)
        self._rows.append((frame.index, frame.timestamp_ns, points, path))
        self._used.append(k)

    def notes(self) -> list[str]:
        """What was assumed or left out, one sentence each."""
        out = notes_of(self.log)
        if self.plane:
            how = "as asked for" if self.settings.ground_plane else "the log has no sweep"
            out.append(f"points of the plane under the vehicle, not of a LiDAR: {how}")
        if self._unused:
            out.append(f"{self._unused} frames without a sweep or without masks gave nothing")
        return out
