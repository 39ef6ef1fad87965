"""On-board estimators of the robot, one torch module each: run by the environment and by the exported file.

All code that runs on the robot between its readings and its actor belongs here, not the simulation's truth.
Every module is a pure function of one control step: state and readings -> new state. :mod:`pace.onboard.actor` is one
step of all, :mod:`pace.onboard.estimates` the table of the estimates. Imports ``config``, ``sim`` and ``predictor``."""
