"""Evaluating a policy: serve ranges, robustness sweep, tables, figures and model cards.

Measuring a policy by the rules of the game belongs here, not the rules (``task``). Imports ``rl`` and the rooms
below. ``python -m pace.evaluation RUN`` evaluates, ``python -m pace.evaluation.keep`` publishes a policy.
"""
