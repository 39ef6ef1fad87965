"""Studies of the simulation for ``docs/engines.md`` and ``docs/physics.md``: engines, step sizes, paddle reaction."""
