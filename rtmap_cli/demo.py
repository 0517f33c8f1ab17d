"""The demo: a simulated town, an outdated map of it, drives, and what becomes of the map.

It calls the commands that a user would call, in this process, and reads their ``--json``.
"""

from __future__ import annotations

import contextlib
import io
import json
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtmap_cli.errors import RtmapError

CHANGES = ("delete:ped_crossing", "insert:ped_crossing", "delete:divider", "insert:divider")
PRIOR_SIGMA = 0.25
IMAGE_WIDTH = 256
GONE, NEW, DRIVEN = (215, 35, 35), (25, 150, 60), (205, 192, 226)


@dataclass
class Demo:
    """Folder, settings and a place to say what happens."""

    folder: Path
    frames: int
    model: str
    seed: int
    say: Callable[[str], None]

    def rtmap(self, *arguments: object) -> dict[str, Any]:
        """Run one command line with ``--json`` and return its result; shown on stderr."""
        from rtmap_cli.cli import run

        words = [str(a) for a in arguments]
        self.say("  rtmap " + shlex.join(w.replace(f"{self.folder}/", "") for w in words))
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run([*words, "--json"])
        if code:
            raise RtmapError(f"rtmap {' '.join(words)} ended with {code}: {err.getvalue().strip()}")
        result: dict[str, Any] = json.loads(out.getvalue().splitlines()[-1])
        return result


def run_demo(
    folder: Path,
    cycles: int,
    frames: int,
    model: str,
    seed: int,
    say: Callable[[str], None],
) -> tuple[dict[str, Any], list[str]]:
    """Run every cycle in ``folder``; returns the figures and the lines to print.

    Cycle n is one new drive: observed with the map of cycle n - 1 as prior, localized on it, and
    fused into the next version. Changes are told against the outdated map by all drives so far.
    """
    from rtmap_cli.output import table

    started = time.perf_counter()
    demo = Demo(folder, frames, model, seed, say)
    prepare(demo, cycles)
    before = score_map(demo)
    rows = [_row("prior", before, None, None)]
    figures: list[dict[str, Any]] = [{"cycle": 0, "map": before}]
    for cycle in range(1, cycles + 1):
        say(f"cycle {cycle}")
        poses, changes = drive_once(demo, cycle)
        after = score_map(demo)
        rows.append(_row(f"cycle {cycle}", after, poses, changes))
        figures.append({"cycle": cycle, "map": after, "poses": poses, "changes": changes})
    draw(demo, cycles)
    header = (
        "map after", "mAP", "crossing", "divider", "boundary",
        "lateral m", "longitudinal m", "yaw °", "found", "missed", "false",
    )  # fmt: skip
    seconds = time.perf_counter() - started
    lines = [
        *table(header, rows),
        "",
        "mAP of the map against the world along drive 1, strict thresholds 0.2, 0.5, 1.0 m;",
        f"changes found, missed, false out of {len(CHANGES)}; simulated images; {seconds:.0f} s.",
    ]
    lines += ["", *reported(demo)]
    return {"cycles": figures, "seconds": round(seconds, 1)}, lines


def prepare(demo: Demo, cycles: int) -> None:
    """The town as it is, the outdated map of it, what changed in between, and the drives."""
    f, seed = demo.folder, demo.seed
    demo.say("a town, an outdated map of it, and drives through it")
    demo.rtmap("simulate", "town", "--seed", seed, "-o", f / "town")
    specs = [word for change in CHANGES for word in ("--change", change)]
    for drive in range(1, cycles + 1):
        demo.rtmap(
            "simulate", "images", "--map", f / "town", "--log", "town:", "--drive", drive,
            "--frames", demo.frames, "--width", IMAGE_WIDTH, "--seed", seed, "-q",
            "-o", f / "logs" / f"drive-{drive}",
        )  # fmt: skip
    specs = [word for change in CHANGES for word in ("--change", change)]
    # Where every drive passes: a change needs two witnesses.
    near = [word for log in sorted((f / "logs").iterdir()) for word in ("--near", log)]
    demo.rtmap(
        "simulate", "changes", "--map", f / "town", "--outdate", *specs,
        *near, "--seed", seed, "-o", f / "stale",
        "--truth", f / "changes-truth.json",
    )  # fmt: skip
    demo.rtmap(
        "simulate", "degrade", "--map", f / "stale", "--sigma", PRIOR_SIGMA, "--seed", seed,
        "-o", f / "map",
    )  # fmt: skip
    demo.rtmap("export", "geojson", f / "map", "-o", f / "prior.geojson")


