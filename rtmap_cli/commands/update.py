"""rtmap update: what accumulated predictions say of a map, cell by cell."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.logs.traversal import Traversal
    from rtmap_cli.maps.element import Element, VectorMap
    from rtmap_cli.maps.evidence import Policy
    from rtmap_cli.steps.crowdsource.fuse import Fusion
    from rtmap_cli.steps.update.cells import Detection
    from rtmap_cli.steps.update.settings import Settings
    from rtmap_cli.steps.update.update import Update


@click.command("update")
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=options.PATH)
@options.map_path
@options.map_version
@options.output("GeoJSON file of changes to write; - for stdout.")
@click.option(
    "--report", type=options.PATH, help="Folder for heat maps and cells: pictures and GeoParquet."
)
@click.option(
    "--grid", type=options.FiniteRange(0.1, 2), default=0.5, show_default=True,
    help="Side (m) of a cell of the accumulation grids.",
)  # fmt: skip
@click.option(
    "--cell", type=options.FiniteRange(4, 500), default=18.0, show_default=True,
    help="Side (m) of the cells that the map is split into.",
)  # fmt: skip
@click.option(
    "--max-ap", type=options.FiniteRange(0, 1), default=0.95, show_default=True,
    help="Cells in which old and new agree less (average precision) are candidates.",
)  # fmt: skip
@click.option(
    "--min-probability", type=options.FiniteRange(0, 1), default=0.5, show_default=True,
    help="Leave out less probable changes.",
)  # fmt: skip
@click.option(
    "--drives", type=click.IntRange(1), default=2, show_default=True,
    help="Drives that must agree, where there are so many.",
)  # fmt: skip
@options.class_names
@click.option("--fail-on-change", is_flag=True, help="Exit 1 when a cell is flagged.")
@options.overwrite
@options.as_json
def command(
    runs: tuple[Path, ...],
    map_path: Path,
    map_version: int | None,
    output: Path,
    report: Path | None,
    grid: float,
    cell: float,
    max_ap: float,
    min_probability: float,
    drives: int,
    class_names: tuple[str, ...],
    fail_on_change: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Accumulate the predictions of RUNs, flag the cells of the map that differ, tell the changes.

    A RUN is a run folder or a folder of them. Predictions become a confidence grid per class, its
    skeleton lines and outlines; where these agree little with the map, stretches that are missing
    or moved become changes, and everything else of the map is kept. The file of changes is reviewed
    with `rtmap map review` and made with `rtmap map apply`.

    \b
    Example:
      rtmap update runs --map map -o changes.geojson --report report
    """
    from rtmap_cli.errors import Findings, UsageError
    from rtmap_cli.formats.changes import write_changes
    from rtmap_cli.logs.agreement import warning
    from rtmap_cli.logs.traversal import find_runs, read_traversals
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.output import log
    from rtmap_cli.steps.update.report import write_report
    from rtmap_cli.steps.update.settings import Settings
    from rtmap_cli.steps.update.update import update
    from rtmap_cli.tables import refuse_existing, refuse_inside, refuse_over

    stream = str(output) == "-"
    if stream and as_json:
        raise UsageError("--json and -o - both want stdout: choose one")
    if not stream:
        refuse_inside(output, map_path, *runs)
        refuse_existing(output, overwrite)
    if report is not None:
        refuse_over(report, map_path, *runs)
        refuse_existing(report, overwrite)
    old = read_map(map_path, map_version)
    paths = [p for folder in runs for p in find_runs(folder)]
    traversals, _ = read_traversals(paths, old.crs)
    classes = _classes(paths, old, class_names, map_path)
    if doubt := warning(traversals, old, map_path):
        log(doubt)
    settings = Settings(
        grid_m=grid, cell_m=cell, max_ap=max_ap, min_probability=min_probability, drives=drives
    )
    found = update(traversals, old, classes, precision, settings)
    info = {
        "map": str(map_path),
        "map_version": old.version,
        "crs_of_map": old.crs,
        "runs": [t.run_id for t in traversals],
        "grid_m": grid,
        "cell_m": cell,
        "max_ap": max_ap,
        "min_probability": min_probability,
    }
    if report is not None:
        write_report(found, old, settings, report, overwrite)
    write_changes(found.events, old.crs, output, info, found.reasons)
    _tell(found, info, output, settings, as_json)
    flagged = sum(c.flagged for c in found.cells)
    if fail_on_change and flagged:
        raise Findings(f"{flagged} cells are flagged")


