"""Models of strangers: ONNX files, checked and run in a child process with limits."""
