"""rsl_rl's own PPO on the task, through its ``VecEnv``.

    pip install 'pace-table-tennis[interfaces]'
    python examples/train_rsl_rl.py --worlds 1024 --updates 1000 --out runs/rsl_rl

The critic sees the truth (``critic``), the actor what the robot can know (``policy``).
"""

from __future__ import annotations

import argparse
from typing import Any

from rsl_rl.runners import OnPolicyRunner

import pace
from pace.interfaces import RslRlEnv


def settings(hidden: int = 256) -> dict[str, Any]:
    """Configuration of the runner."""
    model = {"class_name": "rsl_rl.models.MLPModel", "hidden_dims": [hidden] * 2, "obs_normalization": True}
    gaussian = {"class_name": "rsl_rl.modules.GaussianDistribution", "init_std": 0.8}
    return {
        "num_steps_per_env": 24,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
        "actor": model | {"distribution_cfg": gaussian},
        "critic": dict(model),
        "algorithm": {"class_name": "rsl_rl.algorithms.PPO", "gamma": 0.97, "entropy_coef": 1e-3},
    }


def make_runner(worlds: int, out: str | None, device: str = "cpu", hidden: int = 256, **kind: Any) -> OnPolicyRunner:
    """A runner on ``worlds`` worlds that writes into the folder ``out``; ``kind``: arguments of ``pace.make_env``."""
    env = RslRlEnv(pace.make_env(worlds, device=device, **kind))
    return OnPolicyRunner(env, settings(hidden), log_dir=out, device=str(env.device))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="rsl_rl's PPO on table tennis.")
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--updates", type=int, default=1000)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", default="runs/rsl_rl", help="folder of its logs and models")
    options = parser.parse_args()
    make_runner(options.worlds, options.out, options.device).learn(options.updates)


if __name__ == "__main__":
    main()
