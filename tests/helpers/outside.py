"""Modules and commands of somebody who uses pace and does not change it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import dedent

from pace.config import plugins

Main = Callable[[], int]
#: A training run of two updates that takes seconds.
SMALL = (
    "num_worlds=8", "samples=64", "algo.steps=4", "algo.actor_hidden=[16]", "algo.critic_hidden=[16]",
    "predictor.batches_per_update=2", "progress=false", "tensorboard=false", "engine.threads=1",
)  # fmt: skip


def write_module(folder: Path, name: str, source: str) -> str:
    """A module in ``folder``; returns its name, which no other test may use."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(dedent(source))
    return name


@contextmanager
def stranger(path: Path | None = None) -> Iterator[None]:
    """A process that has named no module, and finds those in ``path``; what the block imports is forgotten again."""
    before = {group: dict(members) for group, members in plugins.Registry.groups.items()}
    named, modules = set(plugins._named), set(sys.modules)
    plugins._named.clear()
    sys.path[:0] = [str(path)] if path else []
    try:
        yield
    finally:
        if path:
            sys.path.remove(str(path))
        for name in set(sys.modules) - modules:
            if path and str(getattr(sys.modules[name], "__file__", "")).startswith(str(path)):
                del sys.modules[name]
        plugins._named.clear()
        plugins._named.update(named)
        for group, members in before.items():
            plugins.Registry.groups[group].clear()
            plugins.Registry.groups[group].update(members)


def command(main: Main, *arguments: str) -> int:
    """Run a command in this process; returns its exit status."""
    given, sys.argv = sys.argv, ["command", *arguments]
    try:
        return main()
    finally:
        sys.argv = given


def python(folder: Path, module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """``python -m module arguments`` in ``folder``, with pace on the path."""
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", module, *arguments]
    return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, check=False)
