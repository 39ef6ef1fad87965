"""The robot's physics: one protocol, and the engines behind it.

Here belongs what steps joints and bodies; not the ball, which is a kernel of its own (``sim.ball``). Imports
``sim.robot``, ``arrays`` and the rooms below; ``sim.worlds`` imports it.
"""
