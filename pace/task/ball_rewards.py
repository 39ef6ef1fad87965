"""Reward terms of the ball: the way to it, the hit, and where it goes."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallParams
from pace.task.reward_terms import Params, kernel, length, term
from pace.task.state import TaskState


@cache
def _constant(numbers: tuple[float, ...], device: torch.device) -> Tensor:
    """Numbers on the device; made once, for a step must bring nothing there."""
    return torch.tensor(numbers, device=device)


# --- towards the ball -------------------------------------------------------------------------------------------------


@term("tolerance", "sigma")
def paddle_to_target(state: TaskState, params: Params) -> Tensor:
    """Nearness of the paddle to its target while there is something to hit; distances in m."""
    return kernel(state.measures["paddle_to_target"], params) * state.something_to_hit


@term("tolerance", "sigma")
def base_to_target(state: TaskState, params: Params) -> Tensor:
    """Nearness of the base to its target on the ground, m; the idle position while there is nothing to hit."""
    return kernel(state.measures["base_to_target"], params)


@term("gain", "limit", "tolerance", "sigma")
def base_velocity(state: TaskState, params: Params) -> Tensor:
    """Match of the base's velocity with one proportional to the way left, m/s."""
    wanted = (params["gain"] * state.base_error).clamp(-params["limit"], params["limit"])
    return kernel(length(wanted - state.robot.base_linear_velocity[:, :2]), params)


@term("reach")
def contact(state: TaskState, params: Params) -> Tensor:
    """Growth of the best closeness max(0, (reach - d) / reach) of face centre and ball surface in this serve.

    Its sum over a serve is the best closeness, paid once.
    """
    closeness = state.game.closeness
    return _closeness(closeness.nearest, params) - _closeness(closeness.previous, params)


def _closeness(distance: Tensor, params: Params) -> Tensor:
    return (1.0 - distance / params["reach"]).clamp(min=0.0)


@term("sigma")
def arrival(state: TaskState, params: Params) -> Tensor:
    """Once a serve, when the ball is hit or reaches the target: exp(-d / sigma), d the smallest distance so far, m."""
    closeness = state.game.closeness
    return torch.exp(closeness.nearest * (-1.0 / params["sigma"])) * closeness.arrived_now


@term("x", "y", "z", "time", "reach", "sigma")
def swing(state: TaskState, params: Params) -> Tensor:
    """How well the paddle moves and faces, about the time of the hit: as if to return the forecast ball to (x, y, z).

    The ball arrives with its forecast velocity and should leave as :func:`return_velocity` asks. Without friction the
    impulse is along the paddle's normal, so the wanted normal lies along the ball's change of velocity, and the
    restitution of this world's paddle tells how fast the paddle has to go that way:
    max(0, 1 - e / reach) |n . n_wanted| exp(-((t - t_hit) / sigma)^2), e the error of the paddle's velocity, m/s.
    """
    target, paddle, material = state.game.target, state.robot, state.ball.params
    change = _good_return(target.point, params) - target.arriving
    speed = length(change)
    normal = change / speed.unsqueeze(-1)
    velocity = normal * paddle_speed(target.arriving, normal, speed, material).unsqueeze(-1)
    moves = (1.0 - length(paddle.paddle_velocity - velocity) / params["reach"]).clamp_(min=0.0)
    faces = (paddle.paddle_normal * normal).sum(1).abs_()
    early = (target.time - state.game.clock.time) / params["sigma"]
    return moves * faces * early.square_().neg_().exp_() * state.something_to_hit


def paddle_speed(arriving: Tensor, normal: Tensor, change: Tensor, material: BallParams) -> Tensor:
    """Speed (N,), m/s, that a paddle needs along its unit ``normal`` (N, 3) to change the velocity of a ball that is
    ``arriving`` (N, 3), m/s, by ``change`` (N,), m/s: the rebound of :mod:`pace.sim.ball.rebound`, inverted.

    They close at c with (1 + e(c)) c = change, where e(c) falls linearly with c, its floor left out.
    """
    lively = 1.0 + torch.as_tensor(material.paddle_restitution)
    root = (lively.square() - 4.0 * material.paddle_restitution_slope * change).clamp(min=0.0).sqrt()
    return 2.0 * change / (lively + root) + (arriving * normal).sum(1)


# --- after the hit ----------------------------------------------------------------------------------------------------


@term("offset")
def predicted_landing(state: TaskState, params: Params) -> Tensor:
    """Once, at the hit: offset minus the distance of the forecast landing to the task's ``landing_target``, m.

    0 without a landing.
    """
    (x, y), landing = state.game.landing_target, state.game.returns.landing
    paid = state.game.referee.hit_now & landing[:, 0].isfinite()
    distance = torch.hypot(landing[:, 0] - x, landing[:, 1] - y)
    return torch.where(paid, params["offset"] - distance, 0.0)


@term("z", "sigma")
def predicted_net_height(state: TaskState, params: Params) -> Tensor:
    """Once, at the hit: how near to z the ball will cross the net's plane towards the opponent, m."""
    height = state.game.returns.net_height
    paid = state.game.referee.hit_now & height.isfinite()
    error = (height - params["z"]).abs_()
    return torch.where(paid, error.mul_(-1.0 / params["sigma"]).exp_(), 0.0)


@term("x", "y", "z", "time", "reach")
def return_velocity(state: TaskState, params: Params) -> Tensor:
    """Once, at the hit: max(0, 1 - e / reach), e how far the ball's velocity, m/s, is from a good return's.

    That one would carry it from where it was hit to (x, y, z), m, in ``time`` s, without air. Between a ball that drops
    on the own half and one that clears the net lie those in the net, which have neither a landing nor a height there:
    this term leads across.
    """
    events = state.ball.events
    error = events.hit_velocity_out - _good_return(events.hit_position, params)
    return (1.0 - length(error) / params["reach"]).clamp_(min=0.0) * state.game.referee.hit_now


def _good_return(position: Tensor, params: Params) -> Tensor:
    """Velocity (N, 3), m/s, that takes a ball from ``position`` (N, 3), m, to (x, y, z) in ``time``, without air."""
    time, lifted = params["time"], params["z"] + 0.5 * GRAVITY * params["time"] ** 2
    aim = _constant((params["x"] / time, params["y"] / time, lifted / time), position.device)
    return torch.add(aim, position, alpha=-1.0 / time)


@term("at_hit")
def success(state: TaskState, params: Params) -> Tensor:
    """Valid return, once: when the ball lands on the opponent's half, or (at_hit) at the hit by its forecast."""
    if params["at_hit"]:
        return (state.game.referee.hit_now & state.game.returns.lands_opponent).float()
    return state.game.referee.success_now.float()


@term()
def unstable_hit(state: TaskState, params: Params) -> Tensor:
    """At the hit, without both feet down."""
    return (state.game.referee.hit_now & (state.measures["feet_down"] < 2.0)).float()
