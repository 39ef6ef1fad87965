"""The TorchRL environment as one call, with a trained predictor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pace.config.base import ConfigError
from pace.config.names import split_override
from pace.config.training import TrainConfig, load_train_config
from pace.devices import resolve_device
from pace.onboard.actor import Predictor
from pace.predictor.network import BallPredictor
from pace.rl.policies import load_predictor
from pace.task.env import TableTennisEnv

#: The published policy whose predictor is used unless another one is given. It was trained on every ball and sensing.
PUBLISHED = "campaign"


def make_env(
    num_worlds: int = 64,
    engine: str = "auto",
    device: str = "auto",
    seed: int = 1,
    overrides: Sequence[str] = (),
    predictor: str | Path | Predictor | None = PUBLISHED,
) -> TableTennisEnv:
    """An environment with the default configuration of ``configs/train.yaml`` and Hydra ``overrides``.

    Args:
        num_worlds: as the key of ``pace train``, and so are ``engine``, ``device`` and ``seed``.
        engine: ``auto``, ``native`` or ``mjwarp``.
        device: ``auto``, ``cpu`` or ``cuda``.
        seed: of all random numbers.
        overrides: such as ``["serve=short", "reward.terms.success.weight=200"]``.
        predictor: of the ball's apex, which the actor observes. A run folder, a checkpoint or the name of a published
            policy: its trained predictor, with its configuration. A callable (N, 3 * frames) -> (N, P): used as it is
            with the ``predictor`` of the configuration, at each step; change a module's weights in place to train it.
            ``None``: the predicted quantities are zero. The choice ``predictor=...`` among ``overrides`` configures a
            predictor of your own, so it needs a callable or ``None``.

    Errors: :class:`pace.config.ConfigError` for a wrong key or value, an engine or a device that is not there, and for
    a trained predictor together with overrides of its configuration; :class:`pace.runs.checkpoint.CheckpointError` for
    a predictor that cannot be loaded.
    """
    config = load_train_config([f"num_worlds={num_worlds}", f"engine={engine}", f"seed={seed}", *overrides])
    where = resolve_device(device)
    if not isinstance(predictor, str | Path):
        return TableTennisEnv(config, num_worlds, where, seed, predictor)
    config, network = _with_trained(config, predictor, overrides)
    return TableTennisEnv(config, num_worlds, where, seed, network.to(where) if network is not None else None)


def _with_trained(
    config: TrainConfig, path: str | Path, overrides: Sequence[str]
) -> tuple[TrainConfig, BallPredictor | None]:
    """``config`` with the predictor of ``path``, and its network; without one if the configuration switches it off."""
    if not config.predictor.enabled:
        return config, None
    own = [o for o in overrides if split_override(o)[0].split(".")[0] == "predictor"]
    if own:
        raise ConfigError(
            f"{own[0]} configures a predictor, and predictor={str(path)!r} brings a trained one with its own "
            "configuration: give your network, or None, as predictor="
        )
    trained = load_predictor(path)
    return replace(config, predictor=trained.config), trained.network
