"""Pauses between the end of a ball and the next serve, in N worlds; no ball is in play meanwhile.

During a pause the ball lies or rolls where it ended, is carried to the place of the next launch, or is out of view.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import torch
import warp as wp
from torch import Tensor

from pace.arrays.draws import Column, UniformSampler
from pace.arrays.launch import Launch, MaskedLaunch
from pace.config.task import ServeConfig
from pace.sim.ball.state import BallArrays, EventArrays
from pace.task.game_state import GameArrays

if TYPE_CHECKING:
    from pace.sim.ball.ball import BallSim
    from pace.task.game import Game


class PauseBall(IntEnum):
    """What becomes of the ball during a pause."""

    LIES = 0
    CARRIED = 1
    HIDDEN = 2


LIES, CARRIED, HIDDEN = (wp.constant(int(kind)) for kind in PauseBall)


@wp.kernel
def _begin(
    mask: wp.array[wp.bool],
    game: GameArrays,
    ball: BallArrays,
    in_view: wp.array[wp.bool],
    radius: wp.array[wp.float32],
    duration: wp.array[wp.float32],
    choice: wp.array[wp.float32],
    shares: wp.vec2,
    first: bool,
    control_dt: float,
):
    """Begin a pause of whole control steps in the masked worlds; one of none is a serve at once.

    Before the ``first`` serve of an episode the ball is on the floor below the net, at rest.
    """
    world = wp.tid()
    if not mask[world]:
        return
    steps = wp.round(duration[world] / control_dt)
    waiting = steps > 0.0
    kind = int(HIDDEN)
    if choice[world] < shares[0]:
        kind = LIES
    elif choice[world] < shares[1]:
        kind = CARRIED
    if waiting:
        game.clock.time[world] = 0.0
        if first:
            ball.position[world] = wp.vec3(0.0, 0.0, radius[world])
            ball.velocity[world] = wp.vec3(0.0)
            ball.spin[world] = wp.vec3(0.0)
    game.pause.waiting[world] = waiting
    game.pause.left[world] = steps * control_dt
    game.pause.kind[world] = kind
    game.pause.carried[world] = ball.position[world]
    game.ends.next_serve[world] = not waiting
    in_view[world] = not (waiting and kind == HIDDEN)


@wp.kernel
def _wait(game: GameArrays, in_view: wp.array[wp.bool], control_dt: float):
    """A control step of the pauses; the serve that follows one is due."""
    world = wp.tid()
    if not game.pause.waiting[world] or game.ends.lost[world]:
        return
    left = game.pause.left[world] - control_dt
    game.pause.left[world] = left
    if left < 0.5 * control_dt:
        game.pause.waiting[world] = False
        game.ends.next_serve[world] = True
        in_view[world] = True


@wp.kernel
def _carry(game: GameArrays, ball: BallArrays, events: EventArrays, goal: wp.array[wp.vec3], control_dt: float):
    """Move the carried balls on, straight to their goal, where they arrive as the pause ends."""
    world = wp.tid()
    if not game.pause.waiting[world] or game.pause.kind[world] != CARRIED:
        return
    left = wp.max(game.pause.left[world], control_dt)
    velocity = (goal[world] - game.pause.carried[world]) / left
    game.pause.carried[world] += control_dt * velocity
    ball.position[world] = game.pause.carried[world]
    ball.velocity[world] = velocity
    ball.spin[world] = wp.vec3(0.0)
    events.paddle_impulse[world] = wp.vec3(0.0)


class Pauses:
    """Begins and ends the pauses of a game.

    In each control step: :meth:`carry` once the ball has flown, :meth:`step` once the serves that ended are known. All
    that is kept between them is ``game.pause`` and ``ball.in_view``.

    Args:
        config: ranges of the pauses, and the shares of what becomes of the ball.
        game: whose ``ends.next_serve`` waits for the end of the pause.
        ball: of the same worlds.
        goal: (N, 3) m, where the next serve is launched; known when the pause begins.
        control_dt: s.
        generator: of the samples.
    """

    def __init__(
        self,
        config: ServeConfig,
        game: Game,
        ball: BallSim,
        goal: Tensor,
        control_dt: float,
        generator: torch.Generator,
    ) -> None:
        count, device = ball.num_worlds, ball.device
        self._next_serve = game.ends.next_serve
        self._over = torch.zeros(count, dtype=torch.bool, device=device)
        duration, choice = torch.zeros(count, device=device), torch.zeros(count, device=device)
        share = config.pause_ball
        shares = (share["lies"], share["lies"] + share["carried"])
        self._sample, self._begin = {}, {}
        given = {"game": game, "ball": ball, "in_view": ball.in_view, "radius": ball.params.radius, "shares": shares}
        given |= {"duration": duration, "choice": choice, "control_dt": control_dt}
        for first, ends in ((False, config.pause), (True, config.first_pause)):
            self._sample[first] = UniformSampler([Column(duration, *ends), Column(choice, 0.0, 1.0)], generator)
            self._begin[first] = MaskedLaunch(_begin, count, device, first=first, **given)
        self._wait = Launch(_wait, count, device, game=game, in_view=ball.in_view, control_dt=control_dt)
        carried = {"game": game, "ball": ball, "events": ball.events, "goal": goal, "control_dt": control_dt}
        self._carry = Launch(_carry, count, device, **carried)

    def carry(self) -> None:
        """Put the carried balls where they are after this control step, whatever their flight was."""
        self._carry()

    def step(self) -> None:
        """``ends.next_serve`` marks the serves that are over, and from here on those that begin now."""
        self._over.copy_(self._next_serve)
        self._wait()
        self._start(self._over, first=False)

    def begin(self, mask: Tensor) -> Tensor:
        """The pause before an episode's first serve, in the worlds of ``mask`` (N,) bool; returns those without one."""
        self._start(mask, first=True)
        return mask & self._next_serve

    def _start(self, mask: Tensor, first: bool) -> None:
        self._sample[first](mask)
        self._begin[first](mask)
