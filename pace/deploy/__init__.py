"""A policy for a robot: the graph of all that it computes, and its ONNX file.

Here belongs what leaves this package as a file; not the steps that it computes (``onboard``). Imports ``rl`` and the
rooms below. ``python -m pace.deploy RUN`` exports.
"""
