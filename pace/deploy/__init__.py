"""Exporting a policy for a robot: its whole computation as one graph, and the ONNX file.

The exported file belongs here, not the estimators that it computes (``onboard``). Imports ``rl`` and the rooms
below. ``python -m pace.deploy RUN`` exports.
"""
