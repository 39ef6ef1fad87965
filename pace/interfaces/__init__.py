"""Environments as other libraries want them: gymnasium's vector environment, rsl_rl's, TorchRL's with a predictor.

Adapters belong here, not the task itself (``task``) and not a learner (``rl``). They copy nothing that can be shared.
Imports ``rl`` and the rooms below; gymnasium and rsl_rl are loaded by the adapter that needs them (extra
``interfaces``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pace.lazy import on_first_use

if TYPE_CHECKING:
    from pace.interfaces.gymnasium_env import GymnasiumEnv
    from pace.interfaces.rsl_rl_env import RslRlEnv
    from pace.rl.environment import make_env

__all__ = ["GymnasiumEnv", "RslRlEnv", "make_env"]

__getattr__ = on_first_use(
    __name__,
    {
        "GymnasiumEnv": "pace.interfaces.gymnasium_env",
        "RslRlEnv": "pace.interfaces.rsl_rl_env",
        "make_env": "pace.rl.environment",
    },
)
