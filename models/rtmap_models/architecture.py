"""The network that a configuration describes: one interface, three architectures.

Every network has ``config``; ``forward`` (the exported graph, docs/model-contract.md);
``predict_batch(batch, bf16=False)`` → the output of every layer; ``losses(batch, bf16)`` → the
weighted parts by name, whose sum is the loss.
"""

from __future__ import annotations

from torch import nn

from rtmap_models.config import ModelConfig, PaperConfig, SemanticConfig, TinyConfig


def build_network(config: ModelConfig) -> nn.Module:
    """A network with fresh weights, chosen by ``config.architecture``."""
    if isinstance(config, PaperConfig):
        from rtmap_models.paper.network import build_paper_network

        return build_paper_network(config)
    if isinstance(config, SemanticConfig):
        from rtmap_models.semantic.network import SemanticNet

        return SemanticNet(config)
    from rtmap_models.tiny.network import RTMapNet

    assert isinstance(config, TinyConfig)
    return RTMapNet(config)
