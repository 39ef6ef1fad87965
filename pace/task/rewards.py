"""Reward terms: small pure functions ``(state, params) -> Tensor (N,)`` in a table from name to function.

Weights and parameters live in ``configs/reward/``. :class:`RewardManager` checks names, parameters and shapes, and sums
``scale * weight * control_dt * value``; that holds for one-off terms too. A term may come from outside of the package
(:mod:`pace.config.plugins`): ``+reward.terms.mine={weight: 1.0, function: my_module:my_term}``, or an entry point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, cast

import torch
from torch import Tensor

from pace.arrays.state import Stateful
from pace.config.base import ConfigError
from pace.config.plugins import REWARD_TERMS, Registry
from pace.config.task import RewardConfig, RewardTerm
from pace.sim.ball.aero import GRAVITY
from pace.sim.ball.ball import BallParams
from pace.task.state import TaskState

Params = Mapping[str, float]
Term = Callable[[TaskState, Params], Tensor]


class RewardFunction(NamedTuple):
    """A term and the names of the parameters that it needs; ``None``: whichever the configuration gives it."""

    function: Term
    params: tuple[str, ...] | None


def _accept(found: object) -> RewardFunction:
    """What an import path or an entry point named: a function of :data:`TERMS`, any other, or a RewardFunction."""
    if isinstance(found, RewardFunction):
        return found
    if not callable(found):
        raise TypeError("a reward term is a function of (state, params)")
    entered = (entry for entry in TERMS.values() if entry.function is found)
    return next(entered, RewardFunction(cast(Term, found), None))


#: All terms by name.
TERMS: Registry[RewardFunction] = Registry("reward term", REWARD_TERMS, _accept, where="reward.terms.")


def term(*params: str) -> Callable[[Term], Term]:
    """Enter a function into :data:`TERMS` under its own name, which must be free."""

    def enter(function: Term) -> Term:
        TERMS.enter(function.__name__, RewardFunction(function, params))
        return function

    return enter


def _length(vector: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vector, dim=-1)


@cache
def _constant(numbers: tuple[float, ...], device: torch.device) -> Tensor:
    """Numbers on the device; made once, for a step must bring nothing there."""
    return torch.tensor(numbers, device=device)


def _kernel(error: Tensor, params: Params) -> Tensor:
    """exp(-max(error, tolerance) / sigma^2): flat near the goal."""
    return error.clamp(min=params["tolerance"]).mul_(-1.0 / params["sigma"] ** 2).exp_()


# --- towards the ball -------------------------------------------------------------------------------------------------


@term("tolerance", "sigma")
def paddle_to_target(state: TaskState, params: Params) -> Tensor:
    """Nearness of the paddle to its target while there is something to hit; distances in m."""
    return _kernel(state.measures["paddle_to_target"], params) * state.something_to_hit


@term("tolerance", "sigma")
def base_to_target(state: TaskState, params: Params) -> Tensor:
    """Nearness of the base to its target on the ground, m; the idle position while there is nothing to hit."""
    return _kernel(state.measures["base_to_target"], params)


@term("gain", "limit", "tolerance", "sigma")
def base_velocity(state: TaskState, params: Params) -> Tensor:
    """Match of the base's velocity with one proportional to the way left, m/s."""
    wanted = (params["gain"] * state.base_error).clamp(-params["limit"], params["limit"])
    return _kernel(_length(wanted - state.robot.base_linear_velocity[:, :2]), params)


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
    speed = _length(change)
    normal = change / speed.unsqueeze(-1)
    velocity = normal * paddle_speed(target.arriving, normal, speed, material).unsqueeze(-1)
    moves = (1.0 - _length(paddle.paddle_velocity - velocity) / params["reach"]).clamp_(min=0.0)
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
    return (1.0 - _length(error) / params["reach"]).clamp_(min=0.0) * state.game.referee.hit_now


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


# --- posture and motion of the base -----------------------------------------------------------------------------------


@term()
def base_vertical_velocity(state: TaskState, params: Params) -> Tensor:
    """Squared, (m/s)^2."""
    return state.measures["vertical_velocity"]


