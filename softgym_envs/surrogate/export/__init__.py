"""Trained condensed models outside Python: a C header for microcontrollers, an ONNX graph for everything else."""
