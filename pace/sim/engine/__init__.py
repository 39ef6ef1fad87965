"""The robot's physics: one protocol, and the engines behind it.

Stepping joints and bodies belongs here, not the ball, which has a separate kernel (``sim.ball``). Imports
``sim.robot``, ``arrays`` and the rooms below; ``sim.worlds`` imports it.
"""
