"""Running a Hydra command so that wrong input ends in one line on stderr, not in a traceback."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pace.config import plugins
from pace.config.base import ConfigError, config_dir

EXIT_USAGE = 2
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130
#: Options of Hydra that the next argument is the value of.
HYDRA_OPTIONS = ("--cfg", "-c", "--info", "-i", "--package", "-p", "--config-name", "-cn", "--config-dir", "-cd")


def run_command(
    task: Callable[[DictConfig], None],
    config_name: str,
    failures: tuple[type[Exception], ...] = (),
    positional: str | None = None,
    task_groups: tuple[str, ...] = (),
) -> int:
    """Compose ``configs/<config_name>.yaml`` with the command line and call ``task``; returns the exit status.

    A wrong key, type or value gives one line and status 2; ``failures`` (expected errors of the task) one line and 1.
    The first argument without a key is the value of the key ``positional``. For a command that rebuilds a saved task,
    ``task_groups`` are the parts of it that may change: see :func:`collect_overrides`. Modules that the user names,
    in ``plugins`` or by an import path, are imported first: see :mod:`pace.config.plugins`.
    """
    if positional is not None:
        sys.argv[1:] = name_argument(sys.argv[1:], positional)
    if task_groups:
        sys.argv[1:] = collect_overrides(sys.argv[1:], task_groups)
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors instead of printing and exiting
    status = 0

    def guarded(config: DictConfig) -> None:
        nonlocal status  # an error that reached Hydra would be announced a second time
        try:
            if "plugins" in config:
                plugins.use_named(config)
            task(config)
        except ConfigError as error:
            status = _complain(str(error), EXIT_USAGE)
        except failures as error:
            status = _complain(str(error), EXIT_FAILED)

    try:
        hydra.main(config_path=str(config_dir()), config_name=config_name, version_base="1.3")(guarded)()
    except (HydraException, OmegaConfBaseException) as error:
        return _complain(f"{_first_line(error)} (--help lists the keys)", EXIT_USAGE)
    except KeyboardInterrupt:
        return _complain("interrupted", EXIT_INTERRUPTED)
    return status


def name_argument(arguments: list[str], key: str) -> list[str]:
    """``arguments`` with the first one that has no key written as ``key='...'``, the way Hydra wants it.

    A path that exists counts as such even with a ``=`` in it; values of Hydra's own options do not.
    """
    for index, argument in enumerate(arguments):
        after_option = index > 0 and arguments[index - 1] in HYDRA_OPTIONS
        plain = "=" not in argument or os.path.exists(argument)
        if plain and not after_option and not argument.startswith(("-", "~", "+")):
            return [*arguments[:index], f"{key}={quote(argument)}", *arguments[index + 1 :]]
    return arguments


def quote(value: str) -> str:
    """``value`` the way Hydra takes any text, such as a path with a ``=`` in it."""
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def collect_overrides(arguments: list[str], groups: tuple[str, ...]) -> list[str]:
    """``arguments`` with those for ``groups``, such as ``ball=paper`` or ``engine.cone=elliptic``, moved into a list.

    The list is the value of the key ``overrides``: a saved task is no part of what Hydra composes.
    """
    moved = [a for a in arguments if "=" in a and a.split("=")[0].split(".")[0] in groups]
    rest = [a for a in arguments if a not in moved]
    escaped = (a.replace("\\", "\\\\").replace('"', '\\"') for a in moved)
    return [*rest, "overrides=[" + ",".join(f'"{a}"' for a in escaped) + "]"] if moved else rest


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0].rstrip(".")


def _complain(message: str, status: int) -> int:
    print(f"error: {message}", file=sys.stderr)
    return status
