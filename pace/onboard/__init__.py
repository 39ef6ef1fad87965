"""What the robot computes from its sensors, one step at a time.

Here belongs all that runs on the robot between its readings and its actor; nothing that knows the simulation's truth.
Imports ``sim``, ``predictor`` and the rooms below."""
