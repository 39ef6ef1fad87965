"""Typed configuration: the dataclasses of ``configs/``, and the check of YAML against them.

Here belongs what a key means, its type and its range; not what is done with it. Imports nothing of the package."""

from pace.config.base import ConfigError

__all__ = ["ConfigError"]
