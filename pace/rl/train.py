"""``python -m pace.rl.train``: train a policy and its predictor. ``--help`` shows every key of the configuration.

Examples::

    python -m pace.rl.train                                  # the recipe for CPU cores, half an hour
    python -m pace.rl.train experiment=paper device=cuda     # the paper's numbers
    python -m pace.rl.train resume=runs/2026-01-01_pace minutes=60
    python -m pace.rl.train init_from=runs/2026-01-01_pace ball=paper
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from pace.command import run_command
from pace.config import ConfigError, TrainConfig, parse, to_dict
from pace.predictor.network import PredictorNetwork
from pace.rl.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from pace.rl.progress import rate_texts
from pace.rl.rollout import RolloutError
from pace.rl.run_folder import CURVE, METRICS, RunFolder, default_run_dir
from pace.rl.trainer import Summary, Trainer
from pace.sim.engine import resolve_device

# What a resumed run may change; everything else is as it was saved, or the run would not go on where it stopped.
RESUME_KEYS = ("resume", "samples", "minutes", "checkpoint_minutes", "tensorboard", "progress", "device")


def main() -> int:
    """Entry point; returns the exit status."""
    return run_command(train_from_config, "train", (CheckpointError, RolloutError))


def train_from_config(composed: DictConfig) -> None:
    """Train as the composed configuration says, and print what was written."""
    config = parse(composed, TrainConfig)
    if config.resume:
        overrides = list(HydraConfig.get().overrides.task)
        saved = load_checkpoint(config.resume)
        config = resumed_config(saved, config.resume, overrides)
        print(f"going on from {saved.path}")
    else:
        saved = None
    trainer = build_trainer(config, saved)
    print(
        f"training {config.name}: {config.num_worlds} worlds on {trainer.device}, "
        f"networks in {str(trainer.agent.observation_dtype).removeprefix('torch.')}, run folder {trainer.run.path}",
        flush=True,
    )
    report(trainer.train(), trainer.run.path)


def resumed_config(saved: Checkpoint, path: str, overrides: list[str]) -> TrainConfig:
    """The saved configuration with the limits of the command line.

    Errors: :class:`ConfigError` for an override of anything that a resumed run may not change.
    """
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if key not in RESUME_KEYS:
            raise ConfigError(f"'{key}' cannot change in a resumed run ({', '.join(RESUME_KEYS)} can): use init_from")
    changed = OmegaConf.merge(OmegaConf.create(saved.config), OmegaConf.from_dotlist(overrides))
    config = parse(OmegaConf.to_container(changed), TrainConfig)  # type: ignore[arg-type]
    config.resume, config.init_from = path, None
    if saved.counters["samples"] >= config.samples:
        raise ConfigError(f"{path} has {saved.counters['samples']} samples: give samples= above that to go on")
    if saved.path is not None:  # where the run lies now; it may have been moved or copied since it was saved
        config.run_dir = str(saved.path.parent.parent)
    return config


def build_trainer(config: TrainConfig, saved: Checkpoint | None) -> Trainer:
    """Environment, networks and run folder of ``config``; state from ``saved`` or ``config.init_from`` if given."""
    from pace.rl.env import TableTennisEnv

    device = resolve_device(config.device)
    start = load_checkpoint(config.init_from, weights_only=True) if config.init_from else None
    torch.manual_seed(config.seed)
    predictor = PredictorNetwork(config.predictor).to(device)
    env = TableTennisEnv(config, config.num_worlds, device, config.seed, predictor)
    config.run_dir = config.run_dir or str(default_run_dir(config.name))
    first_update = int(saved.counters["updates"]) if saved else 0
    run = RunFolder(Path(config.run_dir), to_dict(config), config.tensorboard, first_update)
    trainer = Trainer(config, env, predictor, run)
    if saved:
        trainer.resume(saved)
    elif start:
        trainer.load_weights(start)
    return trainer


def report(summary: Summary, run_dir: Path) -> None:
    """Print how the run ended and which files it wrote."""
    print(
        f"{summary.reason}: {summary.updates} updates, {summary.samples:,} samples, {summary.seconds / 60:.1f} min\n"
        f"last updates: {', '.join(rate_texts(summary.rates))}\n"
        f"wrote {summary.checkpoint}\n"
        f"wrote {run_dir / METRICS}" + (f"\nwrote {run_dir / CURVE}" if summary.curve else "")
    )


if __name__ == "__main__":
    sys.exit(main())
