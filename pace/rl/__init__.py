"""Table tennis as a learning task: environment, rewards, observations, PPO and the commands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pace.rl.env import TableTennisEnv, make_env
    from pace.rl.loading import load_policy

__all__ = ["TableTennisEnv", "load_policy", "make_env"]


def __getattr__(name: str) -> Any:
    """Import on first use, so that ``import pace.rl`` stays light."""
    if name == "load_policy":
        from pace.rl.loading import load_policy

        return load_policy
    if name in __all__:
        from pace.rl import env

        return getattr(env, name)
    raise AttributeError(f"module 'pace.rl' has no attribute {name!r}")
