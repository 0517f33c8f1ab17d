"""rtmap evaluate changes: found, missed and false changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtmap_cli import options


@click.command("changes")
@click.argument("changes", type=options.PATH)
@click.option("--truth", type=options.PATH, required=True, help="The true changes.")
@click.option(
    "--min-probability",
    type=options.FiniteRange(0, 1),
    default=0.0,
    show_default=True,
    help="Leave out detected changes that are less probable.",
)
@click.option("--km", type=options.FiniteRange(0, min_open=True), help="Kilometres driven.")
@click.option("--poses", help="Poses of the drives: false changes per km, frame-level accuracy.")
@click.option("--traversal", help="Which drive of a fleet poses file (default: all).")
@click.option(
    "--fail-under",
    multiple=True,
    metavar="NAME=VALUE",
    help="Exit 1 when precision, recall or f1 is lower. May be repeated.",
)
@options.as_json
def command(
    changes: Path,
    truth: Path,
    min_probability: float,
    km: float | None,
    poses: str | None,
    traversal: str | None,
    fail_under: tuple[str, ...],
    as_json: bool,
) -> None:
    """Compare detected CHANGES (GeoJSON or a run) with the true ones.

    A change is found when kind and class agree and the place does: crossings overlap by 30 %
    (intersection over union); of lines, half of the true stretch lies within 1 m of the detected
    one and the other way round. CHANGES and --truth may also be scenes with per-frame answers.

    \b
    Example:
      rtmap evaluate changes changes.geojson --truth town/changes.json --km 1.2
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.output import emit
    from rtmap_cli.steps.evaluate.drives import read_drives
    from rtmap_cli.steps.evaluate.judge import judge_changes, judge_scenes
    from rtmap_cli.steps.evaluate.limits import check_limits, check_names, parse_limits
    from rtmap_cli.tables import read_json

    if traversal is not None and poses is None:
        raise UsageError("--traversal names a drive of --poses: pass both")
    limits = parse_limits(fail_under)
    check_names(limits, ("precision", "recall", "f1", "acc_changed", "acc_unchanged", "macc"))
    if not changes.is_dir() and "scenes" in (read_json(changes) or ()):
        result = judge_scenes(changes, truth)
        emit(result, as_json, _frame_lines(result))
    else:
        drives = read_drives(poses, traversal) if poses else []
        result = judge_changes(changes, truth, min_probability, drives, km)
        emit(result, as_json, _lines(result))
        result = result.get("frame_level", {}) | result
    check_limits(limits, {name: result.get(name) for name in limits})


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _frame_lines(result: dict[str, Any]) -> list[str]:
    return [
        f"frames {result['frames']} ({result['changed_frames']} changed): accuracy of changed "
        f"{_share(result['acc_changed'])}, of unchanged {_share(result['acc_unchanged'])}, "
        f"mAcc {_share(result['macc'])}"
    ]


def _lines(result: dict[str, Any]) -> list[str]:
    from rtmap_cli.output import table

    rows = [[name, *counts.values()] for name, counts in result["by_kind_and_class"].items()]
    rows.append(["all", result["found"], result["missed"], result["false"]])
    out = table(["change", "found", "missed", "false"], rows)
    out.append(f"precision {_share(result['precision'])}, recall {_share(result['recall'])}")
    if "false_per_km" in result:
        out.append(f"{result['false_per_km']:.2f} false changes per km ({result['km']:.2f} km)")
    if "frame_level" in result:
        out += _frame_lines(result["frame_level"])
    return out
