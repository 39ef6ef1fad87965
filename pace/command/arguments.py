"""The command line of a command: arguments without a key, options, and the conversion to Hydra's syntax."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence

from pace.command.help import command_keys
from pace.command.table import COMMANDS, TRAIN_GROUPS, Command
from pace.config.base import ConfigError, meant
from pace.config.names import check_renamed, split_override

#: Options of Hydra whose value is the next argument.
HYDRA_OPTIONS = ("--cfg", "-c", "--info", "-i", "--package", "-p", "--config-name", "-cn", "--config-dir", "-cd")

#: Keys whose value is a path, of any command.
PATHS = ("out", "run", "resume", "init_from", "predictor_from", "video", "evaluation", "notes", "figure", "log")

#: Tables of the configuration with keys of the users' own.
OPEN_TABLES = ("reward.terms.", "observation.estimates.")


def prepare(name: str, arguments: Sequence[str]) -> list[str]:
    """Arguments of the command ``name`` in Hydra's syntax, with its own keys and groups only.

    Errors: :class:`ConfigError`, one line with the correct form.
    """
    command = COMMANDS[name]
    given = name_options(list(arguments), command)
    check_shape(given)
    for key in command.positional:
        given = name_argument(given, key)
    if command.rest:
        given = name_list(given, command.rest)
    check_renamed(plain_overrides(given))
    if not {"-m", "--multirun"} & set(given):  # there a comma separates values
        given = [quote_path(argument) for argument in given]
    given = [_open(argument) for argument in given]
    check_keys(name, command, given)
    if command.collected:
        given = collect_overrides(given, (*command.groups, *command.training_keys))
    changes = [index for index in range(len(given)) if is_override(given, index)]  # Hydra wants them side by side
    return [given[i] for i in changes] + [argument for i, argument in enumerate(given) if i not in changes]


def _open(argument: str) -> str:
    """``argument`` so that Hydra may add its key, if that lies in a table to which users add keys."""
    return f"++{argument}" if argument.startswith(OPEN_TABLES) else argument


def name_options(arguments: list[str], command: Command) -> list[str]:
    """``--video out.mp4`` and ``--video=out.mp4`` as ``video=out.mp4``, and ``--sweep`` as ``sweep=true``."""
    result: list[str] = []
    waiting = ""
    for argument in arguments:
        key, equals, value = argument.removeprefix("--").partition("=")
        known = argument.startswith("--")
        if waiting:
            result.append(f"{waiting}={_text(argument)}")
            waiting = ""
        elif known and key in command.flags and not equals:
            result.append(f"{key}=true")
        elif known and key in command.options and not equals:
            waiting = key
        elif known and key in command.options:
            result.append(f"{key}={_text(value)}")
        else:
            result.append(argument)
    if waiting:
        raise ConfigError(f"--{waiting} needs a value")
    return result


def check_shape(arguments: Sequence[str]) -> None:
    """Errors: :class:`ConfigError` for ``--key value``, ``--key=value`` and spaces around a ``=``."""
    for index, argument in enumerate(arguments):
        follower = arguments[index + 1] if index + 1 < len(arguments) else ""
        key, equals, value = argument.removeprefix("--").partition("=")
        if argument.startswith("--") and (key.isidentifier() or "." in key):
            if equals or (key not in KNOWN_OPTIONS):
                value = value or (follower if "=" not in follower and not follower.startswith("-") else "")
                raise ConfigError(f"write {key}={value or 'VALUE'} instead of {argument} {follower}".rstrip())
        elif argument.startswith("=") and index:
            raise ConfigError(f"write {arguments[index - 1]}={argument[1:] or follower}, without spaces")
        elif argument.endswith("=") and follower and "=" not in follower and not follower.startswith("-"):
            raise ConfigError(f"write {argument}{follower}, without spaces")


#: Options of Hydra that look like a key.
KNOWN_OPTIONS = ("help", "version", "cfg", "info", "package", "multirun", "resolve", "run")


def is_plain(arguments: Sequence[str], index: int) -> bool:
    """Whether an argument has no key. A path that exists counts as such even with a ``=`` in it."""
    argument = arguments[index]
    after_option = index > 0 and arguments[index - 1] in HYDRA_OPTIONS
    no_key = "=" not in argument or os.path.exists(argument)
    return no_key and not after_option and not argument.startswith(("-", "~", "+"))


def name_argument(arguments: list[str], key: str) -> list[str]:
    """``arguments`` with the first one that has no key written as ``key='...'``, in Hydra's syntax."""
    for index, argument in enumerate(arguments):
        if is_plain(arguments, index):
            return [*arguments[:index], f"{key}={quote(argument)}", *arguments[index + 1 :]]
    return arguments


