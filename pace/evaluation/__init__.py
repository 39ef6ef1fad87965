"""How well a policy plays: serve ranges, robustness sweep, tables, figures and model cards.

Here belongs the measurement of a policy by the rules of the game; not the rules (``task``). Imports ``rl`` and the
rooms below. ``python -m pace.evaluation RUN`` evaluates, ``python -m pace.evaluation.keep`` publishes a policy.
"""
