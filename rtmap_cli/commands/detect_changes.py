"""rtmap detect-changes: tell what is gone from the map and what is new."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.formats.changes import ChangeEvent


@click.command("detect-changes")
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=options.PATH)
@options.map_path
@options.map_version
@options.output("GeoJSON file to write; - for stdout.")
@click.option("--policy", "policy_path", type=options.PATH, help="TOML file: votes and thresholds.")
@click.option(
    "--min-probability",
    type=options.FiniteRange(0, 1),
    help="Leave out less probable changes.  [default: 0.5]",
)
@click.option(
    "--max-false-alarms-per-km",
    type=options.FiniteRange(0),
    help="Tell the most probable changes, as many as this allows.",
)
@click.option("--displaced", is_flag=True, help="Also tell of lines that lie elsewhere (modify).")
@click.option("--fail-on-change", is_flag=True, help="Exit 1 when a change is found.")
@click.option(
    "--write-runs", is_flag=True, help="Also write RUN/changes.parquet: what each run says alone."
)
@options.overwrite
@options.as_json
def command(
    runs: tuple[Path, ...],
    map_path: Path,
    map_version: int | None,
    output: Path,
    policy_path: Path | None,
    min_probability: float | None,
    max_false_alarms_per_km: float | None,
    displaced: bool,
    fail_on_change: bool,
    write_runs: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Tell which elements of the map are gone and which it lacks, from one or more RUNs.

    Evidence is gathered per frame, put together per run (one vote), then over the runs: an element
    that was in view and not hidden but not found speaks for a delete, detections that match
    nothing for an insert. Parts of a line that are gone are told as parts. Runs are read with
    their localized poses where they have some.

    \b
    Example:
      rtmap detect-changes runs/monday runs/tuesday --map map -o changes.geojson
    """
    from rtmap_cli.errors import Findings, NoAnswer, UsageError
    from rtmap_cli.formats.changes import write_change_table, write_changes
    from rtmap_cli.logs.agreement import warning
    from rtmap_cli.logs.traversal import classes_of, read_traversals
    from rtmap_cli.maps.evidence import Policy, Settings
    from rtmap_cli.maps.policy import read_policy
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.steps.detect_changes.events import told_changes
    from rtmap_cli.steps.detect_changes.evidence import gather_evidence
    from rtmap_cli.tables import refuse_existing, refuse_inside

    stream = str(output) == "-"
    if stream and as_json:
        raise UsageError("--json and -o - both want stdout: choose one")
    if not stream:
        refuse_inside(output, map_path)
        refuse_existing(output, overwrite)
    tables = [path / "changes.parquet" for path in runs] if write_runs else []
    for table in tables:
        refuse_existing(table, overwrite, "pass --overwrite or leave out --write-runs")
    policy = read_policy(policy_path) if policy_path else Policy()
    policy = policy.telling(min_probability, max_false_alarms_per_km)
    settings = Settings(policy=policy)
    prior = read_map(map_path, map_version)
    traversals, _ = read_traversals(runs, prior.crs)
    classes = classes_of(runs)
    _tell_unlocalized([t.run_id for t in traversals if not t.localized])
    evidence = gather_evidence(traversals, prior, classes, settings)
    if len(prior) and not any(e.in_view for e in evidence if not e.new):
        raise NoAnswer(f"{map_path}: none of its elements is in view of any frame of these runs")
    if doubt := warning(traversals, prior, map_path):
        log(doubt)
    kilometres = sum(t.kilometres for t in traversals)
    found = told_changes(evidence, policy, kilometres, displaced)
    info = {
        "map": str(map_path),
        "map_version": prior.version,
        "crs_of_map": prior.crs,
        "runs": [t.run_id for t in traversals],
        "min_probability": policy.least,
        "max_false_alarms_per_km": policy.max_false_alarms_per_km,
    }
    write_changes(found, prior.crs, output, info)
    if write_runs:
        for table, traversal in zip(tables, traversals, strict=True):
            own = gather_evidence([traversal], prior, classes, settings)
            alone = told_changes(own, policy, traversal.kilometres, displaced)
            write_change_table(alone, table, prior.crs)
    counts = {k: sum(c.kind == k for c in found) for k in ("delete", "insert", "modify")}
    told = ", ".join(f"{n} {kind}" for kind, n in counts.items())
    if not as_json:
        log(f"{map_path}: {told} in {kilometres:.2f} km of {len(traversals)} runs")
    if not stream:
        result = info | {"output": str(output), "kilometres": kilometres, "counts": counts}
        emit(result | {"changes": [c.properties() for c in found]}, as_json, _lines(found))
    if fail_on_change and found:
        raise Findings(f"{len(found)} changes found")


def _tell_unlocalized(names: list[str]) -> None:
    from rtmap_cli.output import log

    if names:
        log(
            f"{len(names)} runs are not localized (first: {names[0]}): their initial poses are "
            "used; run `rtmap localize` first for sharper results"
        )


def _lines(found: list[ChangeEvent]) -> list[str]:
    from rtmap_cli.output import table

    if not found:
        return ["no changes"]
    rows: list[list[Any]] = []
    for c in found:
        n = c.counts
        rows.append(
            [
                c.kind,
                c.class_name,
                c.element_id or "-",
                f"{c.probability:.3f}",
                f"{n.traversals_seen} of {n.traversals_in_view} runs",
                f"{n.frames_seen} of {n.frames_in_view} frames",
            ]
        )
    return table(["change", "class", "element", "probability", "found by", "seen in"], rows)
