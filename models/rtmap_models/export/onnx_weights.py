"""The weights of an exported model, read back bit for bit: the ONNX file alone can train on.

An export keeps its parameters as initializers under their own names (batch normalisation is not
folded into convolutions: runtimes do that when they load the file). A matrix that the graph needs
transposed is called NAME.T. What the graph does not need but training does (auxiliary heads,
counters) stands in the file's ``training_info``, which runtimes do not read, with a list of where
every entry is to be found.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor

from rtmap_cli.errors import BadInput

DIGEST_KEY = "rtmap.weights_sha256"
CONFIG_KEY = "rtmap.config"
TRANSPOSED = ".T"

Array = NDArray[Any]


def keep_weights(model: onnx.ModelProto, state: Mapping[str, Tensor]) -> None:
    """Name every entry of a state dict in an exported model, and add those that it lacks.

    Changes names of initializers, ``training_info`` and one key of the metadata; never a value.
    """
    values = {name: tensor.detach().cpu().numpy() for name, tensor in state.items()}
    named = {i.name: _key(numpy_helper.to_array(i)) for i in model.graph.initializer}
    places = {key: name for name, key in named.items()}
    index: dict[str, str | None] = {}
    rename: dict[str, str] = {}
    for name, value in values.items():
        turned = places.get(_key(value.T)) if value.ndim == 2 else None
        if named.get(name) == _key(value):
            index[name] = name
        elif _key(value) in places:
            index[name] = places[_key(value)]
        elif turned is not None and turned not in values:
            index[name] = rename.setdefault(turned, name + TRANSPOSED)
        else:
            index[name] = None
    _rename(model.graph, rename)
    rest = [numpy_helper.from_array(values[n], n) for n, place in index.items() if place is None]
    training = model.training_info.add().algorithm
    training.name = "weights"
    training.initializer.extend(rest)
    training.doc_string = json.dumps({n: rename.get(p, p) if p else p for n, p in index.items()})
    entry = model.metadata_props.add()
    entry.key, entry.value = DIGEST_KEY, state_digest(values)


def read_weights(path: Path) -> dict[str, Tensor] | None:
    """The state dict (CPU) of the network that an ONNX file of `export_onnx` was made of.

    Bit for bit what was exported (the averaged weights of the checkpoint, calibration factors
    included, every key that ``load_state_dict`` wants), proven by a digest in the metadata. None
    when the file does not hold them: of another exporter, half precision, or changed since.
    BadInput when it is missing or no ONNX. Nothing in the file is executed.
    """
    model = _load(path)
    digest = _metadata(model).get(DIGEST_KEY)
    if digest is None or len(model.training_info) != 1:
        return None
    training = model.training_info[0].algorithm
    try:
        index = dict(json.loads(training.doc_string))
        rest = {i.name: numpy_helper.to_array(i) for i in training.initializer}
        named = {i.name: i for i in model.graph.initializer}
        values = {}
        for name, place in index.items():
            value = rest[name] if place is None else numpy_helper.to_array(named[place])
            values[name] = value.T if place and place == name + TRANSPOSED else value
    except (ValueError, TypeError, KeyError):
        return None
    if state_digest(values) != digest:
        return None
    return {name: torch.from_numpy(np.array(value)) for name, value in values.items()}


def read_configuration(path: Path) -> dict[str, Any] | None:
    """The configuration (plain values, as ``config_from_dict`` takes them) that an ONNX file
    states, or None when it states none. BadInput when it is missing or no ONNX."""
    try:
        values = json.loads(_metadata(_load(path)).get(CONFIG_KEY, ""))
    except ValueError:
        return None
    return values if isinstance(values, dict) else None


def read_metadata(path: Path) -> dict[str, str]:
    """What an ONNX file says of itself. BadInput when it is missing or no ONNX."""
    return _metadata(_load(path))


def state_digest(values: Mapping[str, Array]) -> str:
    """SHA-256 of a state dict: names, types, shapes and bytes, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(values):
        digest.update(repr((name, *_key(values[name]))).encode())
    return digest.hexdigest()


def _key(value: Array) -> tuple[str, tuple[int, ...], str]:
    return value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()


def _rename(graph: onnx.GraphProto, names: Mapping[str, str]) -> None:
    for tensor in graph.initializer:
        tensor.name = names.get(tensor.name, tensor.name)
    for node in graph.node:
        for k, name in enumerate(node.input):
            node.input[k] = names.get(name, name)


def _metadata(model: onnx.ModelProto) -> dict[str, str]:
    return {entry.key: entry.value for entry in model.metadata_props}


def _load(path: Path) -> onnx.ModelProto:
    """Parse an ONNX file without following references to other files."""
    if not path.is_file():
        raise BadInput(path, "no such file", "give an .onnx file of rtmap export-model")
    try:
        model = onnx.load(path, load_external_data=False)
    except Exception as error:  # protobuf raises its own untyped errors
        raise BadInput(path, f"cannot be read as ONNX ({error})", "export it again") from None
    if not model.graph.node:
        raise BadInput(path, "cannot be read as ONNX (no graph)", "export it again")
    return model
