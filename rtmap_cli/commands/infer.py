"""``rtmap infer``: read a log with the network."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options
from rtmap_cli.output import emit, log, progress


@click.command("infer")
@click.argument("log_path", metavar="LOG", type=str)
@options.output("The run folder to write.")
@click.option("--map", "map_path", type=options.PATH, help="The prior map (default: none).")
@options.map_version
@click.option("--model", default="rtmap-tiny", show_default=True, help="Zoo name or .onnx file.")
@click.option(
    "--score-threshold",
    type=options.FiniteRange(0, 1),
    default=0.05,
    show_default=True,
    help="Drop new elements below this score.",
)
@click.option(
    "--existence-threshold",
    type=options.FiniteRange(0, 1),
    default=0.5,
    show_default=True,
    help="Prior elements below this are outdated.",
)
@click.option(
    "--batch",
    type=click.IntRange(1),
    help="Frames per call of the network (default: 1 on a CPU, 4 elsewhere).",
)
@click.option("--frames", "max_frames", type=click.IntRange(1), help="Stop after so many frames.")
@click.option(
    "--every", type=click.IntRange(1), default=1, show_default=True, help="Take every n-th frame."
)
@click.option(
    "--level/--no-level",
    default=True,
    show_default=True,
    help="Turn the cameras to how the road lies, from heights of the map or of the path.",
)
@click.option(
    "--looks",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Ask again with the prior at the pose found: for starts of 2 m and more.",
)
@click.option(
    "--semantic",
    type=options.PATH,
    help="The semantic rasters of LOG, for a model that reads them [default: LOG/semantic].",
)
@click.option("--skip-bad-frames", is_flag=True, help="Leave out unreadable frames, count them.")
@options.threads
@options.overwrite
@options.as_json
@options.quiet
def command(
    log_path: str,
    output: Path,
    map_path: Path | None,
    map_version: int | None,
    model: str,
    score_threshold: float,
    existence_threshold: float,
    batch: int | None,
    max_frames: int | None,
    every: int,
    level: bool,
    looks: int,
    semantic: Path | None,
    skip_bad_frames: bool,
    threads: int | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Read LOG with the network and write a run: what every frame sees, how sure, and which
    elements of the prior map it confirms.

    LOG is a native log folder (docs/log-format.md), an Argoverse 2 or TbV log, a scene of nuScenes
    or DGP (DIR#SCENE), or a nuScenes info file (.pkl). Without --map it is a first traversal:
    everything is new.

    \b
    Example:
      rtmap infer logs/monday --map map -o runs/monday
      rtmap infer logs/cart --model semantic-tiny -o runs/cart
    """  # fmt: skip
    import os
    import time

    from rtmap_cli.errors import UsageError
    from rtmap_cli.logs.agreement import warning
    from rtmap_cli.logs.open import notes_of, open_log
    from rtmap_cli.logs.run import STATES
    from rtmap_cli.logs.run_files import write_run
    from rtmap_cli.logs.traversal import traversal_of
    from rtmap_cli.maps.crs import check_same_crs
    from rtmap_cli.maps.store import read_map
    from rtmap_cli.steps.infer import InferOptions, MapModel, infer_log
    from rtmap_cli.steps.infer.checks import check_prior_in_range
    from rtmap_cli.tables import refuse_existing, whole_folder

    refuse_existing(output, overwrite)
    source = open_log(log_path)
    for note in notes_of(source):
        log(f"{source.log_id}: {note}")
    prior = read_map(map_path, map_version) if map_path is not None else None
    if prior is not None:
        check_same_crs(prior.crs, source.crs, str(map_path))
        check_prior_in_range(prior, source, str(map_path))
    network = MapModel(model, threads=1)  # a frame each: faster than all of them on one frame
    settings = InferOptions(
        score_threshold=score_threshold,
        existence_threshold=existence_threshold,
        batch=batch or (1 if network.on_cpu else 4),
        threads=threads or os.cpu_count() or 1,
        skip_bad_frames=skip_bad_frames,
        max_frames=max_frames,
        every=every,
        level=level,
        looks=looks,
        semantic=semantic,
    )
    if semantic is not None and network.info.raster is None:
        raise UsageError(f"--semantic: {network.info.name} reads images, not rasters")
    started = time.perf_counter()
    total = min(-(-len(source) // every), max_frames or len(source))
    with whole_folder(output, overwrite) as folder:
        run = infer_log(
            source,
            network,
            prior,
            settings,
            progress=lambda items: progress(items, "frames", total, quiet),
            say=log,
            made_by={"log": log_path, "map": str(map_path) if map_path else None},
        )
        write_run(run, folder)
    if prior is not None and (doubt := warning([traversal_of(run)], prior, str(map_path))):
        log(doubt)
    seconds = time.perf_counter() - started
    counts = {name: int((run.observations.state == k).sum()) for k, name in enumerate(STATES)}
    result = {
        "run": str(output),
        "frames": len(run.frames),
        "skipped_frames": run.info["skipped_frames"],
        "observations": counts,
        "model": network.info.name,
        "frames_per_second": len(run.frames) / seconds,
    }
    text = ", ".join(f"{n} {name}" for name, n in counts.items())
    lines = [f"{output}: {len(run.frames)} frames, {text} ({result['frames_per_second']:.1f}/s)"]
    emit(result, as_json, lines)
