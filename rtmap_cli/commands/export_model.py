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
    help="What it was trained on, for the metadata (default: its training footprint in words).",
)
@click.option(
    "--trained-on",
    multiple=True,
    metavar="WHAT",
    help="Where weights were trained that do not say it: 'procedural', frames, logs or maps.",
)
@click.option(
    "--no-footprint", is_flag=True, help="Leave out where it was trained: the model does not tell."
)
@click.option("--licence", default="Apache-2.0", show_default=True, help="For the metadata.")
@click.option(
    "--calibrate",
    type=options.PATH,
    help="Frames that training did not see (made by rtmap train --frames --data): sigmas and the "
    "pose covariance are scaled to be honest on them.",
)
@click.option(
    "--fp16", is_flag=True, help="Half-precision weights, for GPUs; places stay single precision."
)
@click.option("--report", type=options.PATH, help="Also write the comparison with torch (JSON).")
@options.as_json
@options.overwrite
def command(
    weights: Path,
    output: Path,
    name: str | None,
    training_data: str | None,
    trained_on: tuple[str, ...],
    no_footprint: bool,
    licence: str,
    calibrate: Path | None,
    fp16: bool,
    report: Path | None,
    as_json: bool,
    overwrite: bool,
) -> None:
    """Export WEIGHTS of `rtmap train` (or of an exported model, to calibrate it again) to one ONNX
    file and check it against torch.

    Standard operators only; batch, cameras and prior slots are dynamic; the metadata says the
    rest. The file is compared with torch on every execution provider of onnxruntime at two sizes;
    one that differs is not written (exit 1).

    \b
    Example:
      rtmap export-model weights.pt -o model.onnx
    """
    from rtmap_cli.tables import refuse_existing, whole_file

    for path in (output, report):
        if path is not None:
            refuse_existing(path, overwrite)
    if trained_on and no_footprint:
        raise UsageError("--trained-on says where it was trained, --no-footprint does not")
    if report is not None and report.resolve() == output.resolve():
        raise UsageError("--report and --output are the same file")
    try:
        from rtmap_models.export.onnx_file import ParityMiss, export_onnx
        from rtmap_models.training.checkpoint import load_network
    except ModuleNotFoundError as error:
        raise UsageError(f"{NEEDS} ({error.name} is missing)") from None
    import json

    from rtmap_cli.maps.footprint import NOTHING_KNOWN
    from rtmap_cli.output import emit, log, plain

    network, content = load_network(weights)
    footprint = NOTHING_KNOWN
    if not no_footprint:
        footprint = _footprint(weights, network, content, trained_on)
    if not footprint.known and not no_footprint:
        log(f"rtmap: {weights} was trained on {footprint.text()}: say what with --trained-on")
    factors = _calibrated(network, calibrate)
    metadata = _metadata(content, name, training_data, licence, factors, footprint)
    result: dict[str, Any] = {
        "model": str(output),
        "calibration": factors,
        "training_footprint": footprint.as_json(),
    }
    try:
        parity = export_onnx(network, output, metadata, half=fp16)
    except ParityMiss as miss:
        emit(
            result | {"model": None, "parity": miss.report.as_json()}, as_json, miss.report.lines()
        )
        raise
    megabytes = output.stat().st_size / 1e6
    result |= {"megabytes": megabytes, "differences": parity.worst(), "parity": parity.as_json()}
    if report is not None:
        with whole_file(report) as temporary:
            temporary.write_text(json.dumps(plain(result), indent=1) + "\n", encoding="utf-8")
    emit(result, as_json, [*parity.lines(), f"{output}: {megabytes:.1f} MB"])


def _footprint(
    weights: Path, network: Any, content: dict[str, Any], stated: tuple[str, ...]
) -> Any:
    """What training saw, as the checkpoint says; what it does not know as the caller states it."""
    from rtmap_models.data.dataset import Frames
    from rtmap_models.data.sources import is_frame_folder
    from rtmap_models.training.checkpoint import footprint_of

    from rtmap_cli.maps.footprint import TOWNS, union
    from rtmap_cli.steps.evaluate.gates.leak import read_trained_on

    def read(spec: str) -> Any:
        if spec == "procedural":
            return TOWNS
        if is_frame_folder(Path(spec)):
            return Frames(spec, network.config).footprint()
        return read_trained_on([spec])

    found = footprint_of(content, weights)
    return found.stated(union(map(read, stated))) if stated else found


def _metadata(
    content: dict[str, Any],
    name: str | None,
    training_data: str | None,
    licence: str,
    factors: dict[str, Any],
    footprint: Any,
) -> dict[str, Any]:
    """What the checkpoint and the caller say about the model."""
    from rtmap_models.export.onnx_file import code_version

    amount = f"{content['frames']} frames, {content['samples']} samples"
    metadata: dict[str, Any] = {
        "training_data": f"{training_data or footprint.text()}: {amount}",
        "training_footprint": footprint.as_json(),
        "training": {k: content[k] for k in ("step", "samples", "frames", "seconds")},
        "licence": licence,
        "code_sha": code_version(),
    }
    if name:
        metadata["model_name"] = name
    if factors:
        metadata["calibration"] = factors
    return metadata


def _calibrated(network: Any, frames: Path | None) -> dict[str, Any]:
    """Scale the network's uncertainties and scores on held-out frames; the factors by name."""
    if frames is None:
        return {}
    from rtmap_models.data.dataset import Frames
    from rtmap_models.training.calibrate import calibrate
    from rtmap_models.training.scores import calibrate_scores

    held_out = Frames(frames, network.config)
    return {**calibrate(network, held_out), **calibrate_scores(network, held_out)}
