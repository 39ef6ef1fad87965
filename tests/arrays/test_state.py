"""What a checkpoint holds of an environment is declared: the list is written out here, for old checkpoints need it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from pace.arrays.state import Stateful, tensors_named, under_prefix, with_prefix
from pace.task.env import TableTennisEnv
from tests.helpers.fakes import config

#: Part -> its tensors, as checkpoints have them since commit 43400ac. Those had a few more, which are computed from
#: these: actor._base_quat, actor._joints, actor._nominal, actor.action, attitude.quat and sensing.base_quat.
STATE = {
    "": "generator",
    "actor": "apex paddle_normal paddle_position prediction shift target time",
    "critic": "frame observation",
    "env": "_bad predictor_target predictor_time_to_apex predictor_valid",
    "game.clock": "fresh index played time",
    "game.closeness": "arrived arrived_now nearest previous",
    "game.ends": "hit lost next_serve outcome over truncated",
    "game.pause": "carried kind left waiting",
    "game.referee": "hit hit_now net_touched outcome own_bounces rim success_now touch_time touched was_open",
    "game.returns": "landing lands_opponent lands_own net_height",
    "game.target": "apex apex_time arriving idle_point playable point something_to_hit time",
    "policy": "frame observation",
    "rewards": "_weights reward sums values",
    "serves": "good good_about sampled",
    "sensing": "_amplitude _delay _line _nominal _scale _sensed _slow ball_age ball_new base_age base_new",
    "state": (
        "action apex arrival base_error feet_distance foot_contact foot_load lost mocap_delay nominal "
        "previous_action shift something_to_hit target"
    ),
    "statistics": "sums",
    "track": "age positions something_to_hit turned",
    "worlds": "in_view position previous_targets spin velocity",
    "worlds.drawn": "actuator_delay backlash paddle_error until_push",
    "worlds.drawn.ball": (
        "drag_coefficient magnus_coefficient mass paddle_drilling_loss paddle_friction paddle_restitution "
        "paddle_tangential_restitution table_drag table_friction table_lift table_restitution "
        "table_tangential_restitution"
    ),
    "worlds.drawn.engine": (
        "ankle_effort_scale armature_scale effort_scale friction joint_damping joint_friction kd_scale kp_scale "
        "speed_scale trunk_com trunk_mass"
    ),
    "worlds.engine": "body_contact foot_force joint_torque qpos qpos_path qvel qvel_path warmstart",
    "worlds.event": (
        "body body_time bounce_position edge edge_time floor floor_time hit_normal hit_offset hit_point hit_position "
        "hit_relative_velocity hit_rim hit_spin_out hit_velocity_in hit_velocity_out impulse_point net "
        "net_time opponent_bounce opponent_bounce_time own_bounce own_bounce_time paddle_hit paddle_hit_time "
        "paddle_impulse"
    ),
}
#: Those of what the robot works out over an episode, with ``observation=memory``.
MEMORY = {
    "attitude": "state",
    "delay": "state",
    "joints": "state",
    "memory": "state",
}


def names(parts: dict[str, str]) -> set[str]:
    return {f"{part}.{name}".lstrip(".") for part, names in parts.items() for name in names.split()}


class Counter(Stateful):
    """Has one tensor to remember, and one that it fills before it reads it."""

    STATE = ("total",)

    def __init__(self) -> None:
        self.total, self.scratch = torch.zeros(2), torch.zeros(2)


def test_state_is_what_is_declared_as_copies_and_is_put_back_in_place() -> None:
    counter = Counter()
    tensor = counter.total
    state = counter.state_dict()
    counter.total += 1.0
    assert {name: value.tolist() for name, value in state.items()} == {"total": [0.0, 0.0]}
    counter.load_state_dict(state | {"other": torch.ones(1)})
    assert counter.total is tensor
    assert tensor.tolist() == [0.0, 0.0]
    with pytest.raises(KeyError, match="total"):
        counter.load_state_dict({})
    with pytest.raises(RuntimeError):
        counter.load_state_dict({"total": torch.zeros(3)})
    with pytest.raises(AttributeError, match="totl"):
        tensors_named(counter, ("totl",))


def test_prefixes() -> None:
    state = with_prefix("a", {"b": torch.ones(1)}) | with_prefix("ab", {"c": torch.zeros(1)})
    assert list(state) == ["a.b", "ab.c"]
    assert list(under_prefix("a", state)) == ["b"]


@pytest.mark.parametrize("engine", ["native", "mjwarp"])
def test_an_environments_state_has_the_names_that_checkpoints_have(engine: str) -> None:
    assert set(TableTennisEnv(config(f"engine={engine}"), 2, "cpu").state_dict()) == names(STATE)
    remembering = TableTennisEnv(config(f"engine={engine}", "observation=memory"), 2, "cpu")
    assert set(remembering.state_dict()) == names(STATE | MEMORY)


def owners(env: TableTennisEnv) -> list[Any]:
    """The environment and all that hangs on it, of this package."""
    found: list[Any] = [env]
    for owner in found:
        for value in vars(owner).values():
            ours = type(value).__module__.startswith("pace.") and hasattr(value, "__dict__")
            if ours and not any(value is known for known in found):
                found.append(value)
    return found


def test_a_new_tensor_is_not_saved_unseen() -> None:
    env = TableTennisEnv(config("observation=memory"), 2, "cpu")
    changed = 0
    for owner in owners(env):
        try:
            owner.new_scratch = torch.zeros(2)
        except AttributeError:  # frozen
            continue
        changed += isinstance(vars(owner).get("new_scratch"), Tensor)
    assert changed > 20
    assert set(env.state_dict()) == names(STATE | MEMORY)
