"""Environments without a trained predictor, for tests of what needs none."""

from __future__ import annotations

from functools import partial

from pace.rl import environment

make_env = partial(environment.make_env, predictor=None)
