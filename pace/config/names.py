"""Names in ``configs/``: the choices of a group, and the errors for a wrong or an old one."""

from __future__ import annotations

from collections.abc import Iterable

from pace.config.base import ConfigError, config_dirs, meant
from pace.config.renamed import renamed_choice
from pace.config.task import SPINS

#: Old key -> new key, for every command.
RENAMED_KEYS = {"run_dir": "out"}
#: Old key -> the keys that it became.
SPLIT_KEYS = {"serve.spin": tuple(f"serve.{axis}" for axis in SPINS)}


def choices(group: str) -> list[str]:
    """Choices of ``group``: the files below configs/<group>, except parts of others, which begin with ``_``."""
    folders = [folder / group for folder in config_dirs()]
    found = {
        file.relative_to(folder).with_suffix("").as_posix() for folder in folders for file in folder.rglob("*.yaml")
    }
    return sorted(
        (name for name in found if not name.split("/")[-1].startswith("_")), key=lambda name: (name.count("/"), name)
    )


def split_override(override: str) -> tuple[str, str]:
    """Key and value of a Hydra override: ``+ball=a`` -> ``("ball", "a")``, ``~ball`` -> ``("ball", "")``."""
    key, _, value = override.lstrip("+~").partition("=")
    return key.strip(), value.strip().strip("'\"")


def check_renamed(overrides: Iterable[str]) -> None:
    """Errors: :class:`ConfigError`, one line with the new name, for a key or choice that was renamed or split."""
    for override in overrides:
        key, value = split_override(override)
        if key in RENAMED_KEYS:
            raise ConfigError(f"{key}= is now {RENAMED_KEYS[key]}=")
        if key in SPLIT_KEYS:
            raise ConfigError(f"{key}= is now one key an axis: {', '.join(f'{new}=' for new in SPLIT_KEYS[key])}")
        for choice in value.strip("[]").split(","):  # of a sweep (-m), or of several experiments
            new = renamed_choice(key, choice.strip())
            if new != choice.strip():
                raise ConfigError(f"{key}={choice.strip()} is now {key}={new}")


def check_choice(group: str, choice: str) -> None:
    """Errors: :class:`ConfigError` that lists the choices of ``group`` if ``choice`` is none of them."""
    if not any((folder / group / f"{choice}.yaml").is_file() for folder in config_dirs()):
        known = choices(group)
        raise ConfigError(f"{group}/{choice} does not exist{meant(choice, known)} ({group}: {', '.join(known)})")
