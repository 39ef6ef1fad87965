"""A policy for a robot: the graph of all that it computes, and its ONNX file.

Here belongs what leaves this package as a file; the steps themselves are in ``onboard``. Imports ``rl`` and the rooms
below."""
