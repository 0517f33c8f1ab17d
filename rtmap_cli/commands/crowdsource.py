"""rtmap crowdsource: fuse runs into the next version of the map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.logs.traversal import Traversal
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.crowdsource.fuse import Fusion


@click.command("crowdsource")
@click.argument("runs_dir", metavar="RUNS_DIR", type=options.PATH)
@options.map_path
@click.option("--message", help="Message of the new version.")
@click.option("--dry-run", is_flag=True, help="Tell what would change and write nothing.")
@click.option("--force", is_flag=True, help="Also fuse runs that the map was fused from already.")
@click.option("--skip-bad-runs", is_flag=True, help="Leave out unreadable runs and name them.")
@click.option(
    "--without-sigma", is_flag=True, help="Ablation: without U, all detections have the same sigma."
)
@options.as_json
def command(
    runs_dir: Path,
    map_path: Path,
    message: str | None,
    dry_run: bool,
    force: bool,
    skip_bad_runs: bool,
    without_sigma: bool,
    as_json: bool,
) -> None:
    """Fuse the runs of RUNS_DIR that the map does not know yet, and commit its next version.

    RUNS_DIR is a run or a folder of runs. Confirmed elements are moved to where prior and
    detections put them, each with its covariance; elements that runs looked at and did not find
    lose existence and go; new ones come when enough runs agree. Without the map's folder the
    first version is made. Runs fused before are known and never count twice: while a map came
    from runs alone and they all lie in RUNS_DIR, all are fused anew and elements keep their ids.

    \b
    Example:
      rtmap crowdsource runs --map map --message "week 12"
    """
    from rtmap_cli.errors import NoAnswer
    from rtmap_cli.logs.agreement import warning
    from rtmap_cli.logs.traversal import same_sigma
    from rtmap_cli.maps.store import commit_map, fused_runs, map_exists, read_map, write_new_map
    from rtmap_cli.output import emit, log

    exists = map_exists(map_path)
    before = read_map(map_path) if exists else None
    known = fused_runs(map_path) if exists else set()
    paths, traversals, crs, bad = _read(runs_dir, before.crs if before else None, skip_bad_runs)
    if without_sigma:
        traversals = [same_sigma(t) for t in traversals]
    for line in bad:
        log(f"left out: {line}")
    done = set() if force else known & {t.run_id for t in traversals}
    fresh = [t for t in traversals if t.run_id not in done]
    result: dict[str, Any] = {
        "map": str(map_path),
        "base_version": before.version if before else None,
        "version": before.version if before else None,
        "runs": sorted(t.run_id for t in fresh),
        "known_runs": sorted(done),
        "bad_runs": bad,
        "dry_run": dry_run,
    }
    if not fresh:
        emit(result | {"counts": {}}, as_json, [f"{map_path}: all runs are in the map already"])
        return
    _tell_unlocalized([t.run_id for t in fresh if not t.localized], exists)
    if before is not None and (doubt := warning(fresh, before, map_path)):
        log(doubt)
    if before is not None and not force and _rebuildable(map_path, known, traversals):
        fusion = _rebuilt(traversals, before, crs, paths)
    else:
        fusion = _fuse(traversals, fresh, before, crs, paths, done)
    if not len(fusion.vector_map) and not exists:
        raise NoAnswer(f"{runs_dir}: the runs hold nothing that could become a map")
    if not dry_run:
        text = message or f"crowdsource: {len(fresh)} runs"
        names = [t.run_id for t in fresh if t.run_id not in known]
        info = {"crowdsource": fusion.counts()}
        if before is None:
            write_new_map(fusion.vector_map, map_path, text, runs=names, info=info)
            result["version"] = 0
        else:
            assert before.version is not None
            result["version"] = commit_map(
                map_path, fusion.vector_map, before.version, text, runs=names, info=info
            )
    emit(_described(result, fusion), as_json, _lines(result, fusion))


def _read(
    runs_dir: Path, crs: str | None, skip_bad: bool
) -> tuple[list[Path], list[Traversal], str, list[str]]:
    """Run folders, their traversals, the CRS, and a line for each run that was left out."""
    from rtmap_cli.errors import BadInput
    from rtmap_cli.logs.traversal import find_runs, read_traversals

    paths, bad = find_runs(runs_dir), []
    if skip_bad:
        good = []
        for path in paths:
            try:
                crs = read_traversals([path], crs)[1]
                good.append(path)
            except BadInput as error:
                bad.append(str(error))
        if not good:
            raise BadInput(runs_dir, "none of its runs can be used", bad[0])
        paths = good
    traversals, found = read_traversals(paths, crs)
    return paths, traversals, found, bad


def _fuse(
    traversals: list[Traversal],
    fresh: list[Traversal],
    before: VectorMap | None,
    crs: str,
    paths: list[Path],
    done: set[str],
) -> Fusion:
    from rtmap_cli.logs.traversal import classes_of
    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.maps.refit import FusionModel
    from rtmap_cli.steps.crowdsource.align.align import align
    from rtmap_cli.steps.crowdsource.fuse import fuse
    from rtmap_cli.steps.detect_changes.evidence import gather_evidence

    model = FusionModel()
    if before is None:
        # Nothing says where the runs are but they themselves: first they are put onto each other.
        fresh = traversals = (aligned := align(traversals)).traversals
        model = replace(model, common=aligned.common)
    prior = before if before is not None else VectorMap((), crs)
    evidence = gather_evidence(traversals, prior, classes_of(paths), fused=done)
    return fuse(prior, evidence, fresh, traversals, model=model)


def _rebuildable(map_path: Path, known: set[str], traversals: list[Traversal]) -> bool:
    """True when the map came from runs alone and all of them are at hand: fused together they
    give a better map than one after the other, and the same in any order."""
    from rtmap_cli.maps.store import history

    alone = all("crowdsource" in version.info for version in history(map_path))
    return alone and known <= {t.run_id for t in traversals}


def _rebuilt(
    traversals: list[Traversal],
    before: VectorMap,
    crs: str,
    paths: list[Path],
) -> Fusion:
    """All runs fused at once; elements keep their ids."""
    from rtmap_cli.steps.crowdsource.fuse import compared
    from rtmap_cli.steps.crowdsource.identity import keep_ids

    fusion = _fuse(traversals, traversals, None, crs, paths, set())
    return compared(before, keep_ids(before, fusion.vector_map), fusion.waiting)


def _tell_unlocalized(names: list[str], exists: bool) -> None:
    from rtmap_cli.output import log

    if names and exists:
        log(
            f"{len(names)} runs are not localized (first: {names[0]}): their initial poses are "
            "used; run `rtmap localize` first for a sharper map"
        )


def _described(result: dict[str, Any], fusion: Fusion) -> dict[str, Any]:
    names = ("inserted", "deleted", "split", "moved", "waiting")
    return result | {
        "elements": len(fusion.vector_map),
        "counts": fusion.counts(),
        **{name: sorted(getattr(fusion, name)) for name in names},
    }


def _lines(result: dict[str, Any], fusion: Fusion) -> list[str]:
    from rtmap_cli.output import table

    rows = [[name, n] for name, n in fusion.counts().items()]
    what = "would become" if result["dry_run"] else "is now"
    version = "its next version" if result["dry_run"] else f"version {result['version']}"
    head = f"{result['map']} {what} {version}: {len(fusion.vector_map)} elements, "
    return [head + f"{len(result['runs'])} runs fused", *table(["elements", "count"], rows)]
