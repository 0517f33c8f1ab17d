"""From a log to observations through an ONNX network."""
