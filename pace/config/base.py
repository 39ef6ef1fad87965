"""Typed configuration: one dataclass per group of ``configs/``, and the check of YAML against it.

Every number of the task, the physics and the learning is in the YAML files, with its unit and source. The classes
here declare the keys and their types; an unknown key, a wrong type or a value out of range raises
:class:`ConfigError` with the key's full name.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from pace.config.limits import first_outside

LONGEST = 1500  # letters of a message
Range = list[float]
T = TypeVar("T")


class ConfigError(ValueError):
    """A configuration that cannot be used; the message, in one line, names the key and the cure."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def printable(text: str) -> str:
    """``text`` in one line: line ends and control characters, which may come from a user, as Python writes them."""
    line = "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in text[:LONGEST])
    return line if len(text) <= LONGEST else f"{line} ..."


def config_dir() -> Path:
    """Folder of the YAML files: inside an installed wheel, or at the root of a checkout."""
    package = Path(__file__).resolve().parents[1]
    for candidate in (package / "configs", package.parent / "configs"):
        if candidate.is_dir():
            return candidate
    raise ConfigError(f"no configs/ folder beside {package}: reinstall pace-table-tennis or run from a checkout")


_outside: list[Path] = []  # folders of the user, each with groups of its own


def config_dirs() -> list[Path]:
    """:func:`config_dir`, and the folders of :func:`also_from`."""
    return [config_dir(), *_outside]


@contextmanager
def also_from(folders: Sequence[Path]) -> Iterator[None]:
    """Choices of ``folders`` are known, too, in the block: those of a command's ``--config-dir``."""
    before = list(_outside)
    _outside.extend(folders)
    try:
        yield
    finally:
        _outside[:] = before


def search_override() -> list[str]:
    """The folders of :func:`also_from` as an override of Hydra, for another command; none: an empty list."""
    quoted = [str(folder).replace("\\", "\\\\").replace("'", "\\'") for folder in _outside]
    return ["hydra.searchpath=[" + ",".join(f"'file://{folder}'" for folder in quoted) + "]"] if quoted else []


def require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


def check_range(name: str, value: Range, lowest: float | None = None) -> None:
    require(len(value) == 2, f"{name} must be [low, high], got {value}")
    require(value[0] <= value[1], f"{name}: low {value[0]} is above high {value[1]}")
    if lowest is not None:
        require(value[0] >= lowest, f"{name}: {value[0]} is below {lowest}")


class Completed:
    """A configuration that may leave values open."""

    @classmethod
    def complete(cls, plain: DictConfig) -> DictConfig:
        """``plain`` with a value for each that is open."""
        raise NotImplementedError


def parse(config: DictConfig | dict[str, Any], schema: type[T]) -> T:
    """Check ``config`` against a dataclass and return an instance of it.

    Errors: :class:`ConfigError` that names the key, for an unknown or missing key, a wrong type or a bad value.
    """
    try:
        plain = config if isinstance(config, DictConfig) else OmegaConf.create(config)
        OmegaConf.resolve(plain)
        plain = schema.complete(plain) if issubclass(schema, Completed) else plain
        nested = next(_nested(schema, OmegaConf.to_container(plain), ""), None)
        require(nested is None, f"{nested} must be one value, not a list or a table")
        merged = OmegaConf.merge(OmegaConf.structured(schema), plain)
        parsed = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise ConfigError(f"configuration key '{error.full_key or '?'}': {_reason(error)}") from error
    except OverflowError as error:  # a whole number that no float can hold
        key = next(_too_large(OmegaConf.to_container(plain)), "?")  # which the error does not tell
        raise ConfigError(f"configuration key '{key}': the number is too large") from error
    wrong = first_outside(parsed)
    if wrong is not None:
        raise ConfigError(wrong)
    return parsed  # type: ignore[return-value]


def _reason(error: OmegaConfBaseException) -> str:
    """The error of a key, in one line."""
    text = str(error).split("\n")[0]
    if isinstance(error, ConfigKeyError) and is_dataclass(error.object_type):
        return text + meant(str(error.key), [field.name for field in fields(error.object_type)])
    return "needs a list, such as [1.0, 2.0]" if "is not a ListConfig" in text else text


@cache
def _hints(schema: type) -> dict[str, Any]:
    return get_type_hints(schema)


def _nested(hint: Any, value: Any, place: str) -> Iterator[str]:
    """Places of lists and tables where a list or a table has single values, which OmegaConf lets pass."""
    parts = get_args(hint)
    if is_dataclass(hint) and isinstance(value, dict):
        for key, inner in _hints(hint).items():  # type: ignore[arg-type]
            yield from _nested(inner, value.get(key), f"{place}.{key}" if place else key)
    elif get_origin(hint) is UnionType:  # or null
        yield from _nested(parts[0], value, place)
    elif get_origin(hint) in (list, dict) and isinstance(value, list | dict):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            where = f"{place}.{key}" if isinstance(value, dict) else f"{place}[{key}]"
            if parts[-1] in (int, float, str, bool) and isinstance(item, list | dict):
                yield where
            yield from _nested(parts[-1], item, where)


def _too_large(value: Any, place: str = "") -> Iterator[str]:
    """Keys of the whole numbers that no float can hold."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _too_large(item, f"{place}.{key}" if place else str(key))
    elif isinstance(value, int) and abs(value) > sys.float_info.max:
        yield place


def meant(word: str, known: Iterable[str]) -> str:
    """``; did you mean ...?`` if ``word`` is close to one of ``known``, else an empty string."""
    near = get_close_matches(word, list(known), 1)
    return f"; did you mean {near[0]}?" if near else ""


def compose(config_name: str, overrides: list[str] | None = None) -> DictConfig:
    """Compose ``configs/<config_name>.yaml`` with Hydra overrides, for tests, notebooks and rebuilt runs.

    Choices may also lie in the folders of :func:`also_from`.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    outer = GlobalHydra.instance().hydra  # set while a command runs, which may compose other configurations
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(config_dir=str(config_dir()), version_base="1.3"):
            return hydra_compose(config_name=config_name, overrides=[*search_override(), *(overrides or [])])
    finally:
        GlobalHydra.instance().hydra = outer


def to_dict(config: Any) -> dict[str, Any]:
    """A dataclass of this module as plain nested dictionaries, ready for YAML or JSON."""
    if not is_dataclass(config):
        raise ConfigError(f"not a configuration: {type(config).__name__}")
    return OmegaConf.to_container(OmegaConf.structured(config))  # type: ignore[return-value]
