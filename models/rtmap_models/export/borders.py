"""Border padding of ``GridSample`` spelled out, because CPUs are fast with zero padding only.

onnxruntime's CPU kernel works out a place once for all channels where the padding is zeros, and
anew for every channel otherwise. Reading beyond the rim with border padding is reading at the
nearest centre of a pixel: places are clipped to these first, then the padding plays no part.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def pad_with_zeros(model: onnx.ModelProto) -> int:
    """Clip, in place, where bilinear samplings with border padding read; returns how many."""
    nodes: list[onnx.NodeProto] = []
    rims: dict[str, tuple[str, str]] = {}
    count = 0
    for node in model.graph.node:
        if node.op_type == "GridSample" and _replaceable(node):
            if node.input[0] not in rims:
                more, rims[node.input[0]] = _rim(node.input[0])
                nodes += more
            low, high = rims[node.input[0]]
            name = f"{node.output[0]}.where"
            nodes.append(helper.make_node("Max", [node.input[1], low], [f"{name}.low"]))
            nodes.append(helper.make_node("Min", [f"{name}.low", high], [name]))
            node.input[1] = name
            _set(node, padding_mode="zeros")
            count += 1
        nodes.append(node)
    if count:
        one = numpy_helper.from_array(np.array(1.0, np.float32), "border.one")
        model.graph.initializer.append(one)
        del model.graph.node[:]
        model.graph.node.extend(nodes)
    return count


def _replaceable(node: onnx.NodeProto) -> bool:
    given = {a.name: helper.get_attribute_value(a) for a in node.attribute}
    return (
        given.get("mode", b"linear") in (b"linear", b"bilinear")
        and given.get("padding_mode", b"zeros") == b"border"
        and given.get("align_corners", 0) == 0
    )


def _rim(features: str) -> tuple[list[onnx.NodeProto], tuple[str, str]]:
    """Nodes and names of the places (x, y) of the outermost pixels' centres of (B, C, H, W)."""
    p = f"{features}.rim"
    low, high = f"{p}.low", f"{p}.high"
    nodes = [
        helper.make_node("Shape", [features], [f"{p}.height"], start=2, end=3),
        helper.make_node("Shape", [features], [f"{p}.width"], start=3, end=4),
        helper.make_node("Concat", [f"{p}.width", f"{p}.height"], [f"{p}.size"], axis=0),
        helper.make_node("Cast", [f"{p}.size"], [f"{p}.extent"], to=TensorProto.FLOAT),
        helper.make_node("Reciprocal", [f"{p}.extent"], [f"{p}.pixel"]),
        helper.make_node("Sub", ["border.one", f"{p}.pixel"], [high]),
        helper.make_node("Neg", [high], [low]),
    ]
    return nodes, (low, high)


def _set(node: onnx.NodeProto, **values: str) -> None:
    kept = [a for a in node.attribute if a.name not in values]
    del node.attribute[:]
    node.attribute.extend([*kept, *(helper.make_attribute(k, v) for k, v in values.items())])
