"""The network of rtmap: torch modules, training and the export to ONNX."""
