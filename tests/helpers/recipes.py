"""The resolved recipes of ``docs/results/recipe``."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from pace.config.base import compose, parse
from pace.config.training import TrainConfig

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
FOLDER = RESULTS / "recipe"


@lru_cache
def recipe(name: str) -> TrainConfig:
    """A resolved recipe as the command trains it; keys that its file does not hold are the defaults of today."""
    return parse(compose("train", [f"+recipe={name}", f"hydra.searchpath=[{RESULTS}]"]), TrainConfig)


def written(name: str) -> dict[str, Any]:
    """What the file of a recipe holds, without its list of defaults."""
    plain = OmegaConf.to_container(OmegaConf.load(FOLDER / f"{name}.yaml"))
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items() if key != "defaults"}