def name_list(arguments: list[str], key: str) -> list[str]:
    """``arguments`` with those that have no key collected in the list ``key``."""
    plain = [index for index in range(len(arguments)) if is_plain(arguments, index)]
    rest = [argument for index, argument in enumerate(arguments) if index not in plain]
    return [*rest, f"{key}=[{','.join(quote(arguments[index]) for index in plain)}]"] if plain else rest


def quote(value: str) -> str:
    """``value`` quoted for Hydra, such as a path with a ``=`` in it."""
    doubled = re.sub(r"(\\+)(?='|$)", r"\1\1", value)  # elsewhere Hydra takes them as they are
    return "'" + doubled.replace("'", "\\'") + "'"


def quote_path(argument: str) -> str:
    """``out=my runs/ü 1`` and ``out=1e3`` as text for Hydra, character by character. What is quoted stays so."""
    key, equals, value = argument.partition("=")
    ready = value in ("", "null") or value.startswith(("'", '"')) or "${" in value
    return f"{key}={quote(value)}" if equals and key in PATHS and not ready else argument


def _text(value: str) -> str:
    return value if re.fullmatch(r"[\w./-]+", value, re.ASCII) else quote(value)


def plain_overrides(arguments: Sequence[str]) -> list[str]:
    """Those arguments that change the configuration."""
    return [argument for index, argument in enumerate(arguments) if is_override(arguments, index)]


def is_override(arguments: Sequence[str], index: int) -> bool:
    """Whether an argument is no option, and no value of one."""
    return not arguments[index].startswith("-") and (index == 0 or arguments[index - 1] not in HYDRA_OPTIONS)


def check_keys(name: str, command: Command, arguments: Sequence[str]) -> None:
    """Errors: :class:`ConfigError` for an argument whose key the command does not have, or would ignore."""
    own = {key.split(".")[0] for key in command_keys(command)}
    known = [*own, *command.groups, *command.training_keys]
    more_groups = any(argument.startswith(("--config-dir", "-cd", "hydra.searchpath")) for argument in arguments)
    for argument in plain_overrides(arguments):
        key, _ = split_override(argument)
        root = key.replace("/", ".").replace("@", ".").split(".")[0]
        for refused, why in command.refused.items():
            if key == refused or ("." in refused and key.startswith(f"{refused}.")):
                raise ConfigError(f"{key}= is no key of pace {name}: {why}")
        if "=" not in argument and not argument.startswith("~"):
            raise ConfigError(f"'{argument}' is no key=value (--help lists the keys)")
        if root in (*known, "hydra") or (more_groups and argument.startswith("+")):
            continue
        raise ConfigError(_unknown(name, root, known))


def _unknown(name: str, root: str, known: Collection[str]) -> str:
    """The message for a key that a command does not have."""
    elsewhere = (*TRAIN_GROUPS, *(key.split(".")[0] for key in command_keys(COMMANDS["train"])))
    if root in elsewhere:
        return f"{root}= is of pace train, and changes nothing in pace {name} (--help lists the keys)"
    return f"there is no key '{root}'{meant(root, known)} (--help lists the keys)"


def collect_overrides(arguments: list[str], groups: tuple[str, ...]) -> list[str]:
    """``arguments`` with those for ``groups``, such as ``ball=paper`` or ``engine.cone=elliptic``, moved into a list.

    The list is the value of the key ``overrides``, because Hydra does not compose a saved task.
    """
    moved = [a for a in arguments if "=" in a and a.split("=")[0].split(".")[0] in groups]
    rest = [a for a in arguments if a not in moved]
    escaped = (a.replace("\\", "\\\\").replace('"', '\\"') for a in moved)
    return [*rest, "overrides=[" + ",".join(f'"{a}"' for a in escaped) + "]"] if moved else rest
