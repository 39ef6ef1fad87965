"""Plugins from outside of the package: reward terms, observations, algorithms, engines, predictors by name.

Each kind has a :class:`Registry`. A name in the configuration is, in this order: a member of the registry, which the
package or a module that the user has named entered there; an installed entry point of the registry's group; an import
path ``module:attribute``. The module of an import path must have been named (:func:`use`): by the key ``plugins`` of a
command, or by the path itself in a configuration that the user composes. A path in a saved run or policy does not count
as naming, so loading one imports nothing.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import entry_points
from typing import Any, ClassVar, Generic, TypeVar

from omegaconf import DictConfig, ListConfig, OmegaConf

from pace.config.base import ConfigError

T = TypeVar("T")

REWARD_TERMS, OBSERVATIONS, CRITIC_OBSERVATIONS = "pace.reward_terms", "pace.observations", "pace.critic_observations"
ALGORITHMS, ENGINES, PREDICTORS = "pace.algorithms", "pace.engines", "pace.predictors"
#: Keys whose value, or each of whose values, may be an import path; besides, ``function`` of each reward term.
PLACES = ("algo.algorithm", "engine.name", "predictor.features", "observation.policy", "observation.critic")
#: The same in the changes that a stage of the curriculum makes.
STAGE_KEYS = ("engine", "engine.name")

_named: set[str] = set()  # modules that the user of this process has named


class Registry(dict[str, T], Generic[T]):
    """Objects of one kind by name; ``registry[name]`` finds those from outside, too.

    Args:
        kind: its name, for messages.
        group: of the entry points.
        accept: checks, or converts, an object from outside; errors: ``TypeError`` that says what is expected.
        members: those of the package.
        where: prefix of its names, for messages.

    Errors of ``registry[name]``: :class:`ConfigError` for an unknown name, a module that was not named or that cannot
    be imported, and an object of another kind.
    """

    groups: ClassVar[dict[str, Registry[Any]]] = {}

    def __init__(
        self,
        kind: str,
        group: str,
        accept: Callable[[object], T],
        members: Mapping[str, T] | None = None,
        where: str = "",
    ) -> None:
        super().__init__(members or {})
        self.kind, self.group, self.where, self._accept = kind, group, where, accept
        Registry.groups[group] = self

    def __missing__(self, name: str) -> T:
        if ":" in name:
            found = attribute(name)
        elif points := entry_points(group=self.group, name=name):
            found = next(iter(points)).load()
        else:
            known = sorted({*self, *entry_points(group=self.group).names})
            cure = "; plugins=[module] names a module that adds one"
            raise ConfigError(f"unknown {self.kind} '{self.where}{name}'; known: {', '.join(known)}{cure}")
        try:
            return self._accept(found)
        except TypeError as error:
            raise ConfigError(f"{self.kind} '{name}': {error}") from error

    def enter(self, name: str, member: T) -> None:
        """Add a member. Errors: :class:`ConfigError` for a name that exists already."""
        if name in self and self[name] != member:
            raise ConfigError(f"there is a {self.kind} '{name}' already: give yours another name")
        self[name] = member


def may_be_outside(group: str, name: str) -> bool:
    """Whether ``name`` can come from outside, as far as that is known without importing anything."""
    members = Registry.groups.get(group, {})
    return ":" in name or name in members or name in entry_points(group=group).names


def use(modules: Iterable[str]) -> None:
    """Import ``modules``, which the user names, and allow import paths into them and their submodules.

    The working folder is searched last. Errors: :class:`ConfigError` for one that cannot be imported.
    """
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    for module in modules:
        _import(module)
        _named.add(module)


def attribute(path: str) -> Any:
    """The object ``module:attribute``.

    Errors: :class:`ConfigError` for a module that was not named (:func:`use`) or that has no such attribute.
    """
    module, _, name = path.partition(":")
    if not any(module == named or module.startswith(f"{named}.") for named in _named):
        raise ConfigError(f"'{path}' is not of pace, and its module was not named: plugins=[{module}] imports it")
    found = vars(_import(module)).get(name)
    if found is None:
        raise ConfigError(f"'{path}': the module {module} has no {name}")
    return found


def _import(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except (ImportError, ValueError, SyntaxError) as error:
        raise ConfigError(f"plugins: {module} cannot be imported: {error}") from error


def use_named(composed: DictConfig) -> None:
    """:func:`use` the modules of ``plugins`` and of each import path in what the user has composed.

    ``plugins`` then holds all of them, so that a saved configuration names the modules that it needs.
    """
    given = composed.get("plugins")
    if isinstance(given, str):
        raise ConfigError(f"plugins is a list of modules: write plugins=[{given}]")
    found = [path.partition(":")[0] for path in _import_paths(composed)]
    composed["plugins"] = list(dict.fromkeys([*(given or []), *found]))
    use(composed["plugins"])


def _import_paths(composed: DictConfig) -> Iterator[str]:
    values = [OmegaConf.select(composed, place) for place in PLACES]
    terms = OmegaConf.select(composed, "reward.terms")
    if isinstance(terms, DictConfig):
        values += [term.get("function") for term in terms.values() if isinstance(term, DictConfig)]
    for stage in OmegaConf.select(composed, "curriculum") or []:
        changes = (str(change).partition("=") for change in stage.get("task") or [])
        values += [value for key, _, value in changes if key in STAGE_KEYS or key.endswith(".function")]
    for value in values:
        for path in value if isinstance(value, ListConfig) else [value]:
            if isinstance(path, str) and ":" in path:
                yield path
