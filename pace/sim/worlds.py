"""N worlds of robot and ball: one control step of physics, resets by mask, and the state for a task."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import partial

import mujoco
import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import Bound, MaskedLaunch
from pace.arrays.state import Stateful, tensors_named, under_prefix, with_prefix
from pace.arrays.tensors import named_tensors
from pace.config.sim import SimConfig
from pace.devices import resolve_device
from pace.sim.actuation import Actuation
from pace.sim.ball.ball import BallParams, BallSim
from pace.sim.ball.state import BallArrays, BallState
from pace.sim.bodies import Bodies
from pace.sim.divergence import Divergence
from pace.sim.engine.factory import make_engine
from pace.sim.kinematics import Kinematics
from pace.sim.randomization import Randomizer, require_bodies
from pace.sim.replay import Recorder
from pace.sim.robot import build_model, nominal_pose
from pace.sim.robot_spec import RobotSpec
from pace.sim.robot_state import RobotArrays, RobotState


@wp.kernel
def _derive(
    mask: wp.array[wp.bool],
    qpos: wp.array3d[float],
    qvel: wp.array3d[float],
    last: int,
    inverse_dt: float,
    robot: RobotArrays,
):
    """Gravity in the body frame, heading on the ground and mean joint acceleration of one masked world."""
    world = wp.tid()
    if not mask[world]:
        return
    w = qpos[world, last, 3]
    x = qpos[world, last, 4]
    y = qpos[world, last, 5]
    z = qpos[world, last, 6]
    robot.projected_gravity[world] = wp.vec3(2.0 * (w * y - x * z), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0)
    forward = 1.0 - 2.0 * (y * y + z * z)
    left = 2.0 * (x * y + w * z)
    length = wp.max(wp.sqrt(forward * forward + left * left), 1.0e-6)
    robot.heading[world] = wp.vec2(forward / length, left / length)
    for joint in range(robot.joint_acceleration.shape[1]):
        change = qvel[world, last, 6 + joint] - qvel[world, 0, 6 + joint]
        robot.joint_acceleration[world, joint] = change * inverse_dt


@wp.kernel
def _forget_impulse(mask: wp.array[wp.bool], impulse: wp.array[wp.vec3]):
    """A robot that was just reset gets no impulse of the last ball."""
    world = wp.tid()
    if mask[world]:
        impulse[world] = wp.vec3()


@wp.kernel
def _launch_ball(mask: wp.array[wp.bool], start: BallArrays, ball: BallArrays):
    """Start a masked world's ball in a given state."""
    world = wp.tid()
    if mask[world]:
        ball.position[world] = start.position[world]
        ball.velocity[world] = start.velocity[world]
        ball.spin[world] = start.spin[world]


