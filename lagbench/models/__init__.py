"""Models of other code bases: ONNX files, and our architectures trained elsewhere."""
