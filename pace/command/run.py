"""Running a command; wrong input gives one line on stderr instead of a traceback."""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from pathlib import Path
from pkgutil import resolve_name

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pace.command.arguments import plain_overrides, prepare
from pace.command.help import command_help
from pace.command.table import COMMANDS, Command
from pace.config import plugins
from pace.config.base import ConfigError, also_from, compose, config_dir, meant
from pace.config.extras import cure
from pace.config.names import check_choice, split_override
from pace.cores import core_set, usable_cores

#: Errors of a disk, of permissions and of folders that were deleted or replaced, which are no fault of the program.
DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EACCES, errno.EPERM, errno.EIO)
DISK += (errno.ENOENT, errno.ENOTDIR, errno.ESTALE)
EXIT_USAGE = 2
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 75  # EX_TEMPFAIL: what there was is saved; the same command, or resume=, starts or continues it


class Terminated(KeyboardInterrupt):
    """A command that a signal has ended (SIGTERM of a preempted job, a lost terminal), after it has saved its work."""


class JobFailed(RuntimeError):
    """A job of a sweep has failed in another process, where a launcher of Hydra ran it, and has told why there."""

    def __init__(self, status: int) -> None:
        super().__init__(status)  # which is what another process gets of it
        self.status = status


def run_command(name: str) -> int:
    """Run the command ``name`` of :data:`COMMANDS` with ``sys.argv``; returns the exit status.

    The command's function is imported after the configuration is composed, because torch takes seconds to load. Modules
    that the user names, in ``plugins`` or by an import path, are imported first (:mod:`pace.config.plugins`). Wrong
    input gives one line and status 2, an expected error one line and 1; a run that SIGTERM has ended gives 75.
    """
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files in letters that the terminal does not have
    try:
        return _started(name)
    except KeyboardInterrupt:
        return complain("interrupted", EXIT_INTERRUPTED)


def _started(name: str) -> int:
    try:
        if {"-h", "--help"} & set(sys.argv[1:]):
            return show(command_help(name, _topic(sys.argv[1:])))
        sys.argv[1:] = prepare(name, sys.argv[1:])
    except ConfigError as error:
        return complain(str(error), EXIT_USAGE)
    _limit_threads()
    status = _run(name)
    _flush()
    return status


def _run(name: str) -> int:
    try:
        return _run_hydra(COMMANDS[name])
    except (HydraException, OmegaConfBaseException) as error:
        return complain(explain(name, sys.argv[1:], error), EXIT_USAGE)
    except JobFailed as error:
        return error.status
    except OSError as error:  # of Hydra, which asks for the current folder
        return _of_disk(error)
    except Terminated:
        return EXIT_TERMINATED
    except KeyboardInterrupt:
        return complain("interrupted", EXIT_INTERRUPTED)


def _of_disk(error: OSError) -> int:
    """Print an error of the disk; returns the exit status. Errors: ``error`` itself if it is another one."""
    if error.errno not in DISK:
        raise error
    if error.errno == errno.ENOENT and error.filename is None:  # of os.getcwd()
        return complain("the current folder was deleted: change to one that exists", EXIT_FAILED)
    return complain(": ".join(str(part) for part in (error.filename, error.strerror) if part), EXIT_FAILED)


def _limit_threads() -> None:
    """torch and BLAS would take a thread for each core that they see; their workers inherit the limit."""
    cores = usable_cores()
    if cores < len(core_set()):
        os.environ.setdefault("OMP_NUM_THREADS", str(cores))


def _flush() -> None:
    """Python would end with an error if the last of what was printed cannot be written, on a full disk for example."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _topic(arguments: Sequence[str]) -> str:
    """The group after ``--help``, if any; a path there is the RUN of the command."""
    index = min(arguments.index(flag) for flag in ("-h", "--help") if flag in arguments)
    return next((argument for argument in arguments[index + 1 :] if re.fullmatch(r"\w+(=[\w/]+)?", argument)), "")


def _run_hydra(command: Command) -> int:
    """Compose the command's configuration with ``sys.argv`` and do the work; returns the exit status.

    A sweep (``-m``) does all of its jobs, and ends with the status of one that has failed.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors instead of printing and exiting
    status, here = 0, os.getpid()

    def guarded(config: DictConfig) -> None:
        nonlocal status  # an error that reached Hydra would be printed a second time
        status = _work(command, config) or status
        if status and os.getpid() != here:  # of a launcher's job, the returned value and exceptions come back
            raise JobFailed(status)

    hydra.main(config_path=str(config_dir()), config_name=command.config, version_base="1.3")(guarded)()
    return status


def _full_memory(error: RuntimeError | MemoryError) -> str:
    """The line for a memory that is full, of a GPU or of the machine. Errors: ``error`` itself if it is another one."""
    if isinstance(error, MemoryError) or "DefaultCPUAllocator: can't allocate memory" in str(error):
        return "the memory of this machine is full: ask for less at once, such as fewer worlds, serves or pixels"
    from pace.devices import full_memory_in_words, out_of_memory  # imports torch, as the work has done

    if not out_of_memory(error):
        raise error
    return full_memory_in_words(error)


def _work(command: Command, config: DictConfig) -> int:
    """Import the command's function, call it, and print its expected errors; returns the exit status."""
    try:
        work, *failures = (resolve_name(path) for path in (command.work, *command.failures))
    except ModuleNotFoundError as error:
        if not command.extra or (error.name or "").startswith("pace"):
            raise
        return complain(f"{error}: {cure(command.extra)}", EXIT_FAILED)
    except ConfigError as error:
        return complain(str(error), EXIT_USAGE)
    try:
        if "plugins" in config:
            plugins.use_named(config)
        with also_from(_given_folders()):
            work(config)
    except ConfigError as error:
        return complain(str(error), EXIT_USAGE)
    except tuple(failures) as error:
        return complain(str(error), EXIT_FAILED)
    except OSError as error:
        return _of_disk(error)
    except (RuntimeError, MemoryError) as error:
        return complain(_full_memory(error), EXIT_FAILED)
    return 0


def _given_folders() -> list[Path]:
    """Folders that the user has named on the command line (``--config-dir``), from which Hydra composed, too."""
    sources = HydraConfig.get().runtime.config_sources
    named = [source.path for source in sources if source.schema == "file" and source.provider not in ("main", "schema")]
    return [Path(path).absolute() for path in named]


def explain(name: str, arguments: Sequence[str], error: Exception) -> str:
    """One line for an error of Hydra's composition, with the key or the choice that was probably meant."""
    command = COMMANDS[name]
    for override in plain_overrides(arguments):
        key, value = split_override(override)
        if key in command.groups and not {"--config-dir", "-cd"} & set(arguments):
            try:
                for choice in filter(None, value.strip("[]").split(",")):
                    check_choice(key, choice.strip())
            except ConfigError as wrong:
                return str(wrong)
    text = str(error).strip().splitlines()[0].rstrip(".")
    unknown = re.match(r"Could not override '([\w.]+)'", text)
    if not unknown:
        return f"{text} (--help lists the keys)"
    parent, _, key = unknown[1].rpartition(".")
    there = OmegaConf.select(compose(command.config), parent) if parent else None
    return f"there is no key '{unknown[1]}'{meant(key, there or ())} (--help lists the keys)"


def show(text: str) -> int:
    """Print ``text``, to a reader that may close the pipe early (``| head``); returns the exit status."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        _flush()  # or Python prints an error at exit
    return 0


def complain(message: str, status: int) -> int:
    """Print ``message`` as an error, and return ``status``."""
    print(f"error: {message}", file=sys.stderr)
    return status
