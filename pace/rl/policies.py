"""Loading a saved policy together with its task."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pace.config.base import ConfigError, config_dir, meant, parse
from pace.config.overrides import override_task, stage_tasks, without_reward
from pace.config.predictor import PredictorConfig
from pace.config.schedules import position_of
from pace.config.training import TrainConfig
from pace.devices import resolve_device
from pace.predictor.network import BallPredictor, make_predictor
from pace.rl.agent import Sizes
from pace.rl.algorithm import ALGORITHMS
from pace.runs.checkpoint import META, TRAINING, WEIGHTS, Checkpoint, CheckpointError, load_checkpoint, load_weights
from pace.sim.robot_spec import RobotSpec
from pace.task.observations import POLICY, width

if TYPE_CHECKING:
    from pace.task.env import TableTennisEnv
PRETRAINED = "pretrained"  # folder of published policies, beside configs/
RANDOM_STD = 0.8  # of the random policy's actions: the first std of a training run


@dataclass(frozen=True)
class TaskPolicy:
    """A policy, callable with the raw ``policy`` observation (N, Dp), and its task.

    Attributes: ``config`` as saved; ``act`` the function behind the call; ``predictor`` the network that the actor's
    predicted observations come from (``None``: zeros); ``source`` the checkpoint's folder, or the built-in's name;
    ``counters`` of the training (updates, samples, wall_s).
    """

    config: TrainConfig
    act: Callable[[Tensor], Tensor]
    predictor: BallPredictor | None
    source: str
    counters: Mapping[str, float] = field(default_factory=dict)

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Raw observation (N, Dp) -> action (N, J), deterministic for a saved policy."""
        return self.act(observation)

    def to(self, device: str | torch.device) -> TaskPolicy:
        """Move the networks to ``device``; returns itself."""
        for part in (self.act, self.predictor):
            if isinstance(part, torch.nn.Module):
                part.to(device)
        return self

    def make_env(
        self,
        num_worlds: int = 64,
        device: str = "auto",
        seed: int = 1,
        overrides: Sequence[str] = (),
        rewards: bool = False,
    ) -> TableTennisEnv:
        """The saved task in N worlds, with the saved predictor; the policy moves to the same device.

        Without ``rewards`` none is computed (it is 0), and the saved reward's terms need not be known.

        ``overrides`` are those of :func:`override_task`, such as ``["serve=mixed", "engine.physics_dt=0.002"]``.
        Errors: :class:`ConfigError` for a wrong key or value, or for a missing engine or device.
        """
        from pace.task.env import TableTennisEnv  # loads the simulation, which takes seconds

        where = resolve_device(device)
        self.to(where)
        config = override_task(self.config, overrides)
        return TableTennisEnv(config if rewards else without_reward(config), num_worlds, where, seed, self.predictor)


@dataclass(frozen=True)
class TrainedPredictor:
    """A saved predictor and how it was configured."""

    config: PredictorConfig
    network: BallPredictor


def load_policy(path: str | Path, device: str | torch.device = "cpu") -> TaskPolicy:
    """The policy of a run folder (its newest checkpoint), a checkpoint, a file in one, or ``pretrained/<name>``.

    Nothing in the files is executed or unpickled. A module that an import path in the configuration names is not
    imported unless the user has named it: :func:`pace.config.plugins.use`.

    Errors: :class:`CheckpointError` for a folder without a checkpoint, another format, a missing, reshaped or broken
    tensor, and a configuration of another version.
    """
    checkpoint = load_checkpoint(locate(path), weights_only=True)
    config, source = saved_config(checkpoint), str(checkpoint.path)
    sizes = Sizes(policy_size(config), 0, len(RobotSpec.of(config.robot).joints))
    with _outside_named(source):
        algorithm = ALGORITHMS[config.algo.algorithm]
    network = algorithm.load_policy(_part(checkpoint, "agent"), sizes, config.algo, source)
    predictor = _load_predictor(checkpoint, config.predictor)
    return TaskPolicy(config, network.requires_grad_(False).eval(), predictor, source, checkpoint.counters).to(device)


