"""Simulated drives over real maps that are out of date: what `rtmap update` is measured on.

Worlds are the maps of three Argoverse 2 logs (RTMAP_DATA), with changes made as `rtmap simulate
changes` makes them; drives and observations are simulated (presets rtmap-straight and
rtmap-turning), prior maps are off by 0.1 m, and every drive is localized on its outdated map.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.places import Place, av2_places, command
from benchmarks.common.worlds import drive_through, outdated
from rtmap_cli.maps.element import VectorMap
from rtmap_cli.maps.store import write_new_map
from rtmap_cli.steps.simulate.driving.routes import KINDS
from rtmap_cli.steps.simulate.worlds.changes import Change, parse_spec, truth_json
from rtmap_cli.steps.simulate.worlds.degrade import degrade_map

Array = NDArray[np.float64]

CHANGES = (
    "delete:ped_crossing",
    "insert:divider",
    "insert:ped_crossing",
    "delete:divider",
    "move:divider",
)
PER_WORLD = 4


@dataclass(frozen=True)
class UpdateWorld:
    """A world on disk: the place, what has changed since its prior map, the localized runs and the
    true poses (n, 3, 4) of each."""

    number: int
    place: Place
    kind: str
    changes: list[Change]
    folder: Path
    runs: list[Path]
    truths: list[Path]

    @property
    def prior(self) -> Path:
        """The outdated map."""
        return self.folder / "prior"

    @property
    def world(self) -> VectorMap:
        """What is true."""
        return self.place.world


@lru_cache
def places(data: Path) -> list[Place]:
    """The three maps."""
    return av2_places(data)


def make_world(number: int, data: Path, work: Path, drives: int) -> UpdateWorld:
    """A world with its drives; made where it is not there yet."""
    place, kind = places(data)[number % 3], KINDS[number % len(KINDS)]
    specs = [parse_spec(CHANGES[(number + k) % len(CHANGES)]) for k in range(PER_WORLD)]
    old, changes, keys = outdated(place, kind, number, number, specs, drives)
    folder = work / f"world-{number:02d}-{drives}"
    runs = [folder / "runs" / f"{n:02d}" for n in range(drives)]
    if not (folder / "done").exists():
        write_new_map(degrade_map(old, 0.1, number), folder / "prior", "outdated", overwrite=True)
        for key, run in zip(keys, runs, strict=True):
            drive_through(place, kind, key, run)
            command("localize", run, "--map", folder / "prior", "--smooth")
        truth = truth_json(changes, place.world.crs)
        (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
        (folder / "done").touch()
    truths = [run.with_name(f"{run.name}.truth") / "poses.parquet" for run in runs]
    return UpdateWorld(number, place, kind, changes, folder, runs, truths)
