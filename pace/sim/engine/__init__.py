"""The robot's physics: one protocol, and the engines behind it.

Stepping joints and bodies belongs here; the ball, which has a separate kernel (``sim.ball``), does not. Imports
``sim.robot``, ``arrays`` and the rooms below; ``sim.worlds`` imports it.
"""
