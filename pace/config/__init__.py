"""Typed configuration: the dataclasses of ``configs/``, and the check of YAML against them.

The meaning, type and range of each key belong here, not their use. Imports nothing of the package.
"""

from pace.config.base import ConfigError
from pace.config.training import load_train_config

__all__ = ["ConfigError", "load_train_config"]
