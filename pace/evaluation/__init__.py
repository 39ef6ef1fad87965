"""How well a policy plays: serve ranges, robustness sweep, tables, figures and model cards.

Here belongs the measurement of a policy by the rules of the game. Imports ``rl`` and the rooms below."""
