"""Names in ``configs/``: the choices of a group, and old names with their new ones."""

from __future__ import annotations

from collections.abc import Iterable

from pace.config.base import ConfigError, config_dir, meant

#: Old key -> new key, for every command.
RENAMED_KEYS = {"run_dir": "out"}
#: Old choice of a group -> new choice, such as ``"experiment=old": "experiment=new"``. Command lines,
#: ``load_train_config`` and ``override_task`` refuse an old one and name the new one; saved configurations are upgraded
#: (``pace.config.upgrade``).
#: ``pace`` meant "the default" in four groups, and ``full`` three things.
RENAMED_CHOICES = {
    "reward=pace": "reward=intercept",
    "randomization=full": "randomization=moderate",
    "observation=pace": "observation=paddle_pose",
    "algo=pace": "algo=small_batch",
    "predictor=pace": "predictor=last_five",
    "bench=full": "bench=all",
    "experiment=campaign": "experiment=generalist",
    "experiment=full": "experiment=ablation/baseline",
    "experiment=no_predictor": "experiment=ablation/no_predictor",
    "experiment=no_hit_guidance": "experiment=ablation/no_hit_guidance",
    "experiment=no_return_guidance": "experiment=ablation/no_return_guidance",
    "experiment=paper_reward": "experiment=ablation/paper_reward",
}


def choices(group: str) -> list[str]:
    """Choices of ``group``: the files of configs/<group>/ and its folders, but for parts of others, named ``_...``."""
    folder = config_dir() / group
    files = [file.relative_to(folder).with_suffix("") for file in folder.rglob("*.yaml")]
    return sorted(file.as_posix() for file in files if not file.name.startswith("_"))


def split_override(override: str) -> tuple[str, str]:
    """Key and value of a Hydra override: ``+ball=a`` -> ``("ball", "a")``, ``~ball`` -> ``("ball", "")``."""
    key, _, value = override.lstrip("+~").partition("=")
    return key.strip(), value.strip().strip("'\"")


def current_override(override: str) -> str:
    """``override`` with the current name of the choice that it makes; others as they are."""
    return RENAMED_CHOICES.get(override, override)


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
