"""rtmap evaluate changes: found, missed and false changes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.steps.evaluate.gates.limits import Figure


@click.command("changes")
@click.argument("changes", metavar="CHANGES...", nargs=-1, required=True, type=options.PATH)
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
@options.gates
def command(
    changes: tuple[Path, ...],
    truth: Path,
    min_probability: float,
    km: float | None,
    poses: str | None,
    traversal: str | None,
    as_json: bool,
    **gate_options: Any,
) -> None:
    """Compare detected CHANGES (GeoJSON or a run) with the true ones.

    A change is found when kind and class agree and the place does: crossings overlap by 30 %
    (intersection over union); of lines, half of the true stretch lies within 1 m of the detected
    one and the other way round. Several CHANGES, in order, are what was told after ever more
    drives: the last one is judged, and how many drives each true change took. CHANGES and --truth
    may also be scenes with per-frame answers.

    \b
    Example:
      rtmap evaluate changes changes.geojson --truth town/changes.json --poses logs/monday
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.output import emit
    from rtmap_cli.steps.evaluate.changes.sight import sight_of
    from rtmap_cli.steps.evaluate.drives import read_drives
    from rtmap_cli.steps.evaluate.gates.gates import parse_gates
    from rtmap_cli.steps.evaluate.judge import judge_changes, judge_scenes
    from rtmap_cli.tables import read_json

    if traversal is not None and poses is None:
        raise UsageError("--traversal names a drive of --poses: pass both")
    gates = parse_gates(as_json, **gate_options)
    if len(changes) == 1 and not changes[0].is_dir() and "scenes" in (read_json(changes[0]) or ()):
        result = judge_scenes(changes[0], truth)
        lines = _frame_lines({"frame_level": result})
        settings = {"protocol": result["protocol"], "frames": result["frames"]}
    else:
        drives = read_drives(poses, traversal) if poses else []
        sight = sight_of(poses) if poses else None
        result = judge_changes(changes, truth, min_probability, drives, km, sight)
        lines = _lines(result)
        settings = {
            "min_probability": min_probability,
            "files": len(changes),
            "true_changes": result["found"] + result["missed"],
            "frames": result.get("frame_level", {}).get("frames"),
        }
    verdict = gates.verdict("changes", result, _figures(result), settings)
    emit(verdict.result, as_json, verdict.lines(lines))
    verdict.enforce()


def _figures(result: dict[str, Any]) -> dict[str, Figure]:
    from rtmap_cli.steps.evaluate.gates.limits import Figure

    frames = result.get("frame_level", result)
    shares = ("precision", "recall", "f1", "ap")
    out: dict[str, Figure] = {k: Figure(result[k]) for k in shares if k in result}
    if "false_per_km" in result:
        out["false_per_km"] = Figure(result["false_per_km"], "lower")
    names = ("acc_changed", "acc_unchanged", "macc")
    out |= {k: Figure(frames[k]) for k in names if k in frames}
    visible = result.get("frame_level_visible", {})
    out |= {f"visible.{k}": Figure(visible[k]) for k in names if k in visible}
    for name in ("first", "stays"):
        if times := result.get("time_to_detection", {}).get(name):
            out[f"{name}.mean"] = Figure(times["mean"], "lower")
            out[f"{name}.never"] = Figure(times["never"], "lower")
    return out


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _frame_lines(result: dict[str, Any]) -> list[str]:
    from rtmap_cli.output import table

    rows = []
    for name in ("frame_level", "frame_level_visible"):
        if level := result.get(name):
            shares = (_share(level[k]) for k in ("acc_changed", "acc_unchanged", "macc"))
            rows.append([level["protocol"], level["frames"], level["changed_frames"], *shares])
    lines = table(["frame by frame", "frames", "changed", "Acc_c", "Acc_r", "mAcc"], rows)
    if visible := result.get("frame_level_visible"):
        lines.append(f"visible: {visible['visible']}")
    return lines


def _lines(result: dict[str, Any]) -> list[str]:
    from rtmap_cli.output import table

    rows = [[name, *counts.values()] for name, counts in result["by_kind_and_class"].items()]
    rows.append(["all", result["found"], result["missed"], result["false"]])
    out = table(["change", "found", "missed", "false"], rows)
    names = {"precision": "precision", "recall": "recall", "f1": "F1", "ap": "AP"}
    told = ", ".join(f"{text} {_share(result[k])}" for k, text in names.items())
    if result["curve"]:
        told += f" (thresholds down to {result['curve'][-1]['threshold']:.2f})"
    out.append(told)
    if "false_per_km" in result:
        out.append(f"{result['false_per_km']:.2f} false changes per km ({result['km']:.2f} km)")
    if "time_to_detection" in result:
        out += ["", *_time_lines(result["time_to_detection"])]
    if "frame_level" in result:
        out += ["", *_frame_lines(result)]
        if "frame_level_visible" not in result:
            out.append("(what was visible is not known: --poses is neither a run nor a log)")
    return out


def _time_lines(times: dict[str, Any]) -> list[str]:
    from rtmap_cli.output import table

    def show(value: float | None) -> str:
        return "never" if value is None else f"{value:g}"

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}".rstrip("0").rstrip(".")

    rows = [[a["traversals"], a["found"], a["missed"], a["false"]] for a in times["after"]]
    out = table([f"after drive ({times['files']})", "found", "missed", "false"], rows)
    named = [
        [f"{c['kind']} {c['class']}", c["element_id"] or "-", show(c["first"]), show(c["stays"])]
        for c in times["changes"]
    ]
    out += ["", *table(["true change", "element", "found after", "stays from"], named)]
    first, stays = times["first"], times["stays"]
    out.append(
        f"drives to the first detection: mean {number(first['mean'])} of those found, "
        f"{first['never']} never; to stay: mean {number(stays['mean'])}, {stays['never']} never"
    )
    return out
