"""The network of rtmap: torch modules, training and the export to ONNX.

This file and ``rtmap_models.zoo`` import no torch: exported models are found without it.
"""
