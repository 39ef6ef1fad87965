"""Typed configuration: the dataclasses of ``configs/``, and the check of YAML against them.

Here belongs what a key means, its type and its range; not what is done with it. Imports nothing of the package.
"""

from pace.config.base import ConfigError
from pace.config.training import load_train_config

__all__ = ["ConfigError", "load_train_config"]
