"""Hits of a ball that are made up: in the simulation, and as what a robot's memory of returns is given."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.onboard.estimate import Estimate
from pace.sim.ball.aero import GRAVITY
from pace.task.env import TableTennisEnv
from tests.helpers.estimates import Running

DT = 0.02  # s
POINT = torch.tensor([-1.6, -0.2, 1.0])  # m, where ball and paddle meet


def aim_at_paddle(env: TableTennisEnv, worlds: slice = slice(None), speed: float = 6.0) -> None:
    """Put the ball of ``worlds`` 10 cm in front of the paddle's face, flying into it, after its bounce."""
    robot, ball = env.worlds.robot, env.worlds.ball
    normal = robot.paddle_normal * robot.paddle_normal[:, :1].sign()
    ball.position[worlds] = (robot.paddle_position + 0.1 * normal)[worlds]
    ball.velocity[worlds] = (robot.paddle_velocity - speed * normal)[worlds]
    env.game.referee.own_bounces[worlds] = 1


class Rally:
    """One world's memory of returns, and made-up hits to feed it with.

    Args: module: the memory; ball (3,) m/s before each hit; normal (3,) of the paddle.
    """

    def __init__(self, module: Estimate, ball: Tensor, normal: Tensor) -> None:
        self._ball = ball
        self.track, self.turned = torch.zeros(1, 15), torch.zeros(1, dtype=torch.bool)
        self.paddle, self.normal = torch.zeros(1, 3), normal.repeat(1, 1)
        self.memory = Running(module, self.reads)

    def reads(self) -> dict[str, Tensor]:
        """What the memory is given now."""
        pose = {"paddle_position": self.paddle, "paddle_normal": self.normal}
        return {"track": self.track, "turned": self.turned, **pose}

    def play(self, after: Tensor, paddle: Tensor, away: Tensor | None = None, last: int = 10) -> None:
        """Play a ball that is hit one step before it is seen to turn, up to instant ``last``.

        Args: after (3,) m/s, the ball's velocity after the hit; paddle (3,) m/s; away (3,) m: the paddle is there.
        """
        gravity = torch.tensor([0.0, 0.0, -GRAVITY])
        path = []
        for step in range(-5, 6):  # 0 is the hit
            time, velocity = step * DT, self._ball if step <= 0 else after
            path.append(POINT + velocity * time + 0.5 * gravity * time**2)
        for newest in range(4, last + 1):
            self.track.copy_(torch.stack(path[newest - 4 : newest + 1]).view(1, 15))
            self.paddle.copy_(POINT + paddle * (newest - 5) * DT if away is None else away)
            self.turned.fill_(newest >= 6)  # one step after the hit
            self.memory.update()

    def next_ball(self) -> None:
        """Another ball is served."""
        self.track.copy_(torch.tensor([1.35, 0.0, 1.03]).repeat(1, 5))
        self.turned.fill_(False)
        self.memory.update()
