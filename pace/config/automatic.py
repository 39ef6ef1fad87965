"""Values that the configuration leaves open: ``auto`` is chosen once, for the machine on which a run begins."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from pace.config.base import ConfigError, config_dir, parse, require

AUTO = "auto"
SHARE_OF_MEMORY = 0.8  # that a run may fill; the rest is for what else runs there, and for a GPU's driver
#: Keys that may be ``auto``, and how their values are said.
KEYS = {
    "num_worlds": "{} worlds",
    "algo.steps": "{} steps an update",
    "algo.minibatches": "{} minibatches",
    "algo.autocast": "number format {}",
}


@dataclass
class DeviceValues:
    """What ``auto`` stands for on one kind of device: ``configs/algo/_auto.yaml``."""

    num_worlds: int  # for each device
    steps: int
    minibatches: int
    autocast: str  # on hardware with units for bf16; fp32 on any other
    samples: float  # control steps of a run, if neither its samples nor its minutes are given
    minutes: float
    memory: float  # GiB, of each process of a run without worlds
    memory_per_world: float  # GiB

    def __post_init__(self) -> None:
        known = ("mixed", "bf16", "fp32")
        require(self.autocast in known, f"autocast must be one of {', '.join(known)}, not {self.autocast!r}")


class Machine(NamedTuple):
    """What ``auto`` depends on: ``kind`` of device, cpu or cuda; its memory in GiB; whether it has units for bf16
    (None: not asked, and the number format stays open); ``count`` of such devices that train together."""

    kind: str
    memory: float = math.inf
    bf16: bool | None = None
    count: int = 1


CPU = Machine("cpu")


def choose(composed: DictConfig, machine: Machine) -> tuple[DictConfig, dict[str, Any]]:
    """The configuration with values in place of ``auto``, and those that were chosen, by key."""
    found = OmegaConf.create(OmegaConf.to_container(composed))
    assert isinstance(found, DictConfig)
    given = device_values(machine.kind)
    values = _values(given, machine)
    chosen = {key: values[key] for key in KEYS if key in values and OmegaConf.select(found, key) == AUTO}
    for key, value in chosen.items():
        OmegaConf.update(found, key, value)
    _choose_the_end(found, given)
    return found, chosen


def in_words(chosen: dict[str, Any]) -> str:
    """The chosen values in one line."""
    return ", ".join(KEYS.get(key, f"{key}={{}}").format(value) for key, value in chosen.items())


def left_open(composed: DictConfig) -> set[str]:
    """The keys that are ``auto``."""
    return {key for key in KEYS if OmegaConf.select(composed, key) == AUTO}


def device_values(kind: str) -> DeviceValues:
    """The values of one ``kind`` of device, cpu or cuda."""
    table = OmegaConf.load(config_dir() / "algo" / "_auto.yaml")
    return parse(OmegaConf.select(table, kind), DeviceValues)


def memory_needed(num_worlds: int, processes: int) -> float:
    """GiB that a run on a CPU takes at least."""
    given = device_values("cpu")
    return processes * given.memory + num_worlds * given.memory_per_world


def require_memory(num_worlds: int, processes: int, memory: float) -> None:
    """Errors: :class:`ConfigError` if a run on a CPU needs more than ``memory`` (GiB); it says what fits."""
    needed, given = memory_needed(num_worlds, processes), device_values("cpu")
    if needed <= memory:
        return
    room = max(0.0, SHARE_OF_MEMORY * memory - processes * given.memory)
    fitting = processes * int(room / given.memory_per_world / processes)
    cure = f"num_worlds={fitting} fits" if fitting else "give fewer processes=" if processes > 1 else "free some"
    what = f"{num_worlds} worlds in {processes} processes" if processes > 1 else f"{num_worlds} worlds"
    raise ConfigError(f"{what} need about {needed:.1f} GiB of memory, and {memory:.1f} are left: {cure}")


def _choose_the_end(config: DictConfig, given: DeviceValues) -> None:
    """``samples`` and ``minutes``, if they are open: one that is given is the only limit."""
    samples, minutes = (OmegaConf.select(config, key) for key in ("samples", "minutes"))
    if samples == AUTO:
        config.samples = given.samples if minutes in (AUTO, 0) else math.inf
    if minutes == AUTO:
        config.minutes = given.minutes if samples in (AUTO, math.inf) else 0.0


def _values(given: DeviceValues, machine: Machine) -> dict[str, Any]:
    worlds = _worlds_that_fit(given, machine.memory) * machine.count
    values: dict[str, Any] = {"num_worlds": worlds, "algo.steps": given.steps, "algo.minibatches": given.minibatches}
    if machine.bf16 is not None:
        values["algo.autocast"] = number_format(machine.kind, machine.bf16)
    return values


def number_format(kind: str, bf16: bool) -> str:
    """What ``algo.autocast=auto`` stands for on a ``kind`` of device, cpu or cuda, with units for ``bf16`` or not."""
    return device_values(kind).autocast if bf16 else "fp32"


def most_worlds(memory: float) -> int:
    """Estimate of the worlds of a training run that fit into a GPU's ``memory`` (GiB), a multiple of 256."""
    given = device_values("cuda")
    return max(int((SHARE_OF_MEMORY * memory - given.memory) / given.memory_per_world), 0) // 256 * 256


def _worlds_that_fit(given: DeviceValues, memory: float) -> int:
    """The number of worlds, halved until a run of them fits into the memory."""
    worlds = given.num_worlds
    while worlds > 1 and given.memory + worlds * given.memory_per_world > SHARE_OF_MEMORY * memory:
        worlds //= 2
    return worlds
