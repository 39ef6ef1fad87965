"""Table tennis in N worlds, in place: one control step, resets, faults, statistics and state."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from pace.arrays.graph import CapturedCall, Graphs, graphs_of, may_look
from pace.arrays.state import Stateful, tensors_named, under_prefix, with_prefix
from pace.config.task import TaskConfig
from pace.onboard.actor import Predictor
from pace.onboard.kinematics import PaddleChain
from pace.sim.ball.state import BallState
from pace.sim.replay import WorldReplay
from pace.sim.sensing import Sensing
from pace.sim.worlds import Worlds
from pace.task.faults import Faults
from pace.task.game import Game
from pace.task.history import History
from pace.task.observations import CRITIC, POLICY, layout
from pace.task.pauses import Pauses
from pace.task.resets import HeadStart, PoseSampler, ServeSampler
from pace.task.rewards import RewardManager
from pace.task.signals import ActorSignals
from pace.task.state import TaskState
from pace.task.statistics import Statistics

#: The environment's own part of its state; the rest belongs to its parts.
OWN_TENSORS = ("predictor_target", "predictor_time_to_apex", "predictor_valid")


class TableTennis:
    """A humanoid that returns serves in N worlds. The constructor resets all worlds.

    Attributes, overwritten in place: ``policy_observation`` (N, Dp), ``critic_observation`` (N, Dc), ``reward``,
    ``terminated``, ``truncated`` (N,); for the predictor's regression ``predictor_input`` (N, 3 * frames) m sensed,
    oldest first, ``predictor_target`` (N, P) truth in the order of ``predictor.outputs`` (times from now, s),
    ``predictor_valid`` (N,) bool (there is something to hit, and the robot sees it), ``predictor_time_to_apex`` (N,) s;
    for evaluation ``serve_over`` (N,) bool, ``serve_outcome`` (N,) int (:class:`pace.task.game.Outcome`) and
    ``serve_hit`` (N,) bool of the serves that ended in this step. ``warmup_serves``: so many first serves of each world
    are left out of the statistics.

    On a GPU a step and a reset are a CUDA graph each (:class:`pace.arrays.graph.CapturedCall`; ``engine.graph``): the
    configuration and the predictor's tensors are those of the second step, and are changed in place or not at all.
    ``graphs`` says how a caller may capture them together with what surrounds them, ``generator`` is their source of
    random numbers.

    A task whose reward has no terms (:func:`pace.config.overrides.without_reward`) pays 0.

    Args: see :class:`pace.task.env.TableTennisEnv`.
    """

    def __init__(self, config: TaskConfig, worlds: Worlds, seed: int, predictor: Predictor | None) -> None:
        self.config, self.num_worlds, self.worlds = config, worlds.num_worlds, worlds
        self.generator = worlds.generator
        self.generator.manual_seed(seed)
        self._build(predictor)
        self._allocate()
        self._capture()
        self.reset_worlds(self._everyone)

    def _build(self, predictor: Predictor | None) -> None:
        config, worlds, device = self.config, self.worlds, self.worlds.device
        reward = config.reward
        self._serves = self._make_serves()
        late = config.serve.head_start[1] > 0
        self._head_start = HeadStart(config.serve, worlds.ball, self.generator) if late else None
        limits = (worlds.joint_lower, worlds.joint_upper)
        self._poses = PoseSampler(config.reset, config.robot, self.num_worlds, worlds.nominal, limits, self.generator)
        self.game = Game(config, worlds.ball, worlds.robot.base_position, worlds.engine.table_force)
        given = (self.game, worlds.ball, self._serves.launch[0], worlds.control_dt, self.generator)
        self._pauses = Pauses(config.serve, *given) if config.serve.has_pauses else None
        self.sensing = Sensing(
            config.sensing, self.num_worlds, device, worlds.control_dt, worlds.nominal, self.generator
        )
        self.task_state = TaskState(worlds, self.game, self.sensing.delay)
        ball, events = worlds.ball, worlds.ball.events
        struck = BallState(events.hit_position, events.hit_velocity_out, events.hit_spin_out)
        self._forecast_return = ball.forecaster(struck, reward.target_x)
        self._forecast_serve = ball.forecaster(ball, reward.target_x)
        self.rewards = RewardManager(reward, self.num_worlds, device, worlds.control_dt)
        paddle = PaddleChain(worlds.model, worlds.spec.paddle)
        self.actor = ActorSignals(config, self.sensing, self.task_state.action, paddle, predictor)

    def _make_serves(self) -> ServeSampler:
        return ServeSampler(self.config.serve, self.worlds.ball, self.generator)

    def _allocate(self) -> None:
        names, count, device = self.config.observation, self.num_worlds, self.worlds.device
        joints = len(self.worlds.spec.joints)
        self.policy_layout, self.critic_layout = (
            layout(names.policy, POLICY, joints),
            layout(names.critic, CRITIC, joints),
        )
        policy = [partial(POLICY[name].function, self.actor) for name in names.policy]
        critic = [partial(CRITIC[name].function, self.task_state) for name in names.critic]
        self._policy_history = History(names.policy_history, policy)
        self._critic_history = History(names.critic_history, critic)
        self.policy_observation = self._policy_history.observation
        self.critic_observation = self._critic_history.observation
        self.reward = self.rewards.reward
        self.predictor_input = self.actor.track.positions
        self.predictor_target = torch.zeros_like(self.actor.prediction)
        self.predictor_valid = torch.zeros(count, dtype=torch.bool, device=device)
        self.predictor_time_to_apex = torch.zeros(count, device=device)
        self._everyone = torch.ones(count, dtype=torch.bool, device=device)
        ends = self.game.ends
        self.terminated, self.truncated = ends.lost, ends.truncated
        self.serve_over, self.serve_outcome, self.serve_hit = ends.over, ends.outcome, ends.hit
        histories = ((self._policy_history, self.policy_layout), (self._critic_history, self.critic_layout))
        self.faults = Faults(self.worlds, self.game, self.rewards, histories)
        self.first_counted_serve, self._warmup_serves = torch.zeros((), device=device), 0
        self.statistics = Statistics(self.game, self.first_counted_serve)

    def _capture(self) -> None:
        device = self.worlds.device
        self.graphs = graphs_of(self.config.engine, device)
        self._step_in_place = CapturedCall(self._advance, device, self.graphs, self.generator)
        self._reset_in_place = CapturedCall(self._begin_episodes, device, self.graphs, self.generator)

    @property
    def warmup_serves(self) -> int:
        """So many first serves of each world are left out of the statistics."""
        return self._warmup_serves

    @warmup_serves.setter
    def warmup_serves(self, count: int) -> None:
        self._warmup_serves = count
        self.first_counted_serve.fill_(count)

    @torch.no_grad()
    def advance(self, action: Tensor) -> None:
        """One control step with ``action`` (N, J), clipped to +- ``robot.action_clip``.

        Order: (1) the action becomes joint targets; robot and ball move through the step, with the action's and the
        sensors' delays inside it. (2) The referee consumes the ball's events in the order of their times; balls that
        were hit get a forecast of their flight. (3) Falls and the ends of serves are seen, and serves that end are
        decided. (4) Rewards, on that state. (5) Where a serve is over and the robot stands, the next serve begins, at
        once or after a pause (``serve.pause``); also where the episode is truncated, so that its last observation, from
        which the value is bootstrapped, is what would have come next. (6) Sensors, predictor, observations. Nothing is
        reset here: the observations of worlds that are done are their last ones, until :meth:`reset_worlds`.
        """
        self._step_in_place(action)

    def _advance(self, action: Tensor) -> None:
        self._move(action)
        self._judge()
        self.task_state.refresh()
        self.rewards.compute(self.task_state)
        next_serve = self.game.ends.next_serve
        self.statistics.add()
        self.game.count_serves()
        self._serves.sample(next_serve)
        if self._pauses is not None:
            self._pauses.step()
        self._start_serves(next_serve, next_serve)
        robot, ball = self.worlds.robot, self.worlds.ball
        self.sensing.update(robot, ball.position, next_serve, ball.in_view)
        self.actor.step()
        self._compute_truth()
        self._policy_history.push()
        self._critic_history.push()
        self.faults.flag()

    @torch.no_grad()
    def reset_worlds(self, mask: Tensor) -> None:
        """Begin new episodes in the worlds of ``mask`` (N,) bool and refresh their observations; others keep theirs.

        On a CPU, where looking costs no wait, an empty mask returns at once.
        """
        if self.graphs is Graphs.NONE and may_look(mask) and not bool(mask.any()):
            return
        self._reset_in_place(mask)

    def _begin_episodes(self, mask: Tensor) -> None:
        qpos, qvel = self._poses.sample(mask)
        self.worlds.reset_robot(mask, qpos, qvel)
        self.game.start_episode(mask, self.generator)
        self._serves.sample(mask)
        launched = mask if self._pauses is None else self._pauses.begin(mask)
        self._start_serves(mask, launched, self._head_start)
        for action in (self.task_state.action, self.task_state.previous_action):
            action.masked_fill_(mask.unsqueeze(-1), 0.0)
        robot, ball = self.worlds.robot, self.worlds.ball
        self.sensing.reset(mask, robot, ball.position, ball.in_view)
        self.actor.begin(mask)
        self._compute_truth()
        self._policy_history.fill(mask)
        self._critic_history.fill(mask)

    def _move(self, action: Tensor) -> None:
        robot, state = self.config.robot, self.task_state
        state.previous_action.copy_(state.action)
        torch.clamp(action, -robot.action_clip, robot.action_clip, out=state.action)
        self.worlds.step(torch.add(self.worlds.nominal, state.action, alpha=robot.action_scale))
        if self._pauses is not None:
            self._pauses.carry()

    def _judge(self) -> None:
        """Referee, forecast of the returns, ends of serves and episodes."""
        self.game.judge()
        self._forecast_return(self.game.referee.hit_now)
        self.game.close()
        self.faults.lose_diverged()

    def _start_serves(self, mask: Tensor, launched: Tensor, head_start: HeadStart | None = None) -> None:
        """Launch the sampled serves of ``launched`` (N,) bool. The others of ``mask`` wait: their ball, which is not
        in play, is a bad serve until then."""
        self.worlds.serve(launched, *self._serves.launch)
        if head_start is not None:
            head_start.give(launched)
        self._forecast_serve(mask)
        self.game.start_serve(mask)

    def _compute_truth(self) -> None:
        """What the critic sees and the predictor is taught, from the current state."""
        self.task_state.derive()
        target, now = self.game.target, self.game.clock.time
        torch.sub(target.apex_time, now, out=self.predictor_time_to_apex)
        # while the robot still sees the last ball, there is nothing that the new one's apex could be predicted from
        torch.ge(now, self.sensing.ball_age, out=self.predictor_valid)
        self.predictor_valid.logical_and_(target.something_to_hit).logical_and_(self.actor.track.something_to_hit)
        truth = {"apex": target.apex, "target": target.point, "target_time": (target.time - now).unsqueeze(-1)}
        torch.cat([truth[name] for name in self.config.predictor.outputs], dim=1, out=self.predictor_target)

    # --- faults, statistics, state ------------------------------------------------------------------------------------

    def replays(self) -> list[WorldReplay]:
        """See :meth:`pace.task.faults.Faults.replays`."""
        return self.faults.replays()

    def warn_of_overflow(self) -> None:
        """See :meth:`pace.sim.worlds.Worlds.warn_of_overflow`."""
        self.worlds.warn_of_overflow()

    def first_bad(self) -> str | None:
        """See :meth:`pace.task.faults.Faults.first`."""
        return self.faults.first()

    def pop_statistics(self) -> dict[str, Tensor]:
        """Sums over worlds and steps since the last call, 0-d tensors: see :class:`pace.task.statistics.Statistics`;
        ``diverged`` worlds, which were reset because their numbers went wrong; ``reward_sum`` and ``reward/<term>`` as
        the learner sees them."""
        terms = self.rewards.pop_sums()
        sums = self.statistics.pop() | {"diverged": self.worlds.divergence.pop_count()}
        sums["reward_sum"] = torch.stack(list(terms.values())).sum() if terms else torch.zeros_like(self.reward[0])
        return sums | {f"reward/{name}": value for name, value in terms.items()}

    def _parts(self) -> dict[str, Stateful]:
        return {
            "worlds": self.worlds,
            "game": self.game,
            "serves": self._serves,
            "state": self.task_state,
            "sensing": self.sensing,
            "policy": self._policy_history,
            "critic": self._critic_history,
            "rewards": self.rewards,
            "statistics": self.statistics,
        }

    def _own_state(self) -> dict[str, Tensor]:
        """Of the environment itself, and what the robot computes on board, whose names the estimates give."""
        own = tensors_named(self, OWN_TENSORS) | {"_bad": self.faults.bad}
        return with_prefix("env", own) | self.actor.computed()

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:  # type: ignore[override]
        """Everything that the next step depends on, as copies: tensors by name, and ``generator``.

        The predictor's weights are not part of it: they belong to whoever made it.
        """
        state = {name: tensor.clone() for name, tensor in self._own_state().items()}
        for name, part in self._parts().items():
            state |= with_prefix(name, part.state_dict())
        return state | {"generator": self.generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any], *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        """Put back what :meth:`state_dict` returned; the next step is then the same, bit for bit (but for MuJoCo
        Warp on a GPU).

        Errors: ``KeyError`` for a missing tensor, ``RuntimeError`` for another shape (number of worlds, layout).
        """
        for name, part in self._parts().items():
            part.load_state_dict(under_prefix(name, state_dict))
        for name, tensor in self._own_state().items():
            tensor.copy_(state_dict[name])
        self.generator.set_state(state_dict["generator"].cpu())
