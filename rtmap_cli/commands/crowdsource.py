"""rtmap crowdsource: fuse runs into the next version of the map."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.logs.tracks import Track
    from rtmap_cli.logs.traversal import Traversal
    from rtmap_cli.maps.element import Element, VectorMap
    from rtmap_cli.maps.evidence import Policy
    from rtmap_cli.steps.crowdsource.crowdsource import Workers
    from rtmap_cli.steps.crowdsource.fuse import Fusion


@click.command("crowdsource")
@click.argument("runs_dir", metavar="RUNS_DIR", type=options.PATH)
@options.map_path
@click.option("--message", help="Message of the new version.")
@click.option("--dry-run", is_flag=True, help="Tell what would change and write nothing.")
@click.option("--force", is_flag=True, help="Also fuse runs that the map was fused from already.")
@click.option("--skip-bad-runs", is_flag=True, help="Leave out unreadable runs and name them.")
@click.option("--policy", "policy_path", type=options.PATH, help="TOML file: votes and thresholds.")
@click.option(
    "--without-sigma", is_flag=True, help="Ablation: without U, all detections have the same sigma."
)
@click.option(
    "--tile",
    type=options.FiniteRange(100),
    default=512.0,
    show_default=True,
    help="Side (m) of the tiles that a large area is cut into; one of them is in memory at once.",
)
@click.option(
    "--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes to use."
)
@click.option(
    "--engine",
    type=click.Choice(["local", "dask"]),
    default="local",
    show_default=True,
    help="Where tiles are fused: here, or on a dask.distributed cluster (extra: dask).",
)
@click.option(
    "--method",
    type=click.Choice(["elements", "grid"]),
    default="elements",
    show_default=True,
    help="How to fuse: element by element, or accumulation grids (`rtmap update`).",
)
@click.option("--scheduler", metavar="ADDRESS", help="Of the cluster: tcp://HOST:PORT.")
@options.as_json
def command(
    runs_dir: Path,
    map_path: Path,
    message: str | None,
    dry_run: bool,
    force: bool,
    skip_bad_runs: bool,
    policy_path: Path | None,
    without_sigma: bool,
    tile: float,
    jobs: int,
    engine: str,
    method: str,
    scheduler: str | None,
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
    from rtmap_cli.commands.update import fuse_region_grid
    from rtmap_cli.errors import NoAnswer
    from rtmap_cli.logs.agreement import warning_of
    from rtmap_cli.logs.tracks import read_tracks
    from rtmap_cli.logs.traversal import find_runs
    from rtmap_cli.maps.policy import read_policy
    from rtmap_cli.maps.store import fused_runs, map_exists, read_map
    from rtmap_cli.output import emit, log
    from rtmap_cli.steps.crowdsource.crowdsource import Task, crowdsource

    workers = _workers(jobs, engine, scheduler)
    exists = map_exists(map_path)
    before = read_map(map_path) if exists else None
    known = fused_runs(map_path) if exists else set()
    tracks, crs, bad = read_tracks(
        find_runs(runs_dir), before.crs if before else None, skip_bad_runs
    )
    done = set() if force else known & {t.run_id for t in tracks}
    anew = before is not None and not force and _rebuildable(map_path, known, tracks)
    task = Task(before, crs, frozenset(done), anew, without_sigma, tile)
    fresh = [t for t in tracks if t.run_id not in done]
    _tell_unlocalized([t.run_id for t in fresh if not t.localized], exists)
    _tell_mixed(fresh, before.version if before else None)
    if fresh and not force:
        _tell_missing(map_path, known - done)
    by_method = fuse_region_grid if method == "grid" else fuse_region
    compose = partial(by_method, policy=read_policy(policy_path) if policy_path else None)
    fusion, astray = None, {}
    if fresh:
        found = crowdsource(task, tracks, compose, workers, skip_bad_runs)
        fusion, bad = found.fusion, bad + found.bad
        fresh = [t for t in found.tracks if t.run_id not in done]
        if doubt := warning_of(found.agreements, map_path):
            log(doubt)
        astray = found.astray
        for line in astray.values():
            log(f"astray: {line}")
        if not found.tracks:
            raise NoAnswer(f"{runs_dir}: every run lies elsewhere than the map")
    for line in bad:
        log(f"left out: {line}")
    result: dict[str, Any] = {
        "map": str(map_path),
        "base_version": before.version if before else None,
        "version": before.version if before else None,
        "runs": sorted(t.run_id for t in fresh),
        "known_runs": sorted(done),
        "bad_runs": bad,
        "astray_runs": sorted(astray),
        "dry_run": dry_run,
    }
    if fusion is None:
        emit(result | {"counts": {}}, as_json, [f"{map_path}: all runs are in the map already"])
        return
    if not len(fusion.vector_map) and not exists:
        raise NoAnswer(f"{runs_dir}: the runs hold nothing that could become a map")
    if not dry_run:
        text = message or f"crowdsource: {len(fresh)} runs"
        names = [t.run_id for t in fresh if t.run_id not in known]
        result["version"] = _committed(map_path, before, fusion, text, names)
    emit(_described(result, fusion), as_json, _lines(result, fusion))


def fuse_region(
    traversals: Sequence[Traversal],
    prior: VectorMap,
    classes: Sequence[str],
    fused: Collection[str],
    common: float = 0.0,
    policy: Policy | None = None,
) -> tuple[Fusion, list[Element]]:
    """Evidence and fusion of one region, and its candidates that wait for another run; ``common``
    is the variance (m²) of the place that all traversals share.

    Here the rooms of change detection and of fusion meet; workers call it by its name.
    """
    from rtmap_cli.maps.evidence import Policy, Settings
    from rtmap_cli.maps.refit import FusionModel
    from rtmap_cli.steps.crowdsource.fuse import fuse
    from rtmap_cli.steps.detect_changes.evidence import gather_evidence

    settings = Settings(policy=policy or Policy())
    evidence = []
    if all(set(classes) <= set(t.classes) for t in traversals):
        evidence = gather_evidence(traversals, prior, classes, settings, fused)
    else:
        # A model that does not know a class has not looked for it.
        for name in classes:
            able = [t for t in traversals if name in t.classes]
            evidence += gather_evidence(able, prior, [name], settings, fused) if able else []
    fresh = [t for t in traversals if t.run_id not in fused]
    model = FusionModel(common=common)
    fusion = fuse(prior, evidence, fresh, traversals, settings.policy, model)
    waiting = set(fusion.waiting)
    return fusion, [e.element for e in evidence if e.new and e.element.element_id in waiting]


def _workers(jobs: int, engine: str, scheduler: str | None) -> Workers:
    """Where the jobs run."""
    from rtmap_cli.errors import UsageError
    from rtmap_cli.steps.crowdsource.engines import in_process, in_processes, on_dask

    if (engine == "dask") != (scheduler is not None):
        raise UsageError("--engine dask and --scheduler tcp://HOST:PORT need each other")
    if scheduler is not None:
        if jobs > 1:
            raise UsageError("--jobs is for this machine: a cluster has its own workers")
        return partial(on_dask, scheduler=scheduler)
    return in_process if jobs == 1 else partial(in_processes, jobs=jobs)


def _rebuildable(map_path: Path, known: set[str], tracks: list[Track]) -> bool:
    """True when the map came from runs alone and all of them are at hand: fused together they
    give a better map than one after the other, and the same in any order."""
    from rtmap_cli.maps.store import history

    alone = all("crowdsource" in version.info for version in history(map_path))
    return alone and known <= {t.run_id for t in tracks}


def _committed(
    map_path: Path, before: VectorMap | None, fusion: Fusion, text: str, names: list[str]
) -> int:
    """Write the next version of the map; returns its number."""
    from rtmap_cli.maps.store import commit_map, write_new_map

    info = {"crowdsource": fusion.counts()}
    if before is None:
        return write_new_map(fusion.vector_map, map_path, text, runs=names, info=info)
    assert before.version is not None
    return commit_map(map_path, fusion.vector_map, before.version, text, runs=names, info=info)


def _tell_unlocalized(names: list[str], exists: bool) -> None:
    from rtmap_cli.output import log

    if names and exists:
        log(
            f"{len(names)} runs are not localized (first: {names[0]}): their initial poses are "
            "used; run `rtmap localize` first for a sharper map"
        )


def _tell_mixed(fresh: list[Track], version: int | None) -> None:
    from rtmap_cli.output import log

    models = {t.model for t in fresh if t.model}
    if len(models) > 1:
        log(f"the runs come from {len(models)} models: they vote alike, whatever each is worth")
    ahead = [t for t in fresh if (t.map_version or 0) > (version or 0)]
    if ahead and version is not None:
        log(
            f"{len(ahead)} runs (first: {ahead[0].run_id}) were made with version "
            f"{ahead[0].map_version} of a map, this one has {version}: what they say about "
            "elements that it does not have is left out"
        )


def _tell_missing(map_path: Path, missing: set[str]) -> None:
    """What a map loses when runs that it was fused from do not lie in the folder any more."""
    from rtmap_cli.maps.store import history
    from rtmap_cli.output import log

    if not missing:
        return
    what = f"{len(missing)} runs that {map_path} was fused from are not in RUNS_DIR"
    what += f" (first: {min(missing)})"
    versions = history(map_path)
    waiting = versions[-1].info.get("crowdsource", {}).get("waiting", 0)
    if all("crowdsource" in v.info for v in versions):
        log(
            f"warning: {what}: a map from runs alone is fused anew from all of them while they lie "
            "there; without them its lines stay in the pieces that it has"
        )
    elif waiting:
        log(f"{what}: {waiting} new elements that wait for another run lose their witnesses")


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
