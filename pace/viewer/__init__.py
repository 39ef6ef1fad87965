"""Watching a policy: a live page in the browser, and videos.

Playback and display belong here; rendering a scene (``sim.render``) does not. Imports ``evaluation`` and the rooms
below. ``python -m pace.viewer RUN`` plays.
"""
