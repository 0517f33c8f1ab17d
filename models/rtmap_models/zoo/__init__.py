"""Exported models, each one self-describing ONNX file with a card beside it. No torch here."""

from __future__ import annotations

from pathlib import Path

DEFAULT = "rtmap-tiny"
"""The model that commands use when none is named."""


def names() -> list[str]:
    """The models of the zoo, sorted."""
    return sorted(path.stem for path in Path(__file__).parent.glob("*.onnx"))


def model_path(name: str = DEFAULT) -> Path:
    """The ONNX file of a model of the zoo; FileNotFoundError names the models that exist."""
    if name not in names():
        have = ", ".join(names()) or "none"
        raise FileNotFoundError(f"no model named {name!r} in the zoo (there is: {have})")
    return Path(__file__).parent / f"{name}.onnx"
