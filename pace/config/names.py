"""Names in ``configs/``: the choices of a group, and old names with their new ones."""

from __future__ import annotations

from collections.abc import Iterable

from pace.config.base import ConfigError, config_dir, meant

#: Old key -> new key, for every command.
RENAMED_KEYS = {"run_dir": "out"}
#: Old choice of a group -> new choice, such as ``"experiment=old": "experiment=new"``. Command lines,
#: ``load_train_config`` and ``override_task`` refuse an old one and name the new one; saved configurations are upgraded
#: (``pace.config.upgrade``).
RENAMED_CHOICES: dict[str, str] = {}


def choices(group: str) -> list[str]:
    """Choices of ``group``: the names of configs/<group>/*.yaml, but for parts of others, which begin with ``_``."""
    return sorted(file.stem for file in (config_dir() / group).glob("*.yaml") if not file.stem.startswith("_"))


def split_override(override: str) -> tuple[str, str]:
    """Key and value of a Hydra override: ``+ball=a`` -> ``("ball", "a")``, ``~ball`` -> ``("ball", "")``."""
    key, _, value = override.lstrip("+~").partition("=")
    return key.strip(), value.strip().strip("'\"")


def check_renamed(overrides: Iterable[str]) -> None:
    """Errors: :class:`ConfigError`, one line with the new name, for a key or a choice that has another name now."""
    for override in overrides:
        key, value = split_override(override)
        if key in RENAMED_KEYS:
            raise ConfigError(f"{key}= is now {RENAMED_KEYS[key]}=")
        for choice in value.strip("[]").split(","):  # of a sweep (-m), or of several experiments
            new = RENAMED_CHOICES.get(f"{key}={choice.strip()}")
            if new is not None:
                raise ConfigError(f"{key}={choice.strip()} is now {new}")


def check_choice(group: str, choice: str) -> None:
    """Errors: :class:`ConfigError` that lists the choices of ``group`` when ``choice`` is none of them."""
    if not (config_dir() / group / f"{choice}.yaml").is_file():
        known = choices(group)
        raise ConfigError(f"{group}/{choice} does not exist{meant(choice, known)} ({group}: {', '.join(known)})")
