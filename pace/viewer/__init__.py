"""Watching a policy: a live page in the browser, and videos.

Playback and display belong here, not rendering a scene (``sim.render``). Imports ``evaluation`` and the rooms
below. ``python -m pace.viewer RUN`` plays.
"""