@term()
def base_roll_pitch_rate(state: TaskState, params: Params) -> Tensor:
    """Squared, (rad/s)^2."""
    return state.measures["roll_pitch_rate"]


@term()
def base_yaw_rate(state: TaskState, params: Params) -> Tensor:
    """Squared, (rad/s)^2."""
    return state.measures["yaw_rate"]


@term()
def base_tilt(state: TaskState, params: Params) -> Tensor:
    """Squared horizontal part of gravity in the body frame."""
    return state.measures["base_tilt"]


@term("x", "margin", "sigma")
def table_proximity(state: TaskState, params: Params) -> Tensor:
    """exp(-abs(base x - (x - margin)) / sigma^2): a wall of penalty before the table's edge at x, m."""
    distance = (state.robot.base_position[:, 0] - (params["x"] - params["margin"])).abs_()
    return distance.mul_(-1.0 / params["sigma"] ** 2).exp_()


@term()
def fall(state: TaskState, params: Params) -> Tensor:
    """The robot fell or left its area: the episode is lost."""
    return state.lost.float()


@term()
def undesired_contact(state: TaskState, params: Params) -> Tensor:
    """Number of bodies other than the feet that touch something."""
    return state.measures["contacts"]


@term("distance")
def paddle_near_head(state: TaskState, params: Params) -> Tensor:
    """How much nearer than ``distance`` the paddle is to the head, m."""
    return (params["distance"] - state.measures["paddle_to_head"]).clamp(min=0.0)


# --- joints -----------------------------------------------------------------------------------------------------------


@term()
def joint_power(state: TaskState, params: Params) -> Tensor:
    """Norm over the joints of torque times velocity, W."""
    return state.measures["joint_power"]


@term()
def ankle_power(state: TaskState, params: Params) -> Tensor:
    """The same over the ankles."""
    return state.measures["ankle_power"]


@term()
def joint_acceleration(state: TaskState, params: Params) -> Tensor:
    """Squared, summed over the joints, (rad/s^2)^2."""
    return state.measures["joint_acceleration"]


@term()
def action_rate(state: TaskState, params: Params) -> Tensor:
    """Squared change of the action, summed over the joints."""
    return state.measures["action_change"]


@term("fraction")
def joint_limits(state: TaskState, params: Params) -> Tensor:
    """How far joints are beyond the inner ``fraction`` of their range, summed, rad."""
    middle, reach = state.joint_range
    return (state.robot.joint_position - middle).abs_().sub_(reach, alpha=params["fraction"]).clamp_(min=0.0).sum(1)


@term()
def deviation_hip_waist_left_arm(state: TaskState, params: Params) -> Tensor:
    """Sum of |joint - nominal| over hip yaw and roll, waist and left arm without its shoulder roll, rad."""
    return state.measures["hip_waist_left_arm"]


@term()
def deviation_left_shoulder_roll(state: TaskState, params: Params) -> Tensor:
    """|joint - nominal|, rad."""
    return state.measures["left_shoulder_roll"]


@term()
def deviation_right_arm(state: TaskState, params: Params) -> Tensor:
    """Sum of |joint - nominal|, rad."""
    return state.measures["right_arm"]


# --- feet -------------------------------------------------------------------------------------------------------------


@term()
def both_feet_air(state: TaskState, params: Params) -> Tensor:
    """No foot touches the floor."""
    return (state.measures["feet_down"] == 0.0).float()


@term()
def foot_tilt(state: TaskState, params: Params) -> Tensor:
    """Squared horizontal part of the soles' normals, summed over the feet."""
    return state.measures["foot_tilt"]


@term()
def foot_slide(state: TaskState, params: Params) -> Tensor:
    """Horizontal speed of the feet in contact, summed, m/s."""
    return state.measures["foot_slide"]


@term("reach", "sigma")
def ready_stance(state: TaskState, params: Params) -> Tensor:
    """Still feet where there is nothing to hit and the base is within ``reach`` m of where it should stand.

    exp(-v / sigma), v the speeds of both feet summed, m/s: stepping on the spot earns less than standing.
    """
    ready = ~state.something_to_hit & (_length(state.base_error) < params["reach"])
    return torch.exp(_length(state.robot.foot_velocity).sum(1) * (-1.0 / params["sigma"])) * ready


