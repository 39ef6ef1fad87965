"""Measurements for the documentation: engines, motors, predictions, ablations, the validation of the ball.

Measurements that answer a question, and are repeated when the code changes, belong here, not code that training or play
needs. May import every room. ``python -m pace.studies`` lists and runs them.
"""