class Worlds(Stateful):
    """Robot and ball in N worlds. ``step`` is one control step; nothing in it waits for the host.

    Args:
        config: robot, ball, engine and randomisation.
        num_worlds: N.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:1``; ``auto`` takes the first GPU if there is one.
        generator: source of all random numbers, on the worlds' device; ``None`` makes one with seed 0.
        model: robot and scene; ``None`` builds them from ``config``.
    """

    def __init__(
        self,
        config: SimConfig,
        num_worlds: int,
        device: str | torch.device = "auto",
        generator: torch.Generator | None = None,
        model: mujoco.MjModel | None = None,
    ) -> None:
        self.config = config
        self.num_worlds = num_worlds
        self.device = resolve_device(device)
        self.control_dt = config.robot.control_dt
        self.spec = RobotSpec.of(config.robot)
        self.generator = generator or torch.Generator(self.device).manual_seed(0)
        self.model = model or build_model(config.robot, config.engine, config.ball.table)
        require_bodies(self.model, config.randomization)
        self.engine = make_engine(self.model, config.engine, num_worlds, self.device, config.substeps)
        self.kinematics = Kinematics(self.model, self.spec.tips, num_worlds, config.substeps, self.device)
        hand, steps = config.robot.paddle_hand, config.substeps
        self.bodies = Bodies(self.model, hand, num_worlds, steps, self.control_dt, self.device)
        self.ball = BallSim(
            num_worlds,
            self.device,
            BallParams.from_config(config.ball),
            config.ball.table,
            self.control_dt,
            config.substeps,
            config.engine.ball_dt,
            config.ball.air,
            self.bodies.surface,
        )
        self.randomizer = Randomizer(
            config.randomization,
            config.ball,
            self.engine.params,
            self.ball.params,
            self.generator,
            self.model.nv,
            self.control_dt,
            self.kinematics.mount,
        )
        self.engine.apply_params(torch.ones(num_worlds, dtype=torch.bool, device=self.device))
        flown = (self.ball, self.ball.events, self.ball.nearest_paddle_distance)
        self.divergence = Divergence(self.engine, *flown, config.engine.largest_speed)
        kept, joints = config.engine.remembered_steps, len(self.spec.joints)
        self.recorder = Recorder(self.engine, self.ball, joints, kept, self.divergence.step) if kept else None
        self._warned = False
        self._allocate()

    def _allocate(self) -> None:
        n, device = self.num_worlds, self.device
        self.nominal = torch.as_tensor(nominal_pose(self.config.robot), dtype=torch.float32, device=device)
        limits = torch.as_tensor(self.model.jnt_range[1:], dtype=torch.float32, device=device)
        self.joint_lower, self.joint_upper = limits[:, 0].contiguous(), limits[:, 1].contiguous()
        self.actuation = self._make_actuation()
        self._applied = torch.zeros(n, self.model.nv, device=device)
        self._reaction, self._reaction_point = torch.zeros(n, 3, device=device), torch.zeros(n, 3, device=device)
        self.robot = self._robot_state()
        self._record()

    def _make_actuation(self) -> Actuation:
        ranges, sampled = self.config.randomization, self.randomizer
        backlash = sampled.backlash if ranges.backlash[1] > 0 else None
        times = (self.config.engine.physics_dt, self.control_dt)
        longest = ranges.actuator_delay[1]
        return Actuation(sampled.actuator_delay, backlash, longest, self.nominal, self.engine.qpos_path, *times)

    def _record(self) -> None:
        n, device, qpos = self.num_worlds, self.device, self.engine.qpos_path
        path = {"qpos": qpos, "qvel": self.engine.qvel_path, "last": self.config.substeps}
        self._derive = MaskedLaunch(_derive, n, device, robot=self.robot, inverse_dt=1.0 / self.control_dt, **path)
        self._forget_impulse = MaskedLaunch(_forget_impulse, n, device, impulse=self.ball.events.paddle_impulse)
        self._pose_bodies = self.bodies.poser(qpos, self.kinematics.paddle_path, self.ball)
        self._serve = Bound(self._record_serve, position=(n, 3), velocity=(n, 3), spin=(n, 3))

    def _record_serve(self, position: Tensor, velocity: Tensor, spin: Tensor) -> MaskedLaunch:
        start = BallState(position, velocity, spin)
        return MaskedLaunch(_launch_ball, self.num_worlds, self.device, start=start, ball=self.ball)

    def _robot_state(self) -> RobotState:
        qpos, qvel = self.engine.qpos_path[:, -1], self.engine.qvel_path[:, -1]
        paddle = self.kinematics.paddle_path[:, -1]
        zeros = partial(torch.zeros, self.num_worlds, device=self.device)
        return RobotState(
            joint_position=qpos[:, 7:],
            joint_velocity=qvel[:, 6:],
            joint_acceleration=zeros(len(self.spec.joints)),
            joint_torque=self.engine.joint_torque,
            base_position=qpos[:, :3],
            base_quat=qpos[:, 3:7],
            base_linear_velocity=qvel[:, :3],
            base_angular_velocity=qvel[:, 3:6],
            projected_gravity=zeros(3),
            heading=zeros(2),
            paddle_position=paddle[:, :3],
            paddle_normal=paddle[:, 3:6],
            paddle_velocity=paddle[:, 6:9],
            foot_position=self.kinematics.foot_position,
            foot_velocity=self.kinematics.foot_velocity,
            foot_up=self.kinematics.foot_up,
            foot_force=self.engine.foot_force,
            body_contact=self.engine.body_contact,
            head_position=self.kinematics.head_position,
        )

    def step(self, targets: Tensor) -> None:
        """One control step towards joint targets (N, J) rad; ``robot``, ``ball`` and ``ball.events`` are new after it.

        Order: targets pass the actuator delay and the gears' play (:class:`pace.sim.actuation.Actuation`), pushes and
        the ball's last impulse on the paddle act, the robot moves, then the ball flies the same interval along the
        paths of paddle and body. Its impulse on the body does not act back. A robot or a ball whose numbers go wrong is
        stopped (:class:`pace.sim.divergence.Divergence`); its world is then to be reset.
        """
        if self.recorder is not None:
            self.recorder.remember(targets)
        delayed = self.actuation(targets)
        if self.randomizer.pushes_enabled:
            self.engine.add_velocity(self.randomizer.update_push())
        if self.config.engine.paddle_reaction:
            self._react()
        self.engine.advance(delayed, self._applied)
        self.divergence.stop_robots()
        self._observe()
        self._pose_bodies()
        self.ball.fly(self.kinematics.paddle_path)
        self.divergence.stop_balls()

    def _react(self) -> None:
        """Distribute the ball's last impulse on the paddle over the coming control step.

        A hit acts at the same point of the blade, which has moved since; a continuing contact (a ball that rests on the
        blade) acts at its last contact point, at the end of the step.
        """
        events = self.ball.events
        on_blade = self.robot.paddle_position + events.hit_offset + (events.hit_point - events.hit_position)
        struck = (events.paddle_hit > 0).unsqueeze(-1)
        torch.where(struck, on_blade, events.impulse_point, out=self._reaction_point)
        torch.div(events.paddle_impulse, self.control_dt, out=self._reaction)
        self.kinematics.paddle_generalized_force(self._reaction, self._reaction_point, self._applied)

    def _observe(self, mask: Tensor | None = None) -> None:
        """Derive ``robot`` from the engine's paths; ``mask`` (N,) bool: the worlds in which they are new."""
        self.kinematics.update(self.engine.qpos_path, self.engine.qvel_path, mask)
        self._derive(mask)

    def reset_robot(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the robots of ``mask`` (N,) bool into qpos (N, 7 + J), qvel (N, 6 + J); resample their parameters."""
        self.randomizer.sample(mask)
        self.actuation.sample()
        self.engine.apply_params(mask)
        self.engine.reset(mask, qpos, qvel)
        self._observe(mask)
        self.actuation.hold(mask)
        self._forget_impulse(mask)

    def serve(self, mask: Tensor, position: Tensor, velocity: Tensor, spin: Tensor) -> None:
        """Start the ball of the worlds of ``mask`` at position (N, 3) m, velocity (N, 3) m/s, spin (N, 3) rad/s.

        Give the same tensors each time: others are bound again, which takes longer.
        """
        self._serve(position, velocity, spin)(mask)

    def warn_of_overflow(self) -> None:
        """Warn, once, if a world ever had more contacts or constraints than the engine's memory holds: the engine has
        dropped the others. Waits for the device: call it once an update, not every step."""
        if self._warned or not self.engine.overflowed():
            return
        self._warned = True
        engine = self.config.engine
        warnings.warn(
            "a world had more contacts or constraints than there is room for; some were dropped, and its robot may "
            "have sunk into something. With engine=mjwarp raise engine.contacts_per_world "
            f"({engine.contacts_per_world}) and engine.constraints_per_world ({engine.constraints_per_world}).",
            RuntimeWarning,
            stacklevel=2,
        )

    def state_tensors(self) -> dict[str, Tensor]:
        """All that the next control step depends on, besides the random generator."""
        sampled = with_prefix("drawn", self.randomizer.state_tensors())
        return self._own_tensors() | sampled | with_prefix("engine", self.engine.state_tensors())

    def _own_tensors(self) -> dict[str, Tensor]:
        ball = tensors_named(self.ball, ("position", "velocity", "spin", "in_view"))
        events = with_prefix("event", named_tensors(self.ball.events))
        held = self.actuation.held
        older = {"older_targets": held[:, 1:]} if held.shape[1] > 1 else {}
        return ball | events | older | {"previous_targets": held[:, 0]}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Load the result of :meth:`state_dict`."""
        self.randomizer.load_state_dict(under_prefix("drawn", state))
        self.actuation.sample()
        everyone = torch.ones(self.num_worlds, dtype=torch.bool, device=self.device)
        self.engine.apply_params(everyone)
        self.engine.load_state_dict(under_prefix("engine", state))
        for name, tensor in self._own_tensors().items():
            tensor.copy_(state[name])
        self._observe()
