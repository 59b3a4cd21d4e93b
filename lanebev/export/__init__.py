"""LaneBEV for other runtimes: its parts as ONNX files or exported programs, and a run by them."""
