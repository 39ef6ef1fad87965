"""Worlds whose numbers go wrong: stopped in their step on both engines, alone, and remembered."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pace.config.base import to_dict
from pace.config.training import load_train_config
from pace.sim.replay import ReplayError, load_replay, save_replay
from pace.sim.worlds import Worlds
from tests.helpers.robot import SPEC

N, BAD = 4, 2
Spoil = Callable[[Worlds], None]


def make(engine: str, *overrides: str) -> Worlds:
    given = [f"engine={engine}", "randomization=none", "engine.threads=1", "engine.remembered_steps=6", *overrides]
    worlds = Worlds(load_train_config(given), N, "cpu", torch.Generator().manual_seed(3))
    everyone = torch.ones(N, dtype=torch.bool)
    worlds.reset_robot(everyone, worlds.engine.qpos_path[:, 0].clone(), 0.0 * worlds.engine.qvel_path[:, 0])
    place = torch.tensor([0.5, 0.0, 1.2]).repeat(N, 1)
    worlds.serve(everyone, place, torch.tensor([-4.0, 0.0, 1.0]).repeat(N, 1), 0.0 * place)
    return worlds


def step(worlds: Worlds, count: int = 1) -> None:
    for _ in range(count):
        worlds.step(worlds.nominal.repeat(N, 1))


def readable(worlds: Worlds) -> dict[str, Tensor]:
    """All that a task reads of the worlds."""
    robot = {f"robot.{name}": value for name, value in vars(worlds.robot).items()}
    ball = {"position": worlds.ball.position, "velocity": worlds.ball.velocity, "spin": worlds.ball.spin}
    events = {f"event.{name}": value for name, value in vars(worlds.ball.events).items() if value.is_floating_point()}
    paths = {"qpos": worlds.engine.qpos_path, "qvel": worlds.engine.qvel_path, "table": worlds.engine.table_force}
    seen = robot | ball | events | paths | {"distance": worlds.ball.nearest_paddle_distance}
    return {name: value.clone() for name, value in seen.items()}


def nan_in_a_joint(worlds: Worlds) -> None:
    worlds.engine.state_tensors()["qpos"][BAD, 9] = torch.nan


def nan_in_a_velocity(worlds: Worlds) -> None:
    worlds.engine.state_tensors()["qvel"][BAD, 3] = torch.nan


def much_too_fast(worlds: Worlds) -> None:
    worlds.engine.state_tensors()["qvel"][BAD, 8] = 1e7


def nan_in_a_push(worlds: Worlds) -> None:
    push = torch.zeros(N, worlds.model.nv)
    push[BAD, 0] = torch.nan
    worlds.engine.add_velocity(push)


def nan_in_the_ball(worlds: Worlds) -> None:
    worlds.ball.velocity[BAD, 1] = torch.nan


def infinite_spin(worlds: Worlds) -> None:
    worlds.ball.spin[BAD, 1] = torch.inf


@pytest.mark.parametrize("engine", ["native", "mjwarp"])
@pytest.mark.parametrize(
    "spoil",
    [
        nan_in_a_joint,
        nan_in_a_velocity,
        nan_in_a_push,
        much_too_fast,
        nan_in_the_ball,
        infinite_spin,
    ],
)
def test_a_world_that_diverges_is_stopped_alone_and_can_be_reset(engine: str, spoil: Spoil) -> None:
    """The others are bit for bit those of a run without it; nothing that can be read is not finite."""
    whole, spoilt = make(engine), make(engine)
    for worlds in (whole, spoilt):
        step(worlds, 2)
    spoil(spoilt)
    everyone = torch.arange(N) == BAD
    for _ in range(3):
        for worlds in (whole, spoilt):
            step(worlds)
            if worlds is spoilt:
                assert torch.equal(worlds.divergence.diverged, everyone & worlds.divergence.diverged)
            fresh = worlds.engine.qpos_path[:, 0].clone(), 0.0 * worlds.engine.qvel_path[:, 0]
            worlds.reset_robot(worlds.divergence.diverged, *fresh)
        first, second = readable(whole), readable(spoilt)
        others = ~everyone
        for name, value in second.items():
            finite = value.isfinite() if "time" not in name else ~value.isnan()  # no event is at an infinite time
            assert bool(finite.all()), name
            assert torch.equal(value[others], first[name][others]), name
    assert int(spoilt.divergence.pop_count()) == 1
    assert int(spoilt.divergence.pop_count()) == 0
    assert spoilt.divergence.when.tolist() == [0, 0, 3, 0]
    assert int(whole.divergence.pop_count()) == 0


def test_without_a_limit_only_what_is_not_finite_counts() -> None:
    worlds = make("native", "engine.largest_speed=0")
    worlds.engine.state_tensors()["qvel"][BAD, 8] = 3000.0
    step(worlds)
    limited = make("native", "engine.largest_speed=100")
    limited.engine.state_tensors()["qvel"][BAD, 8] = 3000.0
    step(limited)
    assert not bool(worlds.divergence.diverged.any()) or not bool(worlds.robot.joint_velocity.isfinite().all())
    assert limited.divergence.diverged.tolist() == [False, False, True, False]


@pytest.mark.parametrize("steps", [2, 6, 9])
def test_a_replay_holds_the_last_steps_as_they_were(steps: int) -> None:
    worlds = make("native")
    seen = []
    for number in range(steps):
        last = (worlds.engine.qpos_path[BAD, -1], worlds.engine.qvel_path[BAD, -1])
        ball = (worlds.ball.position[BAD], worlds.ball.velocity[BAD], worlds.ball.spin[BAD])
        seen.append(torch.cat([*last, *ball]).clone())
        worlds.step((worlds.nominal + 0.01 * number).repeat(N, 1))
    assert worlds.recorder is not None
    replay = worlds.recorder.replay(BAD, steps)
    expected = torch.stack(seen[-6:])
    assert torch.equal(torch.cat([replay.qpos, replay.qvel, replay.ball], dim=1), expected)
    shift = 0.01 * torch.arange(steps)[-6:].unsqueeze(1)
    torch.testing.assert_close(replay.targets, worlds.nominal + shift)
    assert len(worlds.recorder.replay(BAD, max(1, steps - 3)).qpos) == max(1, min(6, steps) - 3)


def test_a_replay_is_a_file_and_back(tmp_path: Path) -> None:
    worlds = make("native")
    step(worlds, 3)
    assert worlds.recorder is not None
    config = to_dict(load_train_config())
    kept = [worlds.recorder.replay(world, 3) for world in (1, 3)]
    file = save_replay(tmp_path / "replays" / "a.replay", kept, config, "kl is not finite")
    again = load_replay(file)
    assert (again.reason, again.config, [each.world for each in again.worlds]) == ("kl is not finite", config, [1, 3])
    for one, other in zip(kept, again.worlds, strict=True):
        assert torch.equal(one.qpos, other.qpos)
        assert torch.equal(one.ball, other.ball)
    assert again.worlds[0].targets.shape == (3, len(SPEC.joints))


@pytest.mark.parametrize("content", [b"", b"\x80\x04.", b"\xff" * 64, b"{}" * 100])
def test_a_file_that_is_no_replay_is_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.replay").write_bytes(content)
    with pytest.raises(ReplayError, match=r"a\.replay"):
        load_replay(tmp_path / "a.replay")
    with pytest.raises(ReplayError, match="cannot be read"):
        load_replay(tmp_path / "nothing.replay")
