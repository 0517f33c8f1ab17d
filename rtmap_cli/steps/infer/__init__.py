"""From a log to observations through an ONNX network."""

from rtmap_cli.steps.infer.infer import InferOptions, infer_log
from rtmap_cli.steps.infer.model import MapModel, ModelInfo, find_model

__all__ = ["InferOptions", "MapModel", "ModelInfo", "find_model", "infer_log"]
