"""Configurations that earlier versions of pace have saved, brought to today's keys. Pure functions of plain dicts."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from pace.config.base import to_dict
from pace.config.predictor import PredictorPriors

#: Where a return should land where a saved configuration does not say (released configuration).
LANDING_TARGET = (1.15, 0.0)  # m


def upgrade_seams(config: dict[str, Any]) -> dict[str, Any]:
    """A copy with ``landing_target``, once the x and y of the term ``predicted_landing``, and the predictor's priors,
    once constants. What is not of the form that a configuration has is left for the parser to complain about.
    """
    if not isinstance(config, dict):
        return config
    config = deepcopy(config)
    params = _entry(config, "reward", "terms", "predicted_landing", "params")
    place = [params.pop(axis, known) for axis, known in zip("xy", LANDING_TARGET, strict=True)]
    config.setdefault("landing_target", place)
    predictor = _entry(config, "predictor")
    if predictor and predictor.get("priors") is None:
        predictor["priors"] = to_dict(PredictorPriors())
    return config


def _entry(config: Any, *keys: str) -> dict[str, Any]:
    """The dictionary under ``keys``; an empty one that belongs to nobody if there is none."""
    for key in keys:
        config = config.get(key) if isinstance(config, dict) else None
    return config if isinstance(config, dict) else {}
