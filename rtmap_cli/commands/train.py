"""``rtmap train``: frames from procedural towns, then the network."""

from __future__ import annotations

from pathlib import Path

import click

from rtmap_cli import options
from rtmap_cli.errors import UsageError

NEEDS = "training needs the extra 'train': pip install 'rtmap[train,simulate]'"


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@options.output("The weights, e.g. weights.pt; the losses go to a .csv file beside it.")
@click.option("--config", default="rtmap-tiny", show_default=True, help="Name or .toml file.")
@click.option(
    "--data",
    type=options.PATH,
    help="Folder of training frames, kept for later runs (default: frames/ beside the weights).",
)
@click.option(
    "--frames",
    type=click.IntRange(1),
    help="Render procedural towns until the folder holds this many frames.",
)
@click.option("--steps", type=click.IntRange(1), help="Train this many steps (reproducible).")
@click.option("--minutes", type=options.FiniteRange(0, min_open=True), help="Or train this long.")
@click.option("--batch", type=click.IntRange(1), default=8, show_default=True, help="Per thread.")
@click.option("--resume", type=options.PATH, help="Go on from these weights.")
@options.seed
@options.threads
@options.quiet
@options.overwrite
def command(
    output: Path,
    config: str,
    data: Path | None,
    frames: int | None,
    steps: int | None,
    minutes: float | None,
    batch: int,
    resume: Path | None,
    seed: int,
    threads: int | None,
    quiet: bool,
    overwrite: bool,
) -> None:
    """Train the network on procedural towns only.

    Renders frames with --frames (kept in --data), then trains for --steps or --minutes; the
    learning rate falls to zero at the end. With neither, it only renders.

    \b
    Example:
      rtmap train -o weights.pt --frames 200 --steps 50 --threads 2
    """
    import os

    training = steps is not None or minutes is not None
    if not training and frames is None:
        raise UsageError("nothing to do: give --frames, and --steps or --minutes")
    if training and output.exists() and not overwrite and resume is None:
        raise UsageError(f"{output} exists; pass --overwrite or --resume")
    try:
        from rtmap_models.config import load_config
        from rtmap_models.generate import generate
        from rtmap_models.train import TrainOptions, train
    except ModuleNotFoundError as error:
        raise UsageError(f"{NEEDS} ({error.name} is missing)") from None
    from rtmap_cli.output import log

    folder = data or output.parent / "frames"
    workers = threads or os.cpu_count() or 1
    sizes = load_config(config)
    report = (lambda line: None) if quiet else log
    if frames is not None:
        generate(sizes, folder, frames, seed, workers, report)
    if not training:
        return
    options_ = TrainOptions(
        data=folder,
        output=output,
        steps=steps,
        minutes=minutes,
        seed=seed,
        workers=workers,
        batch=batch,
        resume=resume,
        quiet=quiet,
    )
    train(sizes, options_)
    log(f"{output}: written")
