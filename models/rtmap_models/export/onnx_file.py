"""One self-describing ONNX file: standard operators, dynamic batch, cameras and prior slots."""

from __future__ import annotations

import hashlib
import json
import logging
import warnings
from pathlib import Path
from typing import Any

import onnx
import torch
from onnx import TensorProto
from torch import nn

from rtmap_cli.errors import Findings
from rtmap_cli.tables import whole_file
from rtmap_models.config import SemanticConfig
from rtmap_models.export.borders import pad_with_zeros
from rtmap_models.export.example import example_inputs
from rtmap_models.export.half import to_half
from rtmap_models.export.lean import lean
from rtmap_models.export.onnx_weights import (
    CONFIG_KEY,
    keep_weights,
    read_configuration,
    read_weights,
)
from rtmap_models.export.parity import (
    HALF,
    INPUTS,
    OUTPUTS,
    SINGLE,
    ParityReport,
    inputs_of,
    parity,
    parity_report,
)

__all__ = [
    "INPUTS",
    "OPSET",
    "OUTPUTS",
    "ParityMiss",
    "code_version",
    "example_inputs",
    "export_onnx",
    "parity",
    "read_configuration",
    "read_weights",
]

OPSET = 20


class ParityMiss(Findings):
    """The graph and torch differ by more than the tolerance; ``report`` says where."""

    def __init__(self, path: Path, report: ParityReport) -> None:
        self.report = report
        super().__init__(f"{path}: {report.miss()}; not written")


def export_onnx(
    network: nn.Module, path: Path, metadata: dict[str, Any], half: bool = False
) -> ParityReport:
    """Write the ONNX file of a network (docs/model-contract.md) and prove it against torch.

    ``network`` holds its configuration in ``.config``. ``metadata`` adds to what the configuration
    says (training data, licence, …). With ``half`` the file is a variant for GPUs, see
    `rtmap_models.export.half`. Otherwise `read_weights` gives the network's state dict back from
    the file. ParityMiss when the graph and torch differ by more than the tolerance: then nothing is
    written.
    """
    network = network.eval()
    model = _trace(network)
    _clean(model)
    short_indices(model)
    pad_with_zeros(model)
    if half:
        to_half(model)
    else:
        keep_weights(model, network.state_dict())
    _describe(model, network, metadata)
    with whole_file(path) as temporary:
        onnx.checker.check_model(model, full_check=True)
        onnx.save(model, temporary)
        report = parity_report(network, temporary, HALF if half else SINGLE)
        if not report.within:
            raise ParityMiss(path, report)
    return report


def _trace(network: nn.Module) -> onnx.ModelProto:
    # Traced at sizes above one: a graph traced at 1 claims to be dynamic and fails at 3.
    inputs = example_inputs(network.config, batch=2, cameras=3, priors=4)
    names = inputs_of(network.config)
    batch, cameras, priors = (torch.export.Dim(name, min=1) for name in ("B", "N", "P"))
    second = {"images": cameras, "ego_to_image": cameras}
    shapes: dict[str, Any] = {name: {0: batch, 1: second.get(name, priors)} for name in names}
    if "raster" in shapes:
        shapes["raster"] = {0: batch}
    for name in ("torch.onnx", "onnxscript"):  # what they miss or skip is no news for a user
        logging.getLogger(name).setLevel(logging.ERROR)
    with torch.no_grad(), warnings.catch_warnings(), lean(network):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network,
            inputs,
            dynamo=True,
            opset_version=OPSET,
            input_names=list(names),
            output_names=list(OUTPUTS),
            dynamic_shapes=shapes,
            external_data=False,
            verbose=False,
            optimize=False,
        )
    assert program is not None
    return _fold(program.model)


