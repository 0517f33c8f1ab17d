"""From weights to one self-describing ONNX file, and back."""
