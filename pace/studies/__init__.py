"""Measurements for the documentation: engines, motors, predictions, ablations, the validation of the ball.

Here belongs what answers a question once and is repeated when the code changes; nothing that training or play needs.
May import every room. ``python -m pace.studies`` lists and runs them.
"""
