"""The half-precision variant of an exported graph, for GPUs with fast float16 units.

Convolutions and products with weights, and what lies between them, work in float16. Everything
that places something stays float32: projection, coordinates, ``grid_sample``, selection, pose; so
do inputs and outputs. A product or convolution whose result reaches a coordinate, a selection or an
output without passing another weight (the last layer of a head) stays float32 too: half a
millimetre at 1 m is 2 cm at 36 m. The pass sees operators only and serves every architecture.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

WEIGHTED = {"Conv", "ConvTranspose", "MatMul", "Gemm"}
"""Start of float16, where one input is a float32 weight."""

BETWEEN = {
    "Add", "AveragePool", "Concat", "Dropout", "Flatten", "Gelu", "GlobalAveragePool", "Identity",
    "LayerNormalization", "MaxPool", "Mul", "Relu", "Reshape", "Resize", "Sigmoid", "Slice",
    "Split", "Squeeze", "Transpose", "Unsqueeze",
}  # fmt: skip
"""Stay in float16 when everything that varies in their input is float16 already."""

DATA_INPUTS = {
    "Reshape": 1, "Resize": 1, "Slice": 1, "Split": 1, "Squeeze": 1, "Unsqueeze": 1,
}  # fmt: skip
"""How many leading inputs hold data; the others are shapes and stay as they are."""

COORDINATES = {"GridSample": 1}
"""Inputs that are places: operator and the index of the input."""

SELECTIONS = {"TopK", "ArgMax", "ArgMin", "Where", "Greater", "Less", "Equal", "GatherElements"}
"""Operators that choose, or read what was chosen: their inputs stay float32."""


def to_half(model: onnx.ModelProto) -> None:
    """Turn an exported float32 graph into its half-precision variant, in place.

    Batch normalisation is folded into the convolutions first, in float32.
    """
    fold_batch_norms(model)
    graph = model.graph
    types = _types(model)
    half = _half_nodes(graph, types)
    _insert_casts(graph, half, types)
    del graph.value_info[:]


def fold_batch_norms(model: onnx.ModelProto) -> None:
    """Fold every BatchNormalization that follows a Conv with constant weights into it."""
    graph = model.graph
    weights = {i.name: i for i in graph.initializer}
    producer = {name: node for node in graph.node for name in node.output}
    uses = _uses(graph)
    gone = []
    for node in graph.node:
        conv = producer.get(node.input[0]) if node.op_type == "BatchNormalization" else None
        if conv is None or conv.op_type != "Conv" or len(uses[node.input[0]]) != 1:
            continue
        if not weights.keys() >= {conv.input[1], *node.input[1:5]}:
            continue
        scale, shift, mean, variance = (numpy_helper.to_array(weights[n]) for n in node.input[1:5])
        epsilon = next((a.f for a in node.attribute if a.name == "epsilon"), 1e-5)
        factor = scale.astype(np.float64) / np.sqrt(variance.astype(np.float64) + epsilon)
        kernel = numpy_helper.to_array(weights[conv.input[1]]).astype(np.float64)
        has_bias = len(conv.input) > 2 and conv.input[2] != ""
        bias = numpy_helper.to_array(weights[conv.input[2]]) if has_bias else 0.0
        kernel = kernel * factor.reshape(-1, *[1] * (kernel.ndim - 1))
        bias = (bias - mean) * factor + shift
        names = (f"{node.output[0]}.kernel", f"{node.output[0]}.bias")
        for name, value in zip(names, (kernel, bias), strict=True):
            graph.initializer.append(numpy_helper.from_array(value.astype(np.float32), name))
        del conv.input[1:]
        conv.input.extend(names)
        conv.output[0] = node.output[0]
        gone.append(node)
    for node in gone:
        graph.node.remove(node)
    _drop_unused(graph)


def _types(model: onnx.ModelProto) -> dict[str, int]:
    """Element type of every value of the graph."""
    inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
    values = [*inferred.value_info, *inferred.input, *inferred.output]
    types = {v.name: v.type.tensor_type.elem_type for v in values}
    return types | {i.name: i.data_type for i in model.graph.initializer}


def _uses(graph: onnx.GraphProto) -> dict[str, list[tuple[onnx.NodeProto, int]]]:
    uses: dict[str, list[tuple[onnx.NodeProto, int]]] = {}
    for node in graph.node:
        for k, name in enumerate(node.input):
            uses.setdefault(name, []).append((node, k))
    return uses


def _weighted(node: onnx.NodeProto, constants: set[str], types: dict[str, int]) -> bool:
    names = node.input[:2]
    return (
        node.op_type in WEIGHTED
        and len(constants.intersection(names)) == 1
        and all(types.get(n) == TensorProto.FLOAT for n in names)
    )


def _exact(graph: onnx.GraphProto, weighted: set[str]) -> set[str]:
    """Values from which a place, a choice or an output follows without another weight."""
    exact = {v.name for v in graph.output}
    for node in reversed(graph.node):
        if node.output[0] in weighted:
            continue
        place = COORDINATES.get(node.op_type)
        if node.op_type in SELECTIONS or exact.intersection(node.output):
            # What a grid reads is only data; where it reads is a place.
            exact.update(n for k, n in enumerate(node.input) if place is None or k == place)
        elif place is not None:
            exact.add(node.input[place])
    return exact


def _half_nodes(graph: onnx.GraphProto, types: dict[str, int]) -> set[str]:
    """Nodes that work in float16, by their first output."""
    constants = {i.name for i in graph.initializer}
    weighted = {n.output[0] for n in graph.node if _weighted(n, constants, types)}
    exact = _exact(graph, weighted)
    half: set[str] = set()
    made: set[str] = set()
    for node in graph.node:
        if exact.intersection(node.output):
            continue
        varies = [n for n in _data(node) if n not in constants and n]
        flows = node.op_type in BETWEEN and varies and made.issuperset(varies)
        if node.output[0] in weighted or flows:
            half.add(node.output[0])
            made.update(node.output)
    return half


def _data(node: onnx.NodeProto) -> list[str]:
    return list(node.input[: DATA_INPUTS.get(node.op_type, len(node.input))])


def _insert_casts(graph: onnx.GraphProto, half: set[str], types: dict[str, int]) -> None:
    """Rewrite the nodes: weights of float16 nodes are converted, values cast once per side."""
    weights = {i.name: i for i in graph.initializer}
    made = {name for node in graph.node if node.output[0] in half for name in node.output}
    done: set[str] = set()
    nodes: list[onnx.NodeProto] = []

    def cast(name: str, to: int, suffix: str) -> str:
        new = name + suffix
        if new not in done:
            done.add(new)
            if name in weights:
                value = numpy_helper.to_array(weights[name]).astype(np.float16)
                graph.initializer.append(numpy_helper.from_array(value, new))
            else:
                nodes.append(helper.make_node("Cast", [name], [new], new, to=to))
        return new

    for node in graph.node:
        inside = node.output[0] in half
        for k, name in enumerate(node.input):
            data = k < DATA_INPUTS.get(node.op_type, len(node.input))
            if inside and data and types.get(name) == TensorProto.FLOAT and name not in made:
                node.input[k] = cast(name, TensorProto.FLOAT16, ".half")
            elif not inside and name in made:
                node.input[k] = cast(name, TensorProto.FLOAT, ".single")
        nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)
    _drop_unused(graph)


def _drop_unused(graph: onnx.GraphProto) -> None:
    used: set[str] = {name for node in graph.node for name in node.input}
    kept: Iterable[onnx.TensorProto] = [i for i in graph.initializer if i.name in used]
    del graph.initializer[:]
    graph.initializer.extend(kept)
