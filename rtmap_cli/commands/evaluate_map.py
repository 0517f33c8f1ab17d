"""rtmap evaluate map: average precision of runs, maps and result files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.steps.evaluate.precision import MapScore

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
@options.map_version
@click.option(
    "--fail-under",
    multiple=True,
    metavar="NAME=VALUE",
    help="Exit 1 when a figure is lower: mAP=0.5, AP.divider=0.6. May be repeated.",
)
@options.as_json
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
    map_version: int | None,
    fail_under: tuple[str, ...],
    as_json: bool,
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
    from rtmap_cli.steps.evaluate.compare import Settings, compare, missing_frames, read_side
    from rtmap_cli.steps.evaluate.drives import read_drives
    from rtmap_cli.steps.evaluate.limits import check_limits, check_names, parse_limits

    if traversal is not None and poses is None:
        raise UsageError("--traversal names a drive of --poses: pass both")
    limits = parse_limits(fail_under)
    drives = read_drives(poses, traversal) if poses else []
    settings = Settings(
        protocol=protocol,
        thresholds=parse_thresholds(thresholds),
        classes=[c.strip() for c in classes.split(",")] if classes else None,
        range_m=(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2) if size else None,
        every=every,
        cell=cells,
    )
    sides = read_side(pred, True, drives, map_version), read_side(truth, False, drives)
    score = compare(*sides, drives, settings)
    figures = {"mAP": score.mAP} | {f"AP.{name}": c.mean for name, c in score.classes.items()}
    check_names(limits, list(figures))
    if score.without_truth:
        names = ", ".join(score.without_truth)
        log(f"rtmap: no true element of {names}: its AP is 0 by the protocol's rule")
    lacking = missing_frames(*sides)
    if lacking:
        log(f"rtmap: {pred} lacks {lacking} frames of {truth}: they count as empty")
    emit(score.as_json(), as_json, _lines(score))
    check_limits(limits, dict(figures))


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


def _lines(score: MapScore) -> list[str]:
    from rtmap_cli.output import table

    thresholds = [str(t) for t in next(iter(score.classes.values())).ap]
    rows = [
        [name, *(f"{v:.4f}" for v in c.ap.values()), f"{c.mean:.4f}", c.num_gt, c.num_pred]
        for name, c in score.classes.items()
    ]
    header = ["class", *(f"AP@{t}" for t in thresholds), "AP", "true", "predicted"]
    return [*table(header, rows), f"mAP {score.mAP:.4f} ({score.protocol}, {score.frames} frames)"]
