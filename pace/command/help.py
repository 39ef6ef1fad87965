"""``--help``: a command's purpose, its keys with their defaults and comments, and its groups.

Keys and comments are read from ``configs/``, so that they are written only once.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from textwrap import fill

from pace.command.keys import Key, file_keys, heading
from pace.command.table import COMMANDS, Command
from pace.config.base import ConfigError, config_dir, meant
from pace.config.names import check_choice, check_renamed, choices

WIDTH = 96
COLUMN = 34  # of the comments


def overview() -> str:
    """The commands, one per line."""
    lines = [f"  pace {name:<11}{command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        ["PACE: a humanoid learns table tennis.", "", *lines, "", "pace COMMAND --help lists a command's keys."]
    )


def command_help(name: str, topic: str = "") -> str:
    """The help of a command; with ``topic``, ``GROUP`` or ``GROUP=CHOICE``, that of a group's keys.

    Errors: :class:`ConfigError` for a group that the command does not take, and for an unknown choice.
    """
    command = COMMANDS[name]
    if topic:
        return group_help(name, command, *topic.split("=", 1))
    paragraphs = [f"pace {name} {command.usage}", fill(f"{capital(command.summary)}. {command.about}".strip(), WIDTH)]
    paragraphs.append(f"The same as python -m {command.module} {command.usage}")
    if command.examples:
        paragraphs.append("Examples:\n" + "\n".join(f"  pace {name} {example}" for example in command.examples))
    paragraphs.append("Keys, with their defaults:\n" + key_table(command_keys(command).values()))
    if command.groups:
        paragraphs.append(group_table(name, command))
    return "\n\n".join(paragraphs)


def capital(text: str) -> str:
    """``text`` with a capital first letter."""
    return text[0].upper() + text[1:]


def command_keys(command: Command) -> dict[str, Key]:
    """Keys of a command by name: those of its file, then those of the training that it takes."""
    own = file_keys(config_dir() / f"{command.config}.yaml")
    training = file_keys(config_dir() / "train.yaml")
    taken = {name: own.get(name, training[name]) for name in command.training_keys}
    described = {k: Key(k, v.default, v.comment or training[k].comment) for k, v in taken.items()}
    return {key: value for key, value in own.items() if key != "overrides"} | described


def key_table(keys: Iterable[Key]) -> str:
    """A line ``key=default  comment`` for each key; long comments continue below."""
    lines = []
    for key in keys:
        start = fill(f"  {key.name}={key.default}", WIDTH, subsequent_indent="    ", break_long_words=False)
        if not key.comment:
            lines.append(start)
            continue
        indent = " " * COLUMN
        first = f"{start:<{COLUMN - 2}}  "
        text = fill(key.comment, WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False)
        lines.append(first + text[COLUMN:] if len(first) == COLUMN else f"{start}\n{text}")
    return "\n".join(lines)


def group_table(name: str, command: Command) -> str:
    """The groups of a command and their choices."""
    preset = "saved with the policy" if command.collected and (command.positional or command.rest) else ""
    defaults = default_choices(command)
    lines = []
    for group in command.groups:
        if group in command.refused:
            lines.append(f"  {group + '.KEY=':<16}({command.refused[group]})")
            continue
        known = [f"{choice}*" if choice == defaults.get(group) and not preset else choice for choice in choices(group)]
        lines.append(fill(", ".join(known), WIDTH, initial_indent=f"  {group + '=':<16}", subsequent_indent=" " * 18))
    usual = f"default: {preset}" if preset else "* is the default"
    more = f"pace {name} --help GROUP shows a group's keys, --help GROUP=CHOICE those of another choice."
    return f"Groups, GROUP=CHOICE or GROUP.KEY=VALUE ({usual}):\n" + "\n".join(lines) + f"\n\n{more}"


def default_choices(command: Command) -> Mapping[str, str]:
    """Choice of each group in the file of a command, or else in that of the training."""
    files = (config_dir() / "train.yaml", config_dir() / f"{command.config}.yaml")
    return {
        match[1]: match[2]
        for file in files
        for match in re.finditer(r"^  - (?:override /)?(\w+): (\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
    }


def group_help(name: str, command: Command, group: str, choice: str = "") -> str:
    """The keys of a group, as in ``choice`` or in the default one."""
    if group not in command.groups:
        known = ", ".join(command.groups) or "none"
        raise ConfigError(f"pace {name} takes no group {group}{meant(group, command.groups)} (groups: {known})")
    names = choices(group)
    if choice:
        check_renamed([f"{group}={choice}"])
        check_choice(group, choice)
    usual = default_choices(command).get(group, "")
    choice = choice or (usual if usual in names else names[0])
    file = config_dir() / group / f"{choice}.yaml"
    prefix = "" if group == "experiment" else f"{group}."
    keys = [Key(prefix + key.name, key.default, key.comment) for key in file_keys(file).values() if key.name != "name"]
    head = f"{group}={choice}: {heading(file)}" if heading(file) else f"{group}={choice}"
    all_choices = fill(f"{group}: {', '.join(names)}", WIDTH)
    return f"{fill(head, WIDTH)}\n\n{key_table(keys)}\n\n{all_choices}"
