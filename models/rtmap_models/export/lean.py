"""Modules whose graph is traced from other, equal code than training runs.

Eager torch and an ONNX runtime like different code: a runtime pays for every small operator and
for every broadcast along a short last axis, and samples fast only with zero padding. What is here
computes the same from the same parameters (the parity report of every export proves it); torch
never runs it but to trace it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import MethodType
from typing import Any

from torch import nn

from rtmap_models.bev import BevWarp
from rtmap_models.export.lean_decoder import decode
from rtmap_models.export.lean_pose import locate
from rtmap_models.export.lean_queries import propose
from rtmap_models.export.lean_warp import warp
from rtmap_models.pose import PoseHead
from rtmap_models.tiny.decoder import Decoder
from rtmap_models.tiny.queries import ProposalHead

FORMS: dict[type[nn.Module], Callable[..., Any]] = {
    BevWarp: warp,
    ProposalHead: propose,
    Decoder: decode,
    PoseHead: locate,
}
"""What stands for the ``forward`` of a module while it is traced."""


@contextmanager
def lean(network: nn.Module) -> Iterator[None]:
    """Let the modules of a network run their form of `FORMS` until the end."""
    changed = [m for m in network.modules() if type(m) in FORMS]
    for module in changed:
        module.forward = MethodType(FORMS[type(module)], module)
    try:
        yield
    finally:
        for module in changed:
            del module.forward
