"""Balls of any numbers: they fly on finite numbers, or are stopped and counted; other worlds do not notice."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.config.training import load_train_config
from pace.sim.worlds import Worlds
from tests.helpers.examples import any_vectors, check, counts

N = 2  # the first has any ball, the second an ordinary one


def state(worlds: Worlds) -> dict[str, Tensor]:
    ball = worlds.ball
    named = {"position": ball.position, "velocity": ball.velocity, "spin": ball.spin}
    return named | {"distance": ball.nearest_paddle_distance, "qpos": worlds.engine.qpos_path}


@counts
def test_a_ball_of_any_numbers_flies_or_is_counted(count: int) -> None:
    worlds = Worlds(
        load_train_config(["engine=native", "engine.threads=1", "randomization=none"]),
        N, "cpu", torch.Generator().manual_seed(3),
    )  # fmt: skip
    everyone = torch.ones(N, dtype=torch.bool)
    standing = worlds.engine.qpos_path[:, 0].clone(), 0.0 * worlds.engine.qvel_path[:, 0]
    served = torch.tensor([[1.3, 0.0, 1.0], [-6.0, 0.0, 1.5], [0.0, 0.0, 0.0]])

    def flown(first: Tensor) -> Tensor:
        """The ordinary ball after three steps beside the ``first``, (3, 3)."""
        worlds.reset_robot(everyone, *standing)
        worlds.serve(everyone, *(torch.stack(pair) for pair in zip(first, served, strict=True)))
        for _ in range(3):
            worlds.step(worlds.nominal.repeat(N, 1))
            for name, value in state(worlds).items():
                assert bool(value.isfinite().all()), name
            assert not bool(worlds.divergence.diverged[1])
        return torch.cat([worlds.ball.position[1], worlds.ball.velocity[1]])

    alone = flown(served)

    @check(count, any_vectors(), any_vectors(), any_vectors())
    def example(place: list[float], velocity: list[float], spin: list[float]) -> None:
        first = torch.tensor([place, velocity, spin])
        worlds.divergence.pop_count()
        assert torch.equal(flown(first), alone)
        if not bool(first.isfinite().all()):
            assert int(worlds.divergence.pop_count()) >= 1
