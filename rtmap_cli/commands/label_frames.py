"""``rtmap label frames``: a labelled drive becomes logs to train on and to test on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    import numpy as np

    from rtmap_cli.maps.element import VectorMap
    from rtmap_cli.steps.evaluate.drives import Drive
    from rtmap_cli.steps.label.frames import Source, Split


@click.command("frames")
@click.argument("map_path", metavar="MAP", type=options.PATH)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True)
@click.option(
    "--poses",
    multiple=True,
    type=options.PATH,
    help="Poses that the labels were made with, one per LOG: a cloud folder, a run, or a "
    "poses.parquet [default: the log's true or surveyed poses, else its own].",
)
@click.option(
    "--split",
    "splits",
    multiple=True,
    type=click.Choice(["paper", "apart"]),
    help="Which splits to write [default: both].",
)
@click.option(
    "--share",
    type=options.FiniteRange(0.1, 0.95),
    default=0.75,
    show_default=True,
    help="Share of the frames that train.",
)
@click.option(
    "--max-sigma",
    type=options.FiniteRange(0, min_open=True),
    help="Leave out stretches of lines whose place is less sure (m): borders that `label lanes` "
    "assumed [default: all are labels].",
)
@options.seed
@options.output("The folder to write.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    map_path: Path,
    logs: tuple[str, ...],
    poses: tuple[Path, ...],
    splits: tuple[str, ...],
    share: float,
    max_sigma: float | None,
    seed: int,
    output: Path,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Cut the drives over a labelled map into logs for `train` and for `evaluate`.

    OUT/map holds the lines that networks learn, OUT/paper and OUT/apart the logs train/* and
    test/* with their images. `paper` draws 75 % of the frames of every scenario type, as the
    campus paper does: both sides see the same ground. `apart` cuts the map in two, so that no
    test frame shows ground that training saw. How much ground is shared is printed for both.

    \b
    Example:
      rtmap label frames labels logs/monday -o frames
      rtmap train -o weights.pt --data frames/apart/train --map frames/map --steps 1000
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.logs.open import folder_of
    from rtmap_cli.maps.store import read_map, write_new_map
    from rtmap_cli.output import emit
    from rtmap_cli.steps.label.frames import SPLITS, truth_map
    from rtmap_cli.tables import refuse_existing, refuse_over, whole_folder, write_json

    if poses and len(poses) != len(logs):
        raise UsageError(f"{len(poses)} --poses for {len(logs)} logs")
    refuse_over(output, map_path, *(folder_of(spec) for spec in logs), *poses)
    refuse_existing(output, overwrite)
    labels = read_map(map_path)
    truth = truth_map(labels, max_sigma or float("inf"))
    sources, masks = _read(logs, poses, truth)
    found = _splits(sources, masks, splits or SPLITS, share, seed)
    with whole_folder(output, overwrite) as folder:
        write_new_map(truth, folder / "map", f"labels of {map_path.name}")
        for split in found:
            _write(sources, split, folder / split.name, quiet)
        head = {"schema": "rtmap.label.frames", "schema_version": "1.0", "share": share}
        made = {s.name: s.as_json() for s in found}
        write_json(
            {**head, "seed": seed, "logs": list(logs), "splits": made}, folder / "frames.json"
        )
    lines = [f"{output}: {len(truth)} lines, {sum(len(s.frames) for s in sources)} frames"]
    emit({"frames": str(output), "lines": len(truth), **made}, as_json, lines + _table(found))


def _read(
    logs: tuple[str, ...], poses: tuple[Path, ...], truth: VectorMap
) -> tuple[list[Source], dict[str, np.ndarray[Any, Any]]]:
    """The logs with their poses, and which scenarios hold at the pooled frames."""
    import numpy as np

    from rtmap_cli.errors import BadInput
    from rtmap_cli.logs.open import open_log
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.steps.evaluate.scenarios.labels import SCENARIOS, scenarios_of
    from rtmap_cli.steps.label.frames import Source

    sources, masks = [], []
    for k, spec in enumerate(logs):
        log = open_log(spec)
        check_same_crs(log.crs, truth.crs, spec)
        drive = _drive(poses[k] if poses else spec, log)
        check_same_crs(drive.crs, truth.crs, poses[k] if poses else spec)
        frames = list(log.frames())
        pose, known = drive.at(np.array([f.timestamp_ns for f in frames], np.int64))
        if not known.any():
            todo = "give the poses of this log with --poses"
            raise BadInput(poses[k] if poses else spec, "has no pose at a frame of the log", todo)
        rows = np.flatnonzero(known)
        sources.append(Source(log, [frames[r] for r in rows.tolist()], pose[rows]))
        times = np.array([frames[r].timestamp_ns for r in rows.tolist()], np.int64)
        masks.append(scenarios_of(drive, truth, times))
    return sources, {n: np.concatenate([m[n] for m in masks]) for n in SCENARIOS}


def _drive(spec: str | Path, log: Any) -> Drive:
    """Poses of a cloud folder, a run, a table or a log, as a drive."""
    import numpy as np

    from rtmap_cli.steps.evaluate.drives import Drive, read_drives

    folder = Path(spec)
    if (folder / "cloud.json").exists():
        from rtmap_cli.logs.cloud import CloudFolder

        cloud = CloudFolder(folder)
        found = cloud.trajectory()
        kept = np.asarray(found.status != "lost", bool)
        return Drive(folder.name, cloud.crs, found.timestamp_ns[kept], found.pose[kept])
    if (folder / "log.json").exists() and not (folder / "truth" / "poses.parquet").exists():
        frames = list(log.frames())
        times = np.array([f.timestamp_ns for f in frames], np.int64)
        return Drive(log.log_id, log.crs, times, np.stack([f.map_SE3_ego for f in frames]))
    return read_drives(spec)[0]


def _splits(
    sources: list[Source], masks: dict[str, Any], names: tuple[str, ...], share: float, seed: int
) -> list[Split]:
    import numpy as np

    from rtmap_cli.steps.label.frames import Ground, apart_split, paper_split, types_of

    pose = np.concatenate([s.pose for s in sources])
    kind, ground = types_of(masks), Ground(pose)
    made = {
        "paper": lambda: paper_split(kind, ground, share, seed),
        "apart": lambda: apart_split(kind, pose[:, :2, 3], ground, share),
    }
    return [made[n]() for n in made if n in names]


def _write(sources: list[Source], split: Split, folder: Path, quiet: bool) -> None:
    """The parts of every log, under train/ and test/."""
    import numpy as np

    from rtmap_cli.output import progress
    from rtmap_cli.steps.label.frames import write_part

    start = 0
    for k, source in enumerate(progress(sources, f"logs of {split.name}", len(sources), quiet)):
        stop = start + len(source.frames)
        for part, mask in (("train", split.train), ("test", split.test)):
            rows = np.flatnonzero(mask[start:stop])
            if len(rows):
                write_part(source, rows, folder / part / f"{k:03d}", f"{split.name}-{part}")
        start = stop


def _table(splits: list[Split]) -> list[str]:
    from rtmap_cli.output import table

    rows = []
    for s in splits:
        said = s.as_json()
        counts = [said[n] for n in ("train", "test", "left_out")]
        rows.append([s.name, "all", *counts, f"{said['shared_ground']:.1%}"])
        rows += [["", kind, *n, ""] for kind, n in s.by_type.items()]
    return table(["split", "scenario", "train", "test", "left out", "shared ground"], rows)
