"""rtmap evaluate uncertainty: whether sigmas and probabilities are honest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.steps.evaluate.drives import Drive
    from rtmap_cli.steps.evaluate.gates.limits import Figure


@click.command("uncertainty")
@click.argument("pred", type=str)
@click.option("--truth", help="The true map: vertices, scores and existence.")
@click.option("--poses", help="True poses: log, poses table, fleet poses (needed for a run).")
@click.option("--traversal", help="Which drive of a fleet poses file (default: by the log id).")
@click.option(
    "--threshold",
    type=options.FiniteRange(0, min_open=True),
    default=1.5,
    show_default=True,
    help="A detection this near to a true element (Chamfer, m) is real.",
)
@options.map_version
@click.option("--plot", type=options.PATH, help="PNG of the calibration curves to write.")
@options.overwrite
@options.gates
def command(
    pred: str,
    truth: str | None,
    poses: str | None,
    traversal: str | None,
    threshold: float,
    map_version: int | None,
    plot: Path | None,
    overwrite: bool,
    as_json: bool,
    **gate_options: Any,
) -> None:
    """Are the uncertainties that PRED states honest?

    PRED is a run (vertex sigmas, scores, existence of prior elements, pose covariances) or a map
    (vertex covariances, existence). How often the truth lies inside the stated 50 % and 90 %
    regions, the likelihood of the truth, and whether what is said to be true in 80 % of the cases
    is. Runs are judged at the true --poses, maps where these had them in range.

    \b
    Example:
      rtmap evaluate uncertainty runs/drive-00 --truth town --poses logs/drive-00 --plot trust.png
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.logs.open import folder_of
    from rtmap_cli.output import emit
    from rtmap_cli.steps.evaluate.gates.gates import parse_gates
    from rtmap_cli.steps.evaluate.uncertainty.plot import write_plot
    from rtmap_cli.tables import refuse_existing, refuse_inside

    if traversal is not None and poses is None:
        raise UsageError("--traversal names a drive of --poses: pass both")
    if plot is not None:
        if plot.suffix.lower() != ".png":
            raise UsageError(f"--plot {plot}: the picture is a PNG, name it .png")
        refuse_inside(plot, *(folder_of(path) for path in (pred, truth, poses) if path))
        refuse_existing(plot, overwrite)
    gates = parse_gates(as_json, **gate_options)
    result = _judge(pred, truth, poses, traversal, threshold, map_version)
    if plot is not None:
        write_plot(result, plot)
    settings = {"threshold_m": threshold, "sections": sorted(result)}
    verdict = gates.verdict("uncertainty", result, _figures(result), settings)
    emit(verdict.result, as_json, verdict.lines(_lines(result)))
    verdict.enforce()


def _judge(
    pred: str,
    truth: str | None,
    poses: str | None,
    traversal: str | None,
    threshold: float,
    map_version: int | None,
) -> dict[str, Any]:
    from rtmap_cli.errors import UsageError
    from rtmap_cli.logs.run_files import read_run
    from rtmap_cli.steps.evaluate.drives import read_drives
    from rtmap_cli.steps.evaluate.uncertainty.judge import judge_map, judge_run

    if (Path(pred) / "run.json").exists():
        if poses is None:
            raise UsageError(f"{pred} is a run: pass the true poses with --poses")
        run = read_run(pred)
        drives = read_drives(poses, traversal) if truth else []
        true_map = _map(truth, drives) if truth else None
        return judge_run(run, true_map, poses, traversal, threshold)
    drives = read_drives(poses, traversal) if poses else []
    fused = _map(pred, drives, map_version)
    if truth is None:
        raise UsageError(f"{pred} is a map: pass the true map with --truth")
    return judge_map(fused, _map(truth, drives), drives, threshold)


def _map(path: str, drives: list[Drive], version: int | None = None) -> Any:
    from rtmap_cli.errors import BadInput
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.evaluate.maps.compare import read_side

    side = read_side(path, False, drives, version)
    if not isinstance(side, VectorMap):
        raise BadInput(path, "is no map", "uncertainties are judged of runs and maps, by a map")
    return side


POSES = {
    "poses": "localized poses",
    "initial_poses": "initial poses",
    "end_to_end_poses": "network's poses",
}
SHARES = {"scores": "scores", "existence": "existence"}


