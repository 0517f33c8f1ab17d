"""rtmap evaluate map: average precision of runs, maps and result files."""

from __future__ import annotations

from typing import Any

import click

from rtmap_cli import options

PROTOCOLS = ("rtmap", "maptr", "streammapnet")


@click.command("map")
@click.argument("pred", type=str)
@click.option("--truth", required=True, help="A map, a run, or a JSON file of frames.")
@click.option(
    "--protocol",
    type=click.Choice(PROTOCOLS),
    default="rtmap",
    show_default=True,
    help="Whose evaluator to reproduce (rtmap: MapTR's at 72 x 36 m).",
)
@click.option("--poses", help="Poses along which maps are cropped: run, log, fleet poses, table.")
@click.option("--traversal", help="Which drive of a fleet poses file (default: all).")
@click.option("--thresholds", default="0.5,1.0,1.5", show_default=True, help="Distances in metres.")
@click.option("--classes", help="Classes, comma separated (default: those of TRUTH).")
@click.option(
    "--range",
    "size",
    type=float,
    nargs=2,
    help="Length and width (m) to which maps are cropped, vehicle in the middle.",
)
@click.option(
    "--every", type=click.IntRange(1), default=1, show_default=True, help="Every N-th frame."
)
@click.option(
    "--cells",
    type=options.FiniteRange(1),
    help="Compare two maps as a whole, by cells of this edge (m), not by frames.",
)
@click.option("--by", type=click.Choice(["scenario"]), help="Also AP per scenario of the frames.")
@click.option(
    "--scenario-map", help="The map that tells scenarios, where --truth is not one (with --poses)."
)
@click.option(
    "--bootstrap",
    type=click.IntRange(0),
    default=0,
    metavar="N",
    help="95 % intervals from N draws of blocks of frames.",
)
@click.option(
    "--block",
    type=click.IntRange(1),
    default=20,
    show_default=True,
    help="Consecutive frames of a log in a block.",
)
@options.seed
@click.option("--shape", is_flag=True, help="Also smoothness and topology (not part of mAP).")
@click.option(
    "--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes; same answer."
)
@options.map_version
@options.leak_check
@options.gates
def command(
    pred: str,
    truth: str,
    protocol: str,
    poses: str | None,
    traversal: str | None,
    thresholds: str,
    classes: str | None,
    size: tuple[float, float] | None,
    every: int,
    cells: float | None,
    by: str | None,
    scenario_map: str | None,
    bootstrap: int,
    block: int,
    seed: int,
    shape: bool,
    jobs: int,
    map_version: int | None,
    trained_on: tuple[str, ...],
    fail_on_leak: bool,
    max_leak: float,
    as_json: bool,
    **gate_options: Any,
) -> None:
    """Average precision of PRED.

    PRED and --truth are each a run, a map (cropped along --poses), the frames JSON of
    docs/evaluate.md, or the result file of MapTR, MapTRv2 or StreamMapNet. Elements of a predicted
    map are scored by their probability to exist.

    \b
    Example:
      rtmap evaluate map runs/drive-00 --truth town --poses logs/drive-00
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.output import emit, log
    from rtmap_cli.steps.evaluate.drives import read_drives
    from rtmap_cli.steps.evaluate.gates.gates import parse_gates
    from rtmap_cli.steps.evaluate.gates.leak import check_leak
    from rtmap_cli.steps.evaluate.maps.compare import (
        Settings,
        compare_frames,
        range_of,
        read_side,
    )
    from rtmap_cli.steps.evaluate.maps.report import Wanted, report, scenario_labels

    gates = parse_gates(as_json, **gate_options)
    if traversal is not None and poses is None:
        raise UsageError("--traversal names a drive of --poses: pass both")
    if (by or scenario_map) and (poses is None or cells):
        raise UsageError("scenarios are those of frames of a drive: pass --poses, and no --cells")
    drives = read_drives(poses, traversal) if poses else []
    settings = Settings(
        protocol=protocol,
        thresholds=parse_thresholds(thresholds),
        classes=[c.strip() for c in classes.split(",")] if classes else None,
        range_m=(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2) if size else None,
        every=every,
        cell=cells,
        shape=shape,
        jobs=jobs,
    )
    sides = read_side(pred, True, drives, map_version), read_side(truth, False, drives)
    box = range_of(*sides, settings)
    leak = check_leak(pred, truth, drives, box, trained_on, fail_on_leak)
    compared = compare_frames(*sides, drives, settings)
    labels = None
    if by:
        source = read_side(scenario_map, False, drives) if scenario_map else sides[1]
        labels = scenario_labels(compared, drives, source)
    found = report(compared, Wanted(labels, bootstrap, block, seed, shape))
    for note in found.notes:
        log(f"rtmap: {note}")
    result, leaked = found.result, leak.findings(max_leak) if leak else []
    if leak:
        result["leak"] = leak.as_json()
    if leak and (trained_on or fail_on_leak or leaked):
        log(f"rtmap: {leak.sentence()}")
    stated = {"range_m": {"x": box[::2], "y": box[1::2]}, "every": every, "cells": cells}
    verdict = gates.verdict(
        "map", result, found.figures, found.settings | stated, leaked if fail_on_leak else ()
    )
    emit(verdict.result, as_json, verdict.lines(found.lines()))
    verdict.enforce()
    if leak and fail_on_leak:
        leak.require_answer()


def parse_thresholds(text: str) -> list[float]:
    """Comma-separated metres, rising; UsageError when one is not a positive number."""
    from rtmap_cli.errors import UsageError

    try:
        values = sorted({float(t) for t in text.split(",")})
    except ValueError:
        values = []
    if not values or not all(0 < v < float("inf") for v in values):
        raise UsageError(f"--thresholds {text}: expected metres, e.g. 0.5,1.0,1.5")
    return values
