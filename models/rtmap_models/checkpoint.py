"""Weights on disk: plain values and tensors only, read without executing anything."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from typing import Any

import torch

from rtmap_cli.errors import BadInput
from rtmap_cli.tables import whole_file
from rtmap_models.config import ModelConfig, config_from_dict
from rtmap_models.network import RTMapNet

FORMAT = "rtmap.weights/1"


def save_checkpoint(path: Path, config: ModelConfig, content: dict[str, Any]) -> None:
    """Write ``content`` (state dicts and plain values) with the configuration, whole or not."""
    with whole_file(path) as temporary:
        torch.save({"format": FORMAT, "config": config.to_dict(), **content}, temporary)


def load_checkpoint(path: Path) -> tuple[ModelConfig, dict[str, Any]]:
    """Read a checkpoint; BadInput when it is missing, damaged or not one of rtmap's."""
    if not path.is_file():
        raise BadInput(path, "no such file", "give the weights that rtmap train wrote")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (
        RuntimeError,
        ValueError,
        LookupError,
        EOFError,
        OSError,
        pickle.PickleError,
        struct.error,
    ) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(path, f"not a checkpoint: {first}", "train again") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise BadInput(path, "not a checkpoint of rtmap train", f"expected format {FORMAT}")
    return config_from_dict(dict(content["config"]), path), content


def load_network(path: Path) -> tuple[RTMapNet, dict[str, Any]]:
    """The averaged network of a checkpoint in evaluation mode, and the checkpoint's content."""
    config, content = load_checkpoint(path)
    network = RTMapNet(config)
    try:
        network.load_state_dict(content["average"])
    except (KeyError, RuntimeError) as error:
        raise BadInput(path, "the weights do not fit the configuration", "train again") from error
    return network.eval(), content