def load_predictor(path: str | Path) -> TrainedPredictor:
    """The predictor of a run, of a policy or trained alone; ``path`` and errors as those of :func:`load_policy`."""
    checkpoint = load_checkpoint(locate(path), weights_only=True)
    config = saved_config(checkpoint).predictor
    return TrainedPredictor(config, _load_predictor(checkpoint, config))


def _load_predictor(checkpoint: Checkpoint, config: PredictorConfig) -> BallPredictor:
    with _outside_named(str(checkpoint.path)):
        network = make_predictor(config)
    load_weights(network, _part(checkpoint, "predictor"), f"{checkpoint.path} (predictor)")
    return network.requires_grad_(False).eval()


@contextmanager
def _outside_named(source: str) -> Iterator[None]:
    """Errors: :class:`CheckpointError` if ``source`` needs a module outside of pace that the user has not named."""
    try:
        yield
    except ConfigError as error:
        raise CheckpointError(f"{source}: {error}") from error


def locate(path: str | Path) -> Path:
    """``path``, or the one of that name beside the package's ``configs/`` (so that ``pretrained/<name>`` is found), or
    the published policy of that name.

    Errors: :class:`CheckpointError` for a file that is no part of a checkpoint, and, with the existing names, for a
    missing ``pretrained/<name>``.
    """
    path, own = Path(path), config_dir().parent
    if not path.exists() and not path.is_absolute():
        path = next((found for found in (own / path, own / PRETRAINED / path) if found.exists()), path)
    if not path.exists() and path.parent.name in (PRETRAINED, ""):
        known = sorted(file.parent.name for file in (own / PRETRAINED).glob(f"*/{META}"))
        raise CheckpointError(f"{path} does not exist{meant(path.name, known)} ({PRETRAINED}: {', '.join(known)})")
    if path.is_file() and path.name not in (META, WEIGHTS, TRAINING):
        raise CheckpointError(f"{path} is no file of a checkpoint: give a run folder, or a folder with {META}")
    return path


def saved_config(checkpoint: Checkpoint) -> TrainConfig:
    """The configuration at the end of a checkpoint's training: its task is that of the curriculum's stage.

    Errors: :class:`CheckpointError` when this version of pace does not know its keys.
    """
    try:
        config = parse(checkpoint.config, TrainConfig)
        return stage_tasks(config, position_of(checkpoint.counters))[-1]
    except (ConfigError, ValueError) as error:
        raise CheckpointError(f"{checkpoint.path} is of another version of pace: {error}") from error


def policy_size(config: TrainConfig) -> int:
    """Numbers in the actor's observation: those of a frame, times its history."""
    size, joints = 0, len(RobotSpec.of(config.robot).joints)
    for name in config.observation.policy:
        with _outside_named(f"the policy observes '{name}', which this version of pace does not know"):
            size += width(POLICY[name].size, joints)
    return config.observation.policy_history * size


def _part(checkpoint: Checkpoint, name: str) -> dict[str, Tensor]:
    if not isinstance(checkpoint.weights, dict) or name not in checkpoint.weights:
        raise CheckpointError(f"{checkpoint.path}: the weights of the {name} are missing")
    return checkpoint.weights[name]


def built_in_policy(name: str, seed: int, like: TaskPolicy | None = None, device: str = "cpu") -> TaskPolicy:
    """``zero``: holds the nominal pose; ``random``: actions N(0, 0.8), resampled at each step.

    Its task and predictor are those of ``like``, or the default ones.
    """
    from pace.config.training import load_train_config

    config, predictor = (like.config, like.predictor) if like else (load_train_config(), None)
    where, joints = resolve_device(device), len(RobotSpec.of(config.robot).joints)
    generator = torch.Generator(where).manual_seed(seed)

    def zero(observation: Tensor) -> Tensor:
        return observation.new_zeros(observation.shape[0], joints)

    def random(observation: Tensor) -> Tensor:
        shape = (observation.shape[0], joints)
        return torch.randn(shape, device=where, generator=generator).mul_(RANDOM_STD)

    if name not in ("zero", "random"):
        raise ConfigError(f"policy must be zero or random, not {name!r}")
    return TaskPolicy(config, zero if name == "zero" else random, predictor, name)
