"""Weights on disk: plain values and tensors only, read without executing anything."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rtmap_cli.errors import BadInput
from rtmap_cli.formats.model_file import find_model
from rtmap_cli.maps.footprint import METADATA_KEY, Footprint, read_footprint
from rtmap_cli.tables import whole_file
from rtmap_models.architecture import build_network
from rtmap_models.config import ModelConfig, config_from_dict, load_config
from rtmap_models.tensors import read_tensors

FORMAT = "rtmap.weights/1"


def save_checkpoint(path: Path, config: ModelConfig, content: dict[str, Any]) -> None:
    """Write ``content`` (state dicts and plain values) with the configuration, whole or not."""
    with whole_file(path) as temporary:
        torch.save({"format": FORMAT, "config": config.to_dict(), **content}, temporary)


def load_checkpoint(path: Path) -> tuple[ModelConfig, dict[str, Any]]:
    """Read a checkpoint; BadInput when it is missing, damaged or not one of rtmap's."""
    todo = "give the weights that rtmap train wrote"
    content = read_tensors(path, "a checkpoint", todo, "train again")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise BadInput(path, "not a checkpoint of rtmap train", f"expected format {FORMAT}")
    config = content.get("config")
    if not isinstance(config, dict) or not isinstance(content.get("average"), Mapping):
        raise BadInput(path, "not a checkpoint: configuration or weights missing", "train again")
    return config_from_dict(dict(config), path), content


def load_resumable(path: Path, config: ModelConfig) -> dict[str, Any]:
    """The content of a checkpoint from which training of ``config`` can go on; BadInput when it is
    of another configuration or holds the averaged weights only."""
    found, content = load_checkpoint(path)
    if found != config:
        old, new = found.to_dict(), config.to_dict()
        odd = ", ".join(sorted(k for k in old.keys() | new.keys() if old.get(k) != new.get(k)))
        raise BadInput(
            path,
            f"another configuration than the one to train ({odd})",
            "use --init, or start anew",
        )
    if not {"network", "optimizer", "step", "seconds"} <= set(content):
        raise BadInput(path, "holds averaged weights only, not where training stood", "use --init")
    return content


def load_network(path: Path) -> tuple[Any, dict[str, Any]]:
    """A network in evaluation mode and what is known of its training: the averaged weights of a
    checkpoint with its content, or those that an ONNX file of ``rtmap export-model`` (also a model
    of the zoo, by its name) was made of, with what its metadata say."""
    path = _weights_file(str(path))
    if path.suffix == ".onnx":
        return _network_of_export(path)
    config, content = load_checkpoint(path)
    network = build_network(config)
    try:
        network.load_state_dict(content["average"])
    except (KeyError, RuntimeError) as error:
        raise BadInput(path, "the weights do not fit the configuration", "train again") from error
    return network.eval(), content


def _network_of_export(path: Path) -> tuple[Any, dict[str, Any]]:
    from rtmap_models.export.onnx_weights import read_metadata

    state = _read_state(path)
    network = build_network(config_to_train(None, str(path)))
    network.load_state_dict(state)
    text = read_metadata(path).get("rtmap.training", "null")
    try:
        known = json.loads(text)
        numbers = {k: known[k] for k in ("step", "samples", "frames", "seconds")}
    except (ValueError, TypeError, KeyError) as error:
        raise BadInput(
            path, f"does not say how it was trained ({error})", "give the checkpoint"
        ) from error
    return network.eval(), numbers | {"footprint": footprint_of_source(str(path)).as_json()}


def start_from(network: nn.Module, source: str, partial: bool = False) -> list[str]:
    """Give a network the weights of ``source``: a checkpoint (its averaged weights), an ONNX file
    of ``rtmap export-model``, or the name of a model of the zoo.

    BadInput when names or shapes differ from the network's (another configuration); with
    ``partial`` what differs keeps its fresh value, and its names are returned.
    """
    state = _read_state(_weights_file(source))
    if partial and (adopt := getattr(network, "adopt", None)) is not None:
        state = adopt(state)
    own = network.state_dict()
    fitting = {k: v for k, v in state.items() if k in own and v.shape == own[k].shape}
    odd = sorted((own.keys() | state.keys()) - fitting.keys())
    if odd and not partial:
        raise BadInput(
            source,
            f"{len(odd)} tensors do not fit this configuration ({_misfit(odd[0], state, own)})",
            "train the configuration that it was made with, or pass --init-partial",
        )
    if not fitting:
        raise BadInput(source, "none of its tensors fits this configuration")
    network.load_state_dict(fitting, strict=False)
    return [name for name in odd if name in own]


def config_to_train(named: str | Path | None, source: str | None) -> ModelConfig:
    """The configuration of that name or file, else that of the weights ``source`` to start from
    (see `start_from`), else the default one."""
    if named is not None or source is None:
        return load_config(named or "rtmap-tiny")
    path = _weights_file(source)
    if path.suffix != ".onnx":
        return load_checkpoint(path)[0]
    from rtmap_models.export.onnx_weights import read_configuration

    values = read_configuration(path)
    if values is None:
        raise BadInput(path, "does not say its configuration", "name it with --config")
    return config_from_dict(values, path)


def _misfit(name: str, state: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> str:
    def shape(tensors: Mapping[str, Tensor]) -> str:
        return "×".join(map(str, tensors[name].shape)) or "1" if name in tensors else "absent"

    return f"{name}: there {shape(state)}, here {shape(own)}"


def footprint_of(content: Mapping[str, Any], where: str | Path) -> Footprint:
    """What the training behind a checkpoint saw; unknown in those written before it was noted."""
    try:
        return read_footprint(content.get("footprint"))
    except ValueError as error:
        raise BadInput(where, f"not a checkpoint: {error}", "train again") from None


def footprint_of_source(source: str) -> Footprint:
    """The same of what ``start_from`` takes."""
    path = _weights_file(source)
    if path.suffix != ".onnx":
        return footprint_of(load_checkpoint(path)[1], path)
    from rtmap_models.export.onnx_weights import read_metadata

    text = read_metadata(path).get(METADATA_KEY, "null")
    try:
        return read_footprint(json.loads(text))
    except ValueError as error:
        raise BadInput(path, f"its metadata make no sense ({error})", "export it again") from None


def _weights_file(source: str) -> Path:
    path = Path(source)
    named = path.suffix != ".onnx" and not path.exists() and "/" not in source and not path.suffix
    return find_model(source) if named else path


def _read_state(path: Path) -> Mapping[str, Tensor]:
    if path.suffix == ".onnx":
        from rtmap_models.export.onnx_weights import read_weights

        state = read_weights(path)
        if state is None:
            raise BadInput(path, "holds no weights to train on", "give a checkpoint instead")
        return state
    average: Mapping[str, Tensor] = load_checkpoint(path)[1]["average"]
    return average
