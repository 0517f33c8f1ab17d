"""rtmap import detections: a JSON file of detections becomes a run."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options


@click.command("detections")
@click.argument("file", type=options.PATH)
@options.output("The run folder to write.")
@click.option(
    "--sigma",
    type=options.FiniteRange(0, min_open=True),
    help="Standard deviation (m) assumed for detections that bring none.",
)
@options.overwrite
@options.as_json
def command(file: Path, output: Path, sigma: float | None, overwrite: bool, as_json: bool) -> None:
    """Turn the detections of any model into a run.

    FILE (.json or .json.gz) holds the detected lines of every frame of one drive with their
    scores and standard deviations, the rough poses and, if known, odometry and occluders.
    All observations get the state "new": nothing has been compared with a map yet.

    \b
    Example:
      rtmap import detections drive-00.json.gz -o runs/drive-00
    """
    from rtmap_cli.formats.detections import read_detections
    from rtmap_cli.logs.run_files import write_run
    from rtmap_cli.output import emit
    from rtmap_cli.tables import refuse_existing, whole_folder

    refuse_existing(output, overwrite)
    run = read_detections(file, sigma)
    with whole_folder(output, overwrite) as folder:
        write_run(run, folder)
    counts = {c: int((run.observations.class_name == c).sum()) for c in run.info["classes"]}
    result = {
        "run": str(output),
        "log_id": run.log_id,
        "crs": run.crs,
        "frames": len(run.frames),
        "observations": counts,
    }
    told = ", ".join(f"{n} {c}" for c, n in counts.items())
    emit(result, as_json, [f"{output}: {run.log_id}, {len(run.frames)} frames, {told}"])
