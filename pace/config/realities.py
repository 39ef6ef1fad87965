"""Rows of the robustness sweep that are lists of overrides: the files of ``configs/realities/``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pace.config.base import ConfigError, config_dirs
from pace.config.names import check_choice

GROUP = "realities"


def load_realities(name: str) -> dict[str, dict[str, list[str]]]:
    """Kind of row -> label -> overrides of the task, from ``configs/realities/<name>.yaml``.

    Errors: :class:`ConfigError` for an unknown name, and for a file of another form, which names the row.
    """
    check_choice(GROUP, name)
    file = next(path for path in (folder / GROUP / f"{name}.yaml" for folder in config_dirs()) if path.is_file())
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ConfigError(f"{file} is no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict) or not all(isinstance(rows, dict) for rows in content.values()):
        raise ConfigError(f"{file} must map kinds of rows to rows, and these to lists of overrides")
    for kind, rows in content.items():
        for label, overrides in rows.items():
            _check_row(file, f"{kind}, {label}", overrides)
    return content


def _check_row(file: Path, row: str, overrides: Any) -> None:
    """Errors: :class:`ConfigError` unless a row is a list of texts of the form ``key=value``."""
    listed = isinstance(overrides, list) and len(overrides) > 0
    if not listed or not all(isinstance(each, str) and "=" in each for each in overrides):
        raise ConfigError(f"{file}, row '{row}': needs a list of key=value, got {overrides!r}")
