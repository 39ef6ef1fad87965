"""Pages of the reference that are made from the code and configs/: commands, configuration, rewards, API."""

from __future__ import annotations

import inspect
import re
from typing import get_type_hints

from keys import cell, group_page, key_table, table, value_table
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from pace.command.help import capital, command_keys, default_choices
from pace.command.keys import file_keys, heading
from pace.command.table import COMMANDS, TRAIN_GROUPS
from pace.config.base import config_dir
from pace.config.names import choices
from pace.config.training import TrainConfig
from pace.task.body_rewards import MEASURED
from pace.task.measures import Measures
from pace.task.rewards import TERMS

ROLE = re.compile(r":(?:func|class|meth|mod|data|attr|exc):(?=<code>)")
#: Modules whose public names are the API, with a heading each.
API = {
    "Environments and policies": ("pace", "pace.task.env", "pace.rl.policies"),
    "Worlds and ball": ("pace.sim.worlds", "pace.sim.ball.ball", "pace.sim.engine.base", "pace.sim.robot_spec"),
    "Forecast and predictor": ("pace.predictor.forecast", "pace.predictor.network"),
    "On board": ("pace.onboard.actor", "pace.onboard.estimate", "pace.onboard.estimates"),
    "Rewards and observations": ("pace.task.state", "pace.task.reward_terms", "pace.task.observations"),
    "Learning": ("pace.rl.algorithm", "pace.rl.ppo", "pace.rl.agent"),
    "Runs and checkpoints": ("pace.runs.checkpoint", "pace.runs.metrics"),
    "Export": ("pace.deploy.export", "pace.deploy.graph"),
    "Configuration": ("pace.config.base", "pace.config.plugins"),
}
GROUPS_ABOUT = {
    "robot": "The robot: its MJCF, parts by name, control rate, gains, motors and nominal pose.",
    "ball": "Ball, air, contacts with table and paddle, table and net. Sources: [Physics](../../results/physics.md).",
    "serve": "Where serves start, how fast, and when they end.",
    "reset": "Where the robot starts, and where an episode is lost.",
    "reward": "Scale, target and weights. The terms: [Rewards](../rewards.md).",
    "randomization": "What differs between the worlds. Each number is a range; a world samples from it at each reset.",
    "sensing": "Noise and delay of what the robot senses.",
    "observation": "What actor and critic see. The names: [Observations](../observations.md).",
    "engine": "The physics engine, its step and its solver.",
    "algo": "PPO and its networks.",
    "predictor": "The learned predictor of the ball's apex, and its regression.",
}
INTRO = """# Configuration

Every number of the task, the physics and the learning is in [configs/](../../../configs/train.yaml), with its unit and
source. These pages are made from those files, from the dataclasses that check them (`pace/config/`), and from the
ranges of [pace/config/limits.py](../../../pace/config/limits.py). An unknown key, a wrong type or a value out of range
is one line that names the key.

| to | write |
|---|---|
| take another choice of a group | `ball=paper` |
| change one number | `algo.gamma=0.97`, `serve.vx=[-6,-5]` |
| add a reward term, or remove one | `+reward.terms.NAME={...}`, `~reward.terms.NAME` |
| have choices of your own | `--config-dir FOLDER`, with `FOLDER/ball/mine.yaml` ([recipes](../../extend.md)) |

`pace train --help` and `pace train --help ball` print the same in the terminal.
"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    pages = {"commands.md": commands_page(), "rewards.md": rewards_page(), "api.md": api_page()}
    pages |= {f"configuration/{name}": text for name, text in configuration_pages().items()}
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}", content=text))
    return files


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Docstrings name functions and classes as Sphinx does; here the name is enough."""
    return ROLE.sub("", content)


def commands_page() -> str:
    """The commands with their keys."""
    parts = ["# Commands", "`pace COMMAND --help` prints the same. Keys are written `key=value`."]
    for name, command in COMMANDS.items():
        summary = f"{capital(command.summary)}. {command.about}".strip()
        examples = "\n".join(f"pace {name} {example}" for example in command.examples)
        parts += [f"## pace {name}", summary, f"```text\npace {name} {command.usage}\n```"]
        parts += [f"```bash\n{examples}\n```"] if examples else []
        parts.append(value_table(list(command_keys(command).values()), "") if name != "train" else RUN_KEYS)
        if command.groups:
            parts.append("Groups: " + ", ".join(f"`{group}`" for group in command.groups) + ".")
    return "\n\n".join(parts) + "\n"


