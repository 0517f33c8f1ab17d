"""``rtmap export-model``: trained weights become one self-describing ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtmap_cli import options
from rtmap_cli.errors import UsageError

NEEDS = "the export needs the extra 'train': pip install 'rtmap[train]'"


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("weights", type=options.PATH)
@options.output("The ONNX file.")
@click.option("--name", help="Name of the model (default: the name of its configuration).")
@click.option(
    "--training-data",
    default="procedural towns of rtmap",
    show_default=True,
    help="What it was trained on, for the metadata.",
)
@click.option("--licence", default="Apache-2.0", show_default=True, help="For the metadata.")
@click.option(
    "--calibrate",
    type=options.PATH,
    help="Frames that training did not see (made by rtmap train --frames --data): sigmas and the "
    "pose covariance are scaled to be honest on them.",
)
@options.as_json
@options.overwrite
def command(
    weights: Path,
    output: Path,
    name: str | None,
    training_data: str,
    licence: str,
    calibrate: Path | None,
    as_json: bool,
    overwrite: bool,
) -> None:
    """Export WEIGHTS of `rtmap train` to one ONNX file and check it against torch.

    Standard operators only; batch, cameras and prior slots are dynamic; the metadata says the
    rest. An export that differs from torch is not written (exit 4).

    \b
    Example:
      rtmap export-model weights.pt -o model.onnx
    """
    if output.exists() and not overwrite:
        raise UsageError(f"{output} exists; pass --overwrite")
    try:
        from rtmap_models.checkpoint import load_network
        from rtmap_models.export import code_version, export_onnx
    except ModuleNotFoundError as error:
        raise UsageError(f"{NEEDS} ({error.name} is missing)") from None
    from rtmap_cli.output import emit

    network, content = load_network(weights)
    amount = f"{content['frames']} frames, {content['samples']} samples"
    metadata: dict[str, Any] = {
        "training_data": f"{training_data}: {amount}",
        "licence": licence,
        "code_sha": code_version(),
    }
    if name:
        metadata["model_name"] = name
    factors: dict[str, Any] = {}
    if calibrate is not None:
        from rtmap_models.calibrate import calibrate as scale
        from rtmap_models.dataset import Frames
        from rtmap_models.scores import calibrate_scores

        held_out = Frames(calibrate, network.config)
        factors = {**scale(network, held_out), **calibrate_scores(network, held_out)}
        metadata["calibration"] = factors
    differences = export_onnx(network, output, metadata)
    megabytes = output.stat().st_size / 1e6
    result = {
        "model": str(output),
        "megabytes": megabytes,
        "differences": differences,
        "calibration": factors,
    }
    worst = max(differences.values())
    emit(result, as_json, [f"{output}: {megabytes:.1f} MB, differs from torch by {worst:.1g}"])
