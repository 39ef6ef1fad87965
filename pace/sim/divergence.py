"""Robots and balls whose numbers go wrong: stopped within the control step, before anything else reads them."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import Launch
from pace.sim.ball.events import clear_events
from pace.sim.ball.state import BallArrays, BallEvents, BallState, EventArrays
from pace.sim.engine.base import EngineArrays, RobotEngine

#: Largest number of a state when ``engine.largest_speed`` is off: whatever is finite.
FINITE = 3.0e38
AWAY = wp.constant(1000.0)  # m: distance of the paddle to a ball that was stopped


@wp.func
def _robot_is_wrong(engine: EngineArrays, world: int, largest: float) -> bool:
    """What is not finite stays so until the end of the step: only its end is looked at. NaN is below no limit."""
    last = engine.qpos_path.shape[1] - 1
    wrong = wp.int32(0)
    for i in range(engine.qpos_path.shape[2]):
        if not (wp.abs(engine.qpos_path[world, last, i]) <= FINITE):
            wrong = 1
    for i in range(engine.qvel_path.shape[2]):
        if not (wp.abs(engine.qvel_path[world, last, i]) <= largest):
            wrong = 1
    return wrong == 1


@wp.func
def _hold_state(engine: EngineArrays, world: int):
    """Hold the state of the step's beginning. A number that was not finite even then is 0, and a quaternion without
    length is that of no rotation."""
    length = wp.float32(0.0)
    for i in range(engine.qpos_path.shape[2]):
        start = engine.qpos_path[world, 0, i]
        held = wp.where(wp.isfinite(start), start, 0.0)
        if i >= 3 and i < 7:
            length += held * held
        for instant in range(engine.qpos_path.shape[1]):
            engine.qpos_path[world, instant, i] = held
    for i in range(engine.qvel_path.shape[2]):
        start = engine.qvel_path[world, 0, i]
        held = wp.where(wp.isfinite(start), start, 0.0)
        for instant in range(engine.qvel_path.shape[1]):
            engine.qvel_path[world, instant, i] = held
    if length < 0.5:
        for instant in range(engine.qpos_path.shape[1]):
            engine.qpos_path[world, instant, 3] = 1.0


@wp.kernel
def _stop_robot(engine: EngineArrays, table_force: wp.array3d[wp.vec3], largest: float, diverged: wp.array[wp.bool]):
    """A robot whose state is not finite, or faster than ``largest``, stays through the step as it began it."""
    world = wp.tid()
    wrong = _robot_is_wrong(engine, world, largest)
    diverged[world] = wrong
    if not wrong:
        return
    _hold_state(engine, world)
    for foot in range(engine.foot_force.shape[1]):
        engine.foot_force[world, foot] = wp.vec3()
    for i in range(engine.body_contact.shape[1]):
        engine.body_contact[world, i] = 0.0
    for i in range(engine.joint_torque.shape[1]):
        engine.joint_torque[world, i] = 0.0
    for step in range(table_force.shape[1]):
        for touch in range(table_force.shape[2]):
            table_force[world, step, touch] = wp.vec3()


@wp.func
def _is_wrong(vector: wp.vec3) -> bool:
    return not (wp.length_sq(vector) <= FINITE)


@wp.kernel
def _stop_ball(
    ball: BallArrays,
    events: EventArrays,
    paddle_distance: wp.array[wp.float32],
    step: wp.array[wp.int32],
    diverged: wp.array[wp.bool],
    when: wp.array[wp.int32],
    count: wp.array[wp.float32],
):
    """A ball that is not finite lies on the floor and has met nothing. Then count the world, if anything is wrong."""
    world = wp.tid()
    wrong = _is_wrong(ball.position[world]) or _is_wrong(ball.velocity[world]) or _is_wrong(ball.spin[world])
    if wrong or not (wp.abs(paddle_distance[world]) <= FINITE):
        diverged[world] = True
        clear_events(events, world)
        ball.position[world] = wp.vec3()
        ball.velocity[world] = wp.vec3()
        ball.spin[world] = wp.vec3()
        paddle_distance[world] = AWAY
    if diverged[world]:
        when[world] = step[0]
        wp.atomic_add(count, 0, 1.0)


class Divergence:
    """Sees and stops what diverges in N worlds; their owner then ends the episode and resets them.

    Attributes: ``diverged`` (N,) bool, in the last control step; ``when`` (N,) int32, number of the control step in
    which a world diverged last, from 1 on, 0 for never; ``step`` (1,) int32, control steps so far.

    Args: engine, ball, events: tensors that are corrected; distance: (N,) m, of ball and paddle; largest_speed: m/s and
    rad/s of the robot, 0 for no limit.
    """

    def __init__(
        self, engine: RobotEngine, ball: BallState, events: BallEvents, distance: Tensor, largest_speed: float
    ) -> None:
        count, device = len(distance), distance.device
        self.diverged = torch.zeros(count, dtype=torch.bool, device=device)
        self.when = torch.zeros(count, dtype=torch.int32, device=device)
        self.step = torch.zeros(1, dtype=torch.int32, device=device)
        self._count = torch.zeros(1, device=device)
        limit = largest_speed or FINITE
        robot = {"engine": engine, "table_force": engine.table_force, "largest": limit}
        self._stop_robots = Launch(_stop_robot, count, device, **robot, diverged=self.diverged)
        own = {"diverged": self.diverged, "when": self.when, "step": self.step, "count": self._count}
        self._stop_balls = Launch(_stop_ball, count, device, ball=ball, events=events, paddle_distance=distance, **own)

    def stop_robots(self) -> None:
        """After the engine has advanced, before anything reads its state."""
        self.step.add_(1)
        self._stop_robots()

    def stop_balls(self) -> None:
        """After the balls have flown."""
        self._stop_balls()

    def pop_count(self) -> Tensor:
        """How often worlds have diverged since the last call, 0-d."""
        popped = self._count[0].clone()
        self._count.zero_()
        return popped
