"""The robot's physics: one protocol, and the engines behind it."""
