"""One self-describing ONNX file: standard operators, dynamic batch, cameras and prior slots."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import Tensor

from rtmap_cli.errors import NoAnswer
from rtmap_cli.tables import whole_file
from rtmap_models.config import ModelConfig
from rtmap_models.network import RTMapNet

OPSET = 20
INPUTS = ("images", "ego_to_image", "prior_points", "prior_class", "prior_mask")
OUTPUTS = ("scores", "points", "sigma", "prior_score", "pose_delta", "pose_covariance")

PARITY_M = 2e-3
"""Largest difference between torch and onnxruntime that an export may have: metres, radians, or
relative where a value exceeds 1."""


def example_inputs(
    config: ModelConfig, batch: int, cameras: int, priors: int, seed: int = 0
) -> tuple[Tensor, ...]:
    """Plausible inputs of any size: noise images, cameras all round, straight prior lines."""
    rng = np.random.default_rng(seed)
    height, width = config.image_size
    images = rng.integers(0, 256, (batch, cameras, height, width, 3), dtype=np.uint8)
    projections = np.zeros((batch, cameras, 3, 4), np.float32)
    for k in range(cameras):
        projections[:, k] = _looking(2 * np.pi * k / cameras, config)
    start = rng.uniform(-15, 15, (batch, priors, 1, 2))
    step = rng.normal(0, 1, (batch, priors, 1, 2))
    along = np.linspace(-1, 1, config.vertex_count)[:, None]
    points = (start + step * 5 * along).astype(np.float32)
    class_id = rng.integers(0, len(config.classes), (batch, priors))
    mask = (rng.random((batch, priors)) < 0.8).astype(np.float32)
    arrays = (images, projections, points, class_id, mask)
    return tuple(torch.from_numpy(np.ascontiguousarray(a)) for a in arrays)


def _looking(yaw: float, config: ModelConfig) -> np.ndarray:
    """(3, 4) projection of a level camera 1.5 m above the road that looks towards ``yaw``."""
    height, width = config.image_size
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rows = np.stack([right, [0.0, 0.0, -1.0], forward])
    focal = 0.6 * width
    k = np.array([[focal, 0, width / 2], [0, focal, config.horizon * height], [0, 0, 1]])
    centre = np.array([0.0, 0.0, 1.5])
    return k @ np.column_stack([rows, -rows @ centre])


def export_onnx(network: RTMapNet, path: Path, metadata: dict[str, Any]) -> dict[str, float]:
    """Write the ONNX file and prove it against torch at two other sizes.

    ``metadata`` adds to what the configuration says (training data, licence, …). Returns the
    largest differences per output; NoAnswer when one exceeds `PARITY_M`.
    """
    network = network.eval()
    with whole_file(path) as temporary:
        _trace(network, temporary)
        model = onnx.load(temporary)
        _clean(model)
        _describe(model, network.config, metadata)
        onnx.checker.check_model(model, full_check=True)
        onnx.save(model, temporary)
        differences = parity(network, temporary)
        worst = max(differences.values())
        if not worst <= PARITY_M:
            name = max(differences, key=lambda k: differences[k])
            raise NoAnswer(f"{name} of the graph differs from torch by {worst:.2g}: not written")
    return differences


def _trace(network: RTMapNet, path: Path) -> None:
    # Traced at sizes above one: a graph traced at 1 claims to be dynamic and fails at 3.
    inputs = example_inputs(network.config, batch=2, cameras=3, priors=4)
    batch, cameras, priors = (torch.export.Dim(name, min=1) for name in ("B", "N", "P"))
    shapes = {
        "images": {0: batch, 1: cameras},
        "ego_to_image": {0: batch, 1: cameras},
        "prior_points": {0: batch, 1: priors},
        "prior_class": {0: batch, 1: priors},
        "prior_mask": {0: batch, 1: priors},
    }
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            inputs,
            str(path),
            dynamo=True,
            opset_version=OPSET,
            input_names=list(INPUTS),
            output_names=list(OUTPUTS),
            dynamic_shapes=shapes,
            external_data=False,
            verbose=False,
        )


def _clean(model: onnx.ModelProto) -> None:
    """Remove what the exporter noted about the machine it ran on."""
    del model.metadata_props[:]
    model.doc_string = ""
    graphs: list[Any] = [model.graph, *model.functions]
    for graph in graphs:
        graph.doc_string = ""
        for node in graph.node:
            node.doc_string = ""
            del node.metadata_props[:]
        for value in [*graph.value_info] if hasattr(graph, "value_info") else []:
            del value.metadata_props[:]
    for value in [*model.graph.input, *model.graph.output, *model.graph.initializer]:
        value.doc_string = ""
        del value.metadata_props[:]
    del model.graph.metadata_props[:]


def _describe(model: onnx.ModelProto, config: ModelConfig, extra: dict[str, Any]) -> None:
    """The metadata of docs/model-contract.md; structured values as JSON text."""
    model.producer_name = "rtmap"
    values: dict[str, Any] = {
        "model_name": config.name,
        "model_version": "1",
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
    } | extra
    for key, value in values.items():
        entry = model.metadata_props.add()
        entry.key = f"rtmap.{key}"
        entry.value = value if isinstance(value, str) else json.dumps(value)


def parity(
    network: RTMapNet, path: Path, sizes: tuple[tuple[int, int, int], ...] = ((1, 7, 9), (3, 5, 1))
) -> dict[str, float]:
    """Largest difference torch against onnxruntime per output, at (B, N, P) sizes.

    Absolute up to 1 and relative above it (a variance may be large).
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    worst = dict.fromkeys(OUTPUTS, 0.0)
    for seed, (batch, cameras, priors) in enumerate(sizes):
        inputs = example_inputs(network.config, batch, cameras, priors, seed + 1)
        with torch.no_grad():
            expected = network(*inputs)
        feed = {name: x.numpy() for name, x in zip(INPUTS, inputs, strict=True)}
        got = session.run(list(OUTPUTS), feed)
        for name, a, b in zip(OUTPUTS, expected, got, strict=True):
            difference = np.abs(a.numpy() - b) / np.maximum(1.0, np.abs(b))
            worst[name] = max(worst[name], float(difference.max()))
    return worst


def code_version() -> str:
    """SHA-256 (12 digits) of the sources of this package: says which code made a model."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(source.relative_to(Path(__file__).parent).as_posix().encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