def _figures(result: dict[str, Any]) -> dict[str, Figure]:
    from rtmap_cli.steps.evaluate.gates.limits import Figure

    out: dict[str, Figure] = {}
    regions = {
        "vertices": result.get("vertices", {}).get("gaussian"),
        "vertices.laplace": result.get("vertices", {}).get("laplace"),
    }
    regions |= {name: result.get(name, {}).get("all") for name in POSES}
    for name, told in regions.items():
        if told:
            for region, share in told["coverage"].items():
                honest = float(region) / 100
                out[f"{name}.{region}"] = Figure(share, "neither", target=honest)
            out[f"{name}.nll"] = Figure(told["nll"], "lower")
            out[f"{name}.calibration_error"] = Figure(told["calibration_error"], "lower")
    for name in SHARES:
        told = result.get(name, {})
        out |= {
            f"{name}.{k}": Figure(told[k], "lower") for k in ("ece", "brier", "nll") if k in told
        }
    return out


def _lines(result: dict[str, Any]) -> list[str]:
    from rtmap_cli.output import table

    header = [
        "regions",
        "n",
        "50 % holds",
        "90 % holds",
        "NLL",
        "error rms",
        "sigma rms",
        "× sigma",
    ]
    rows = _vertex_rows(result.get("vertices", {})) + _pose_rows(result)
    out = table(header, rows) if rows else []
    if rows:
        out.append("± is 95 %; times the last column, sigma would have the size of the errors")
    if vertices := result.get("vertices"):
        told = vertices["elements"]
        out.append(
            f"vertices: of the {told['real']} of {told['real'] + told['not_real']} detections "
            f"within {vertices['threshold_m']:g} m of a true element, across its line; left out "
            f"{vertices['beyond_end']} beyond its end, {vertices['without_sigma']} without a sigma"
        )
    shares = [row for name in SHARES for row in _share_rows(name, result.get(name, {}))]
    if shares:
        header = ["probabilities", "n", "stated", "true", "ECE", "Brier", "of base rate", "NLL"]
        out += ["", *table(header, shares)]
    if silent := result.get("existence", {}).get("not_stated"):
        out.append(f"existence: of {silent} elements the map states none")
    for name in SHARES:
        if result.get(name, {}).get("n"):
            out += ["", *_bins(result[name])]
    return out


def _vertex_rows(vertices: dict[str, Any]) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for name, part in _parts("vertices", vertices):
        sizes = [f"{part[k]['rms']:.3f} m" for k in ("error_m", "sigma_m")]
        scale = f"{part['scale']['rms']:.2f}"
        rows.append([name, part["n"], *_cells(part["gaussian"]), *sizes, scale])
    if "laplace" in vertices:
        cells = _cells(vertices["laplace"])
        rows.append(["vertices, read as Laplace", vertices["n"], *cells, *rows[0][5:7], "-"])
    return rows


def _parts(name: str, whole: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """A section and its classes, those that have anything."""
    parts = [(name, whole), *((f"  {k}", v) for k, v in whole.get("by_class", {}).items())]
    return [(title, part) for title, part in parts if part.get("n")]


def _pose_rows(result: dict[str, Any]) -> list[list[Any]]:
    import math

    rows: list[list[Any]] = []
    for key, title in POSES.items():
        told = result.get(key, {})
        if not told.get("n"):
            continue
        n, whole = told["n"], told["all"]
        rows.append([title, n, *_cells(whole), "-", "-", f"{whole['scale']:.2f}"])
        for axis in ("lateral", "longitudinal", "yaw") if key == "poses" else ():
            part = told[axis]
            sizes, unit = [part["error_rms"], part["sigma_rms"]], "m"
            if axis == "yaw":
                sizes, unit = [math.degrees(v) for v in sizes], "°"
            told_sizes = [f"{v:.3f} {unit}" for v in sizes]
            rows.append([f"  {axis}", n, *_cells(part), *told_sizes, f"{part['scale']:.2f}"])
    return rows


def _cells(told: dict[str, Any]) -> list[str]:
    cells = []
    for region, share in told["coverage"].items():
        interval = told["interval_95"][region]
        half = "" if interval is None else f" ± {(interval[1] - interval[0]) / 2:.3f}"
        cells.append(f"{share:.3f}{half}")
    return [*cells, f"{told['nll']:.2f}"]


def _share_rows(name: str, told: dict[str, Any]) -> list[list[Any]]:
    names = ("mean_stated", "base_rate", "ece", "brier", "brier_of_base_rate", "nll")
    return [
        [title, part["n"], *(f"{part[k]:.3f}" for k in names)] for title, part in _parts(name, told)
    ]


def _bins(told: dict[str, Any]) -> list[str]:
    from rtmap_cli.output import table

    rows = [
        [f"{b['low']:.1f} … {b['high']:.1f}", b["n"], f"{b['stated']:.3f}", f"{b['true']:.3f}"]
        for b in told["bins"]
        if b["n"]
    ]
    return table([f"probability that {told['claim']}", "n", "stated", "true"], rows)
