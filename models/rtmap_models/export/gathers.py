"""``GridSample`` spelled out, for CPUs: four reads of whole feature rows and two blends.

onnxruntime's CPU kernel works out every place anew for every channel; here it is worked out once
and all channels of a cell are read in one piece. For maps of many channels that takes half of the
time; the values differ by rounding only.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import helper, numpy_helper

LEAST_CHANNELS = 8
"""Below this the kernel is as fast."""


def spell_out_grid_samples(model: onnx.ModelProto) -> int:
    """Replace, in place, bilinear samplings with border padding of maps with many channels.

    Returns how many. Others (another mode or padding, few or unknown channels) stay.
    """
    graph = model.graph
    inferred = onnx.shape_inference.infer_shapes(model).graph
    shapes = {v.name: v.type.tensor_type.shape.dim for v in inferred.value_info}
    nodes: list[onnx.NodeProto] = []
    spelled: set[str] = set()
    count = 0
    for node in graph.node:
        dims = shapes.get(node.input[0]) if node.op_type == "GridSample" else None
        if dims is None or not _replaceable(node) or dims[1].dim_value < LEAST_CHANNELS:
            nodes.append(node)
            continue
        if node.input[0] not in spelled:
            nodes += _rows(node.input[0], dims[1].dim_value)
            spelled.add(node.input[0])
        nodes += _sample(node)
        count += 1
    if count:
        del graph.node[:]
        graph.node.extend(nodes)
        _add_numbers(graph, sorted({shapes[x][1].dim_value for x in spelled}))
    return count


def _add_numbers(graph: onnx.GraphProto, channels: list[int]) -> None:
    """The constants that the new nodes name; lists where an axis must stay, else scalars."""
    numbers: dict[str, float | int | list[int]] = {"1.0": 1.0, "0.5": 0.5, "0.0": 0.0}
    numbers |= {"at 0": 0, "at 1": 1, "0": [0], "1": [1]}
    numbers |= {f"channels {c}": [-1, c] for c in channels}
    for name, value in numbers.items():
        kind = np.float32 if isinstance(value, float) else np.int64
        graph.initializer.append(numpy_helper.from_array(np.array(value, kind), f"grid {name}"))


def _replaceable(node: onnx.NodeProto) -> bool:
    given = {a.name: helper.get_attribute_value(a) for a in node.attribute}
    return (
        given.get("mode", b"linear") in (b"linear", b"bilinear")
        and given.get("padding_mode", b"zeros") == b"border"
        and given.get("align_corners", 0) == 0
    )


class _Writer:
    """Nodes under one prefix; ``writer(op, inputs, name)`` returns the name of the result."""

    def __init__(self, prefix: str) -> None:
        self.prefix, self.nodes = prefix, list[onnx.NodeProto]()

    def __call__(self, op: str, inputs: list[str], name: str, **attributes: object) -> str:
        out = f"{self.prefix}.{name}"
        self.nodes.append(helper.make_node(op, inputs, [out], out, **attributes))
        return out


def _rows(features: str, channels: int) -> list[onnx.NodeProto]:
    """Once per map (B, C, H, W): its rows (B·H·W, C), its sizes and where each sample begins."""
    w = _Writer(features)
    last = w("Transpose", [features], "last", perm=[0, 2, 3, 1])
    w("Reshape", [last, f"grid channels {channels}"], "rows")
    height = w("Shape", [features], "height", start=2, end=3)
    width = w("Shape", [features], "width", start=3, end=4)
    size = w("Cast", [w("Concat", [width, height], "size", axis=0)], "extent", to=1)
    w("Sub", [size, "grid 1.0"], "limit")
    w("Mul", [size, "grid 0.5"], "half")
    batch = w("Squeeze", [w("Shape", [features], "batch", start=0, end=1)], "count")
    index = w("Range", ["grid at 0", batch, "grid at 1"], "samples")
    first = w("Mul", [index, w("Mul", [height, width], "cells")], "first")
    column = w("Unsqueeze", [first, "grid 1"], "column")
    w("Unsqueeze", [column, "grid 1"], "start")
    return w.nodes


def _sample(node: onnx.NodeProto) -> list[onnx.NodeProto]:
    """Bilinear values at (B, h, w, 2) in -1 … 1, pixel centres between whole numbers."""
    x, grid = node.input[0], node.input[1]
    w = _Writer(node.output[0])
    scaled = w("Mul", [w("Add", [grid, "grid 1.0"], "from_0"), f"{x}.half"], "scaled")
    place = w("Sub", [scaled, "grid 0.5"], "place")
    place = w("Max", [w("Min", [place, f"{x}.limit"], "upper"), "grid 0.0"], "inside")
    low = w("Floor", [place], "low")
    high = w("Min", [w("Add", [low, "grid 1.0"], "next"), f"{x}.limit"], "high")
    part = w("Sub", [place, low], "part")
    corners = {}
    for side, value in (("low", low), ("high", high)):
        whole = w("Cast", [value], f"{side}_index", to=7)
        column = w("Gather", [whole, "grid at 0"], f"{side}_column", axis=-1)
        row = w("Gather", [whole, "grid at 1"], f"{side}_row", axis=-1)
        line = w("Mul", [row, f"{x}.width"], f"{side}_line")
        corners[side] = (w("Add", [line, f"{x}.start"], f"{side}_begin"), column)
    across = w("Gather", [part, "grid 0"], "across", axis=-1)
    along = w("Gather", [part, "grid 1"], "along", axis=-1)
    blended = []
    for side in ("low", "high"):
        ends = []
        for end in ("low", "high"):
            at = w("Add", [corners[side][0], corners[end][1]], f"{side}_{end}_at")
            ends.append(w("Gather", [f"{x}.rows", at], f"{side}_{end}", axis=0))
        step = w("Mul", [w("Sub", [ends[1], ends[0]], f"{side}_rise"), across], f"{side}_step")
        blended.append(w("Add", [ends[0], step], f"{side}_value"))
    step = w("Mul", [w("Sub", [blended[1], blended[0]], "rise"), along], "step")
    value = w("Add", [blended[0], step], "value")
    w.nodes.append(helper.make_node("Transpose", [value], list(node.output), perm=[0, 3, 1, 2]))
    return w.nodes