def precision(pred: Sequence[Detection], true: Sequence[Detection]) -> dict[str, float]:
    """Average precision by class of what is true, mean over the usual thresholds: here the rooms
    of update and evaluation meet."""
    from rtmap_cli.steps.evaluate.maps.precision import Scorer

    scorer = Scorer(sorted({e[0] for e in true}))
    scorer.add(pred, true)
    return {name: score.mean for name, score in scorer.result().classes.items()}


def fuse_region_grid(
    traversals: Sequence[Traversal],
    prior: VectorMap,
    classes: Sequence[str],
    fused: Collection[str],
    common: float = 0.0,
    policy: Policy | None = None,
) -> tuple[Fusion, list[Element]]:
    """One region fused by accumulation grids: `crowdsource --method grid`. Runs that were ``fused``
    before are witnesses like others; ``common`` is the variance (m²) of the place that all of them
    share; of a policy it takes how many drives must agree."""
    from rtmap_cli.steps.crowdsource.fuse import Fusion
    from rtmap_cli.steps.update.fusion import fuse_grid
    from rtmap_cli.steps.update.settings import Settings

    settings = Settings(drives=policy.insert_traversals) if policy else Settings()
    g = fuse_grid(traversals, prior, classes, precision, settings, common)
    return Fusion(g.vector_map, g.inserted, g.deleted, g.split, g.moved, g.untouched), []


def _classes(
    paths: Sequence[Path], old: VectorMap, wanted: tuple[str, ...], map_path: Path
) -> list[str]:
    """The classes to update; BadInput when runs and map disagree on what there is."""
    from rtmap_cli.errors import BadInput
    from rtmap_cli.logs.run_files import read_run_info

    known = {path: [str(c) for c in read_run_info(path)["classes"]] for path in paths}
    first = next(iter(known))
    for path, names in known.items():
        missing = sorted(set(wanted) - set(names))
        if missing:
            what = f"its model does not know {missing[0]} (it knows {', '.join(names)})"
            raise BadInput(path / "run.json", what, "leave the run or the class out")
        if not wanted and set(names) != set(known[first]):
            what = f"its classes are {', '.join(names)}, those of {first.name} are "
            todo = "pass --class for those that all of them know"
            raise BadInput(path / "run.json", what + ", ".join(known[first]), todo)
    unknown = sorted({e.class_name for e in old} - set(known[first]))
    if unknown and not wanted:
        what = f"its model knows {', '.join(known[first])}, {map_path} also has {unknown[0]}"
        todo = "pass --class for the classes to update"
        raise BadInput(first / "run.json", what, todo)
    return list(wanted) or known[first]


def _tell(
    found: Update, info: dict[str, Any], output: Path, settings: Settings, as_json: bool
) -> None:
    from rtmap_cli.output import emit, log, table

    counts = {
        kind: sum(e.kind == kind for e in found.events) for kind in ("delete", "insert", "modify")
    }
    flagged = [c for c in found.cells if c.flagged]
    told = ", ".join(f"{n} {kind}" for kind, n in counts.items())
    if not as_json:
        log(
            f"{info['map']}: {told}; {len(flagged)} of {len(found.cells)} cells of "
            f"{settings.cell_m:g} m flagged"
        )
    if str(output) == "-":
        return
    cells = [
        {
            "low": list(c.low),
            "ap": c.ap,
            "classes": c.classes,
            "reason": c.reason or None,
            "flagged": c.flagged,
            "observed": c.observed,
        }
        for c in found.cells
    ]
    changes = [e.properties() | {"reason": found.reasons[e.change_id]} for e in found.events]
    result = info | {"output": str(output), "counts": counts, "flagged": len(flagged)}
    rows: list[list[Any]] = [
        [
            e.kind,
            e.class_name,
            e.element_id or "-",
            found.reasons[e.change_id],
            f"{e.probability:.3f}",
            f"{e.counts.traversals_seen} of {e.counts.traversals_in_view} runs",
        ]
        for e in found.events
    ]
    header = ["change", "class", "element", "reason", "probability", "found by"]
    lines = table(header, rows) if rows else ["no changes"]
    emit(result | {"cells": cells, "changes": changes}, as_json, lines)