def drive_once(demo: Demo, cycle: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """One cycle: infer, localize, tell changes, judge them, fuse. Returns the two judgements."""
    f, name = demo.folder, f"drive-{cycle}"
    run, log = f / "runs" / name, f / "logs" / name
    demo.rtmap("infer", log, "--map", f / "map", "--model", demo.model, "-o", run, "-q")
    demo.rtmap("localize", run, "--map", f / "map", "--smooth")
    runs = sorted((f / "runs").iterdir())
    demo.rtmap(
        "detect-changes", *runs, "--map", f / "map", "--map-version", 0,
        "-o", f / "changes.geojson", "--overwrite",
    )  # fmt: skip
    demo.rtmap("crowdsource", f / "runs", "--map", f / "map", "--message", f"cycle {cycle}")
    poses = demo.rtmap("evaluate", "poses", run, "--truth", log)
    changes = demo.rtmap(
        "evaluate", "changes", f / "changes.geojson", "--truth", f / "changes-truth.json"
    )
    return poses, changes


def score_map(demo: Demo, version: int | None = None) -> dict[str, Any]:
    """AP of the map against the town along the first drive, strict thresholds."""
    f = demo.folder
    old = [] if version is None else ["--map-version", version]
    return demo.rtmap(
        "evaluate", "map", f / "map", *old, "--truth", f / "town",
        "--poses", f / "logs" / "drive-1", "--every", 2, "--thresholds", "0.2,0.5,1.0",
    )  # fmt: skip


def _row(
    name: str,
    score: dict[str, Any],
    poses: dict[str, Any] | None,
    changes: dict[str, Any] | None,
) -> tuple[str, ...]:
    def ap(class_name: str) -> str:
        values = score["classes"][class_name]["ap"].values()
        return f"{sum(values) / len(values):.3f}"

    cells = [name, f"{score['mAP']:.3f}", ap("ped_crossing"), ap("divider"), ap("boundary")]
    if poses is None or changes is None:
        return (*cells, *["-"] * 6)
    cells += [f"{poses[key]['mean']:.3f}" for key in ("lateral_m", "longitudinal_m", "yaw_deg")]
    return (*cells, *(str(changes[key]) for key in ("found", "missed", "false")))


def reported(demo: Demo) -> list[str]:
    """One line per change as detect-changes told it at the end."""
    content = json.loads((demo.folder / "changes.geojson").read_text(encoding="utf-8"))
    lines = []
    for feature in content["features"]:
        p = feature["properties"]
        what = p["element_id"] or "nothing like it on the old map"
        drives = f"{p['traversals_seen']} of {p['traversals_in_view']} drives"
        lines.append(
            f"reported: {p['kind']} {p['class']} ({what}), probability {p['probability']:.2f}, "
            f"found by {drives} that looked"
        )
    return lines or ["no change was reported"]


def draw(demo: Demo, cycles: int) -> None:
    """demo.png: the outdated map, the town and the result, with true and reported changes."""
    import numpy as np

    from rtmap_cli.formats.geojson import read_geojson
    from rtmap_cli.logs.native import NativeLog
    from rtmap_cli.maps.crop import MapIndex
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.steps.picture import Entry, Mark, Panel, draw_panels

    f = demo.folder
    paths = []
    for drive in range(1, cycles + 1):
        poses = NativeLog(f / "logs" / f"drive-{drive}").truth_poses()
        if poses is not None:
            paths.append(poses.pose[:, :2, 3])
    every = np.concatenate(paths)
    middle = (every.min(axis=0) + every.max(axis=0)) / 2
    half = float((every.max(axis=0) - every.min(axis=0)).max()) / 2 + 22.0
    bounds = (*(middle - half).tolist(), *(middle + half).tolist())

    def around(vector_map: VectorMap) -> VectorMap:
        near = MapIndex(vector_map).near(middle[0], middle[1], half)
        return VectorMap(near, vector_map.crs)

    town = read_map(f / "town")
    truth = read_changes_marks(f / "changes-truth.json", town.crs)
    told = read_changes_marks(f / "changes.geojson", town.crs)
    driven = [Mark(path, DRIVEN, 8) for path in paths]
    panels = [
        Panel("outdated map, true changes", around(read_geojson(f / "prior.geojson", town.crs)),
              truth, driven),
        Panel("the town", around(town), [], driven),
        Panel(f"map after {cycles} drives, reported changes, probability",
              around(read_map(f / "map")),
              told, driven),
    ]  # fmt: skip
    legend = [
        Entry("on the old map, gone from the town", GONE),
        Entry("in the town, not on the old map", NEW),
        Entry("driven", DRIVEN, 8),
    ]
    draw_panels(panels, bounds, legend=legend).save(f / "demo.png")


def read_changes_marks(path: Path, crs: str) -> list[Any]:
    """The geometries of a changes file (GeoJSON or truth JSON) as marks in the map frame."""
    import numpy as np

    from rtmap_cli.maps.crs import lonlat_to
    from rtmap_cli.steps.picture import Mark

    content = json.loads(path.read_text(encoding="utf-8"))
    items = content.get("changes")
    if items is None:
        items = [x["properties"] | {"geometry": x["geometry"]} for x in content["features"]]
    marks = []
    for item in items:
        shape = item["geometry"]
        line = shape["coordinates"][0] if shape["type"] == "Polygon" else shape["coordinates"]
        xy = lonlat_to(crs, np.asarray(line, dtype=np.float64)[:, :2])
        told = f"{item['probability']:.2f}" if "probability" in item else ""
        marks.append(Mark(xy, GONE if item["kind"] == "delete" else NEW, 5, told))
    return marks
