"""rtmap evaluate poses: lateral, longitudinal and yaw errors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.steps.evaluate.gates.limits import Figure


@click.command("poses")
@click.argument("run", type=options.PATH)
@click.option(
    "--truth", required=True, help="True poses: simulated or AV2 log, poses table, fleet poses."
)
@click.option("--traversal", help="Which drive of a fleet poses file (default: by the log id).")
@click.option("--initial", is_flag=True, help="Judge the initial poses, not the localized ones.")
@options.gates
def command(
    run: Path,
    truth: str,
    traversal: str | None,
    initial: bool,
    as_json: bool,
    **gate_options: Any,
) -> None:
    """Errors of the localized poses of RUN in the true vehicle's own frame.

    Mean and 90th percentile over the frames with an answer, the share of those frames, and how
    often the truth lies inside the stated 50 % and 90 % regions. RUN and --truth may also both
    be a JSON file of pose pairs (docs/evaluate.md).

    \b
    Example:
      rtmap evaluate poses runs/drive-00 --truth logs/drive-00
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.logs.run_files import read_run
    from rtmap_cli.output import emit
    from rtmap_cli.steps.evaluate.gates.gates import parse_gates
    from rtmap_cli.steps.evaluate.judge import judge_pairs, judge_poses

    gates = parse_gates(as_json, **gate_options)
    result: dict[str, Any]
    if run.name.endswith((".json", ".json.gz")):
        if traversal is not None:
            raise UsageError("--traversal names a drive of --truth, pose pairs have none")
        cases = judge_pairs(run, truth)
        result = {"cases": cases}
        lines = [line for name, case in cases.items() for line in (name, *_lines(case))]
        figures = {f"{n}.{k}": f for n, case in cases.items() for k, f in _figures(case).items()}
        frames = sum(case["n"] for case in cases.values())
    else:
        result = judge_poses(read_run(run), truth, traversal, initial).as_json()
        lines, figures, frames = _lines(result), _figures(result), result["frames"]
    verdict = gates.verdict("poses", result, figures, {"initial": initial, "frames": frames})
    emit(verdict.result, as_json, verdict.lines(lines))
    verdict.enforce()


def _figures(result: dict[str, Any]) -> dict[str, Figure]:
    from rtmap_cli.steps.evaluate.gates.limits import Figure

    out = {
        f"{axis}.{name}": Figure(result[axis][name], "lower")
        for axis in NAMES
        if axis in result
        for name in ("mean", "p90")
    }
    if "share_answered" in result:
        out["share_answered"] = Figure(result["share_answered"])
    if told := result.get("consistency"):
        out["nees"] = Figure(told["nees"], "neither", target=1.0)
        for region, shares in told["inside"].items():
            honest = float(region) / 100
            out[f"inside.{region}"] = Figure(shares["all"], "neither", target=honest)
    return out


NAMES = {
    "lateral_m": "lateral (m)",
    "longitudinal_m": "longitudinal (m)",
    "yaw_deg": "yaw (°)",
    "z_m": "z (m)",
    "roll_deg": "roll (°)",
    "pitch_deg": "pitch (°)",
}


def _lines(result: dict[str, Any]) -> list[str]:
    from rtmap_cli.output import table

    def show(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    rows = [
        [text, show(result[k]["mean"]), show(result[k]["p90"])]
        for k, text in NAMES.items()
        if k in result
    ]
    out = table(["error", "mean", "90 %"], rows)
    if "frames" in result:
        share = "" if result["share_answered"] is None else f" ({result['share_answered']:.1%})"
        out.append(f"{result['n']} of {result['frames']} frames have an answer{share}")
    if result.get("consistency"):
        out += _consistency(result["consistency"])
    return out


def _consistency(told: dict[str, Any]) -> list[str]:
    shares = ", ".join(f"{v['all']:.1%} in the {k} % region" for k, v in told["inside"].items())
    interval = told["nees_interval"]
    alike, alone = ("{:.2f} … {:.2f}".format(*interval[k]) for k in ("correlated", "independent"))
    return [
        f"truth: {shares}",
        f"covariances: {told['verdict']}; χ² per degree of freedom {told['nees']:.2f}, of honest "
        f"ones in {interval['level']:.0%} of the cases {alike}",
        f"  (frames err alike: these {told['n']} are worth {interval['n_effective']:.1f} "
        f"independent ones; were they independent, {alone})",
    ]
