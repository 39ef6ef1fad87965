"""The resolved recipes of ``docs/results/recipe``."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from pace.config.base import parse, to_dict
from pace.config.renamed import with_current_names
from pace.config.training import TrainConfig, load_train_config

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
FOLDER = RESULTS / "recipe"


@lru_cache
def defaults() -> dict[str, Any]:
    """The default training configuration; shared by the tests, so not to be changed."""
    return to_dict(load_train_config())


@lru_cache
def recipe(name: str) -> TrainConfig:
    """A resolved recipe over the defaults, as ``+recipe=NAME`` composes it.

    Its reward is its own; other keys that it does not name (``seed``, ``device``, ...) are the defaults."""
    others = {key: value for key, value in defaults().items() if key != "reward"}
    merged = OmegaConf.merge(others, with_current_names(written(name)))
    return parse(OmegaConf.to_container(merged), TrainConfig)  # type: ignore[arg-type]


@lru_cache
def written(name: str) -> dict[str, Any]:
    """What the file of a recipe holds, without its list of defaults; shared, so not to be changed."""
    plain = OmegaConf.to_container(OmegaConf.load(FOLDER / f"{name}.yaml"))
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items() if key != "defaults"}
