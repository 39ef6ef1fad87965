"""Running a Hydra command so that wrong input ends in one line on stderr, not in a traceback."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pace.config import ConfigError, config_dir

EXIT_USAGE = 2
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130


def run_command(
    task: Callable[[DictConfig], None], config_name: str, failures: tuple[type[Exception], ...] = ()
) -> int:
    """Compose ``configs/<config_name>.yaml`` with the command line and call ``task``; returns the exit status.

    A wrong key, type or value gives one line and status 2; ``failures`` (expected errors of the task) one line and 1.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors instead of printing and exiting
    status = 0

    def guarded(config: DictConfig) -> None:
        nonlocal status  # an error that reached Hydra would be announced a second time
        try:
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


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0].rstrip(".")


def _complain(message: str, status: int) -> int:
    print(f"error: {message}", file=sys.stderr)
    return status