RUN_KEYS = "Keys: [Configuration, run](configuration/run.md)."


def configuration_pages() -> dict[str, str]:
    """An index, the keys of a run, and a page for each group."""
    defaults = default_choices(COMMANDS["train"])
    owners = get_type_hints(TrainConfig)
    keys = [key for name, key in file_keys(config_dir() / "train.yaml").items()]
    run = f"# run\n\nKeys of `pace train` that belong to no group.\n\n{key_table(keys, TrainConfig)}\n"
    pages = {"run.md": run, "experiment.md": experiments_page()}
    for group, about in GROUPS_ABOUT.items():
        pages[f"{group}.md"] = group_page(group, owners[group], defaults[group], about)
    assert set(GROUPS_ABOUT) | {"experiment"} == set(TRAIN_GROUPS)
    rows = [
        (
            f"[{group}]({group}.md)",
            ", ".join(f"`{name}`" for name in choices(group)),
            GROUPS_ABOUT.get(group, "Sets of choices."),
        )
        for group in TRAIN_GROUPS
    ]
    shown = [(name, several, re.sub(r" [A-Z][\w ]+: \[.*", "", about)) for name, several, about in rows]
    index = table(("group", "choices", "what it sets"), shown)
    return pages | {"index.md": f"{INTRO}\n{index}\n\nThe rest: [run](run.md).\n"}


def experiments_page() -> str:
    """The experiments: what each sets."""
    parts = ["# experiment", "`pace train experiment=NAME` sets several groups and keys at once."]
    for name in choices("experiment"):
        file = config_dir() / "experiment" / f"{name}.yaml"
        text = file.read_text(encoding="utf-8").removeprefix("# @package _global_\n")
        parts += [f"## {name}", heading(file), f"```yaml\n{text.rstrip()}\n```"]
    return "\n\n".join(parts) + "\n"


def rewards_page() -> str:
    """The terms with parameters, meaning, and weight in each file of configs/reward/."""
    files = {choice: file_keys(config_dir() / "reward" / f"{choice}.yaml") for choice in choices("reward")}
    rows = []
    for name, entry in TERMS.items():
        weights = [_weight(keys.get(f"terms.{name}")) for keys in files.values()]
        params = ", ".join(f"`{param}`" for param in entry.params or ())
        rows.append((f"`{name}`", params, *weights, cell(_meaning(name))))
    head = ("term", "parameters", *(f"weight in {choice}" for choice in files), "what it is")
    return f"{REWARDS}\n{table(head, rows)}\n"


REWARDS = """# Rewards

A term is a function of the task's true state. The reward of a control step is the sum of `reward.scale` x weight x
0.02 s x term. Weights and parameters: [configuration](configuration/reward.md). `metrics.csv` has a column
`reward/NAME` for each term, the mean of its weighted value per control step. A term of your own:
[Adding something](../extend.md#a-reward-term).
"""


def _weight(key: object) -> str:
    found = re.search(r"weight: ([-\d.e+]+)", getattr(key, "default", ""))
    return found[1] if found else "-"


def _measures() -> dict[str, str]:
    """The comment of each measure; "the same" stands for what the one above says."""
    found: dict[str, str] = {}
    for name, said in re.findall(r"^    (\w+): .*# (.*)$", inspect.getsource(Measures), re.MULTILINE):
        found[name] = list(found.values())[-1] if "the same" in said else said
    return found


def _meaning(name: str) -> str:
    """The docstring of a term, or the comment of the measure that it is."""
    if name in MEASURED:
        return _measures()[MEASURED[name]]
    return re.sub(r"\s+", " ", (inspect.getdoc(TERMS[name].function) or "").replace("``", "`"))


def api_page() -> str:
    """Public names of the modules that others build on."""
    parts = [
        "# API",
        "Names that stay. Everything else may change; [Architecture](../architecture.md) shows where it lies.",
    ]
    for title, modules in API.items():
        parts.append(f"## {title}")
        parts += [f"::: {module}\n    options:\n      heading_level: 3" for module in modules]
    return "\n\n".join(parts) + "\n"