@term("threshold", "limit")
def foot_force(state: TaskState, params: Params) -> Tensor:
    """Force of each foot beyond ``threshold``, at most ``limit``, summed over the feet, N."""
    return (state.foot_load - params["threshold"]).clamp(0.0, params["limit"]).sum(1)


@term("ratio")
def foot_stumble(state: TaskState, params: Params) -> Tensor:
    """A foot meets something upright: horizontal force above ``ratio`` times the vertical one."""
    return (state.measures["foot_steepness"] > params["ratio"]).float()


@term("distance")
def feet_near(state: TaskState, params: Params) -> Tensor:
    """How much nearer than ``distance`` the feet are to each other, m."""
    return (params["distance"] - state.feet_distance).clamp(min=0.0)


@term("distance")
def feet_too_near(state: TaskState, params: Params) -> Tensor:
    """The same, with a second threshold."""
    return feet_near(state, params)


@dataclass
class _Entry:
    name: str
    function: Term
    params: dict[str, float]


class RewardManager(Stateful):
    """Computes the reward of N worlds and keeps each term's sum. Without a term the reward is 0.

    Attributes: ``names`` of the T terms, ``values`` (T, N) unweighted, ``reward`` (N,) as the learner sees it,
    ``sums`` (T,) of the weighted terms over worlds and steps since the last :meth:`pop_sums`.

    Errors: :class:`ConfigError` for an unknown term, or a missing or unknown parameter.
    """

    STATE = ("_weights", "values", "reward", "sums")

    def __init__(self, config: RewardConfig, num_worlds: int, device: torch.device, control_dt: float) -> None:
        found = {name: find_term(name, entry) for name, entry in config.terms.items()}
        self._entries = [_Entry(name, function, config.terms[name].params) for name, function in found.items()]
        self.names = tuple(config.terms)
        weights = [entry.weight * control_dt * config.scale for entry in config.terms.values()]
        self._weights = torch.tensor(weights, dtype=torch.float32, device=device)
        self.values = torch.zeros(len(weights), num_worlds, device=device)
        self.reward = torch.zeros(num_worlds, device=device)
        self.sums = torch.zeros(len(weights), device=device)

    def compute(self, state: TaskState) -> None:
        """Evaluate all terms on ``state``. Errors: ``ValueError`` that names a term whose shape is not (N,)."""
        values = [entry.function(state, entry.params) for entry in self._entries]
        for entry, value in zip(self._entries, values, strict=True):
            if value.shape != self.reward.shape:
                wanted = tuple(self.reward.shape)
                raise ValueError(f"reward term '{entry.name}' has shape {tuple(value.shape)}, not {wanted}")
        if not values:
            return
        torch.stack(values, out=self.values)
        torch.mv(self.values.T, self._weights, out=self.reward)
        self.sums.addcmul_(self.values.sum(1), self._weights)

    def pop_sums(self) -> dict[str, Tensor]:
        """Sums of the weighted terms (0-d) since the last call; they add up to the sum of the rewards."""
        popped = dict(zip(self.names, self.sums.clone().unbind(), strict=True))
        self.sums.zero_()
        return popped


def find_term(name: str, entry: RewardTerm) -> Term:
    """Function of the term that the configuration calls ``name``: ``entry.function``, or the one of that name.

    Errors: :class:`ConfigError` for an unknown one, and unless ``entry.params`` are exactly its parameters.
    """
    try:
        function, needed = TERMS[entry.function or name]
    except ConfigError as error:
        raise ConfigError(f"reward.terms.{name}.function: {error}" if entry.function else str(error)) from error
    params = entry.params
    if needed is not None and set(needed) != set(params):
        missing, unknown = set(needed) - set(params), set(params) - set(needed)
        what = f"misses {sorted(missing)}" if missing else f"does not know {sorted(unknown)}"
        raise ConfigError(f"reward.terms.{name}.params {what}; it needs {list(needed)}")
    if not params.get("sigma", 1.0) > 0:
        raise ConfigError(f"reward.terms.{name}.params.sigma must be positive, got {params['sigma']}")
    return function