def _fold(model: Any) -> onnx.ModelProto:
    """Fold constants and drop what is computed twice.

    The exporter's own optimisation does this too, but merges batch normalisation into the
    convolutions before it: the weights could not be read back. onnxruntime merges them when it
    loads the file, and is as fast.
    """
    import onnx_ir
    import onnx_ir.passes.common as passes
    from onnxscript import optimizer

    optimizer.inline(model)
    for _ in range(2):
        optimizer.fold_constants_ir(model)
        optimizer.remove_unused_nodes(model)
    for step in (
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.LiftSubgraphInitializersToMainGraphPass(),
        passes.DeduplicateInitializersPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.OutputFixPass(),
        passes.NameFixPass(),
    ):
        step(model)
    return onnx_ir.to_proto(model)


def short_indices(model: onnx.ModelProto) -> int:
    """Let ``GatherElements`` take int32 indices that were made long for it; returns how many.

    torch gathers by int64 only, ONNX by both; the short ones are read and made faster.
    """
    graph = onnx.shape_inference.infer_shapes(model).graph
    kinds = {v.name: v.type.tensor_type.elem_type for v in graph.value_info}
    longer = {
        n.output[0]: n.input[0]
        for n in model.graph.node
        if n.op_type == "Cast" and kinds.get(n.input[0]) == TensorProto.INT32
    }
    count = 0
    for node in model.graph.node:
        if node.op_type == "GatherElements" and node.input[1] in longer:
            node.input[1] = longer[node.input[1]]
            count += 1
    used = {name for node in model.graph.node for name in node.input}
    idle = [n for n in model.graph.node if n.output[0] in longer and n.output[0] not in used]
    for node in idle:
        model.graph.node.remove(node)
    return count


def _clean(model: onnx.ModelProto) -> None:
    """Remove what the exporter noted about the machine it ran on."""
    del model.metadata_props[:]
    model.doc_string = ""
    graphs: list[Any] = [model.graph, *model.functions]
    for graph in graphs:
        graph.doc_string = ""
        del graph.metadata_props[:]
        for node in graph.node:
            node.doc_string = ""
            del node.metadata_props[:]
        for value in graph.value_info:
            del value.metadata_props[:]
    for value in [*model.graph.input, *model.graph.output, *model.graph.initializer]:
        value.doc_string = ""
        del value.metadata_props[:]


def _describe(model: onnx.ModelProto, network: nn.Module, extra: dict[str, Any]) -> None:
    """The metadata of docs/model-contract.md; structured values as JSON text."""
    config = network.config
    model.producer_name, model.producer_version = "rtmap", ""
    half = any(i.data_type == TensorProto.FLOAT16 for i in model.graph.initializer)
    values: dict[str, Any] = {
        "model_name": config.name,
        "model_version": "1",
        "architecture": getattr(config, "architecture", "tiny"),
        "classes": list(config.classes),
        "range_m": {
            "x": [config.range_m[0], config.range_m[2]],
            "y": [config.range_m[1], config.range_m[3]],
        },
        "axis_order": "x forward, y left",
        "ground": "z = 0",
        "units": "metres",
        "vertex_count": config.vertex_count,
        "new_queries": config.new_queries,
        "prior_slots": config.prior_slots,
        "image_size": list(config.image_size),
        "horizon": config.horizon,
        "sigma": "standard deviation, metres",
        "opset": OPSET,
        "precision": "float16" if half else "float32",
        "parameters": sum(p.numel() for p in network.parameters()),
    } | extra
    if isinstance(config, SemanticConfig):
        values["raster"] = {
            "planes": list(config.planes),
            "cell_m": config.raster_cell_m,
            "half_m": list(config.raster_half_m),
        }
        del values["image_size"], values["horizon"]
    else:
        values["camera_count"] = "dynamic"
    for key, value in values.items():
        _note(model, f"rtmap.{key}", value)
    _note(model, CONFIG_KEY, config.to_dict())


def _note(model: onnx.ModelProto, key: str, value: Any) -> None:
    entry = model.metadata_props.add()
    entry.key = key
    entry.value = value if isinstance(value, str) else json.dumps(value)


def code_version() -> str:
    """SHA-256 (12 digits) of the sources of this package: says which code made a model."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(source.relative_to(Path(__file__).parents[1]).as_posix().encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
