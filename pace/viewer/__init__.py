"""A policy to look at: the page in a browser, and films.

Here belongs what draws and plays back; not the drawing of a scene itself (``sim.render``). Imports ``evaluation`` and
the rooms below. ``python -m pace.viewer RUN`` plays.
"""
