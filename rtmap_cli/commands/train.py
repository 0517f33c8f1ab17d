"""``rtmap train``: frames from logs and procedural towns, then the network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from rtmap_cli import options
from rtmap_cli.errors import UsageError

PASSED_ON = (
    "steps",
    "minutes",
    "stop_after",
    "stop_minutes",
    "seed",
    "resume",
    "init",
    "init_partial",
    "validate_every",
    "validate_frames",
    "keep_best",
    "tensorboard",
    "quiet",
)
"""Options that the package takes as they are."""

NEEDS = "training needs the extra 'train': pip install 'rtmap[train,simulate]'"


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@options.output("The weights, e.g. weights.pt; the losses go to a .csv file beside it.")
@click.option(
    "--config", help="Name or .toml file [default: that of --init or --resume, else rtmap-tiny]."
)
@click.option(
    "--data",
    multiple=True,
    help="Frames, a log, or a folder of logs (repeatable; default: frames/ beside the weights).",
)
@click.option("--map", "map_path", type=options.PATH, help="The true map of the logs in --data.")
@click.option("--cache", type=options.PATH, help="Where frames of logs are kept (default: cache/).")
@click.option(
    "--frames",
    type=click.IntRange(1),
    help="Render procedural towns until the first --data folder holds this many frames.",
)
@click.option(
    "--domain",
    type=click.Choice(["city", "campus"]),
    default="campus",
    show_default=True,
    help="Kind of towns and vehicle that --frames simulates for a network of semantic rasters.",
)
@click.option("--keep-images", is_flag=True, help="Keep camera images with the frames.")
@click.option("--live", is_flag=True, help="Go on rendering new towns while training.")
@click.option("--steps", type=click.IntRange(1), help="Train this many steps (reproducible).")
@click.option("--minutes", type=options.FiniteRange(0, min_open=True), help="Or train this long.")
@click.option("--stop-after", type=click.IntRange(1), help="Stop early, after these many steps.")
@click.option(
    "--stop-minutes", type=options.FiniteRange(0, min_open=True), help="Stop early, after these."
)
@click.option("--resume", type=options.PATH, help="Go on from these weights.")
@click.option("--init", help="First weights: a .pt or exported .onnx file, or a name of the zoo.")
@click.option("--init-partial", is_flag=True, help="Leave fresh what does not fit in --init.")
@click.option("--batch", type=click.IntRange(1), help="Samples per process and step.")
@click.option("--rate", type=options.FiniteRange(0, min_open=True), help="Highest learning rate.")
@click.option("--precision", type=click.Choice(["fp32", "bf16"]), help="Of the convolutions.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Any training rate.")
@click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True
)
@click.option("--loaders", type=click.IntRange(0), help="Processes that prepare batches.")
@click.option("--validate", help="Frames, a log or logs that are never trained on.")
@click.option("--validate-every", type=click.IntRange(1), help="In steps (default: ten times).")
@click.option("--validate-frames", type=click.IntRange(1), default=64, show_default=True)
@click.option("--keep-best", is_flag=True, help="Keep the best weights as NAME.best.pt.")
@click.option("--tensorboard", type=options.PATH, help="Folder of TensorBoard files.")
@options.seed
@options.threads
@options.quiet
@options.overwrite
def command(output: Path, config: str | None, **given: Any) -> int:
    """Train a network on real logs, on procedural towns, or on both.

    Renders frames with --frames (kept in --data), turns logs into frames once (kept in --cache),
    then trains for --steps or --minutes; the learning rate falls to zero at the end. With neither,
    it only makes frames. One GPU, or --threads processes on the CPU; several GPUs by torchrun.

    \b
    Example:
      rtmap train -o weights.pt --frames 200 --steps 50 --threads 2
    """
    _check(output, given)
    try:
        from rtmap_models.training.checkpoint import config_to_train
        from rtmap_models.training.distributed import torchrun
    except ModuleNotFoundError as error:
        raise UsageError(f"{NEEDS} ({error.name} is missing)") from None
    with torchrun(given["device"]) as group:
        resumed = given["resume"] and str(given["resume"])
        first = given["init"] if not given["init_partial"] else None
        sizes = config_to_train(config, resumed or first)
        return _run(sizes, config or sizes.name, output, given, group)


def _check(output: Path, given: dict[str, Any]) -> None:
    from rtmap_cli.tables import refuse_existing

    training = given["steps"] is not None or given["minutes"] is not None
    if not training and given["frames"] is None and not given["data"]:
        raise UsageError("nothing to do: give --frames or --data, and --steps or --minutes")
    if not training:
        for name in ("resume", "init", "validate", "live", "stop_after", "stop_minutes"):
            if given[name]:
                raise UsageError(f"--{name.replace('_', '-')} needs --steps or --minutes")
    if training and given["resume"] is None:
        refuse_existing(output, given["overwrite"], "pass --overwrite or --resume")
    if given["resume"] is not None and given["init"] is not None:
        raise UsageError("--resume goes on with a run, --init starts one: give one of them")
    if given["init_partial"] and given["init"] is None:
        raise UsageError("--init-partial needs --init")
    if given["keep_best"] and given["validate"] is None:
        raise UsageError("--keep-best needs --validate")
    if given["live"] and given["frames"] is None:
        raise UsageError("--live needs --frames: how many frames are kept at a time")


def _run(sizes: Any, config: str, output: Path, given: dict[str, Any], group: Any) -> int:
    from contextlib import nullcontext
    from os import cpu_count

    from rtmap_models.training.distributed import pick_device
    from rtmap_models.training.recipe import load_recipe
    from rtmap_models.training.train import TrainOptions, train

    from rtmap_cli.output import log

    short = [f"{k}={given[k]}" for k in ("batch", "rate", "precision") if given[k] is not None]
    recipe = load_recipe(config, [*short, *given["settings"]])
    device = group.device if group is not None else pick_device(given["device"])
    workers = given["threads"] or cpu_count() or 1

    def make() -> tuple[tuple[Path, ...], tuple[Path, ...]]:
        return _make_frames(sizes, output, given, workers)

    if given["live"] and sizes.architecture == "semantic":
        raise UsageError("--live renders cameras: give a network of semantic rasters its --frames")
    data, unseen = make() if group is None else group.first(make)
    if given["steps"] is None and given["minutes"] is None:
        return 0
    loaders = given["loaders"]
    if loaders is None:
        loaders = min(8, (cpu_count() or 2) - 1) if device.type == "cuda" else 0
    passed_on = {name: given[name] for name in PASSED_ON}
    request = TrainOptions(
        data=data, output=output, recipe=recipe, loaders=loaders, validate=unseen, **passed_on
    )
    first = group is None or group.rank == 0
    rendering: Any = nullcontext()
    if given["live"] and first:
        from rtmap_models.data.live import rendering as render

        keep = sizes.needs_images or given["keep_images"]
        rendering = render(sizes, data[0], given["frames"], given["seed"], workers, keep)
    with rendering:
        result = train(sizes, request, group, given["device"], workers)
    if first and result["progress"] < 1:
        log(f"{output}: stopped at step {result['step']}; go on with --resume {output}")
    elif first:
        log(f"{output}: written")
    return 130 if result["signal"] else 0


def _render(
    sizes: Any,
    folder: Path,
    given: dict[str, Any],
    workers: int,
    report: Callable[[str], None],
    keep: bool | None,
) -> None:
    """Simulated frames of a network's kind: pictures of cameras, or semantic rasters."""
    from rtmap_models.config import SemanticConfig

    count, seed = given["frames"], given["seed"]
    if isinstance(sizes, SemanticConfig):
        from rtmap_models.semantic.frames import generate_drives

        generate_drives(sizes, given["domain"], folder, count, seed, workers, report)
        return
    from rtmap_models.data.generate import generate

    generate(sizes, folder, count, seed, workers, report, keep_images=keep)


def _make_frames(
    sizes: Any, output: Path, given: dict[str, Any], workers: int
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Folders of frames for --data with --frames and for --validate, rendered and converted where
    they are missing."""
    from rtmap_models.data.sources import gather, is_frame_folder

    from rtmap_cli.output import log

    report = (lambda line: None) if given["quiet"] else log
    keep = True if given["keep_images"] else None
    data = list(given["data"])
    if given["frames"] is not None or not data:
        places = [Path(d) for d in data if is_frame_folder(Path(d)) or not Path(d).exists()]
        towns = places[0] if places else output.parent / "frames"
        data = [str(towns), *(d for d in data if Path(d) != towns)]
        if given["frames"] is not None:
            _render(sizes, towns, given, workers, report, keep)
    cache = given["cache"] or output.parent / "cache"
    unseen = [given["validate"]] if given["validate"] is not None else []
    train, held_out = (
        gather(part, sizes, cache, given["map_path"], report, workers, keep_images=keep)
        for part in (data, unseen)
    )
    if both := set(train) & set(held_out):
        raise UsageError(f"{min(both)} is both trained on and validated on")
    return train, held_out
