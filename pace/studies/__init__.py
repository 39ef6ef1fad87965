"""Studies of the simulation for ``docs/results``: engines, step sizes, paddle reaction."""
