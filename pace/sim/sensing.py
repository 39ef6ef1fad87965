"""The robot's sensors: delayed motion capture, noisy proprioception.

All of the actor's information about the world passes through :class:`Sensing`, which never returns a true value.
"""

from __future__ import annotations

import math

import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import Bound, MaskedLaunch
from pace.arrays.state import Stateful, with_prefix
from pace.config.sim import SensingConfig
from pace.sim.mocap import SEQUENCES, UNSEEN, Cameras, Mocap, cameras_of, drift
from pace.sim.robot_state import RobotArrays, RobotState

#: Columns of a motion-capture frame: base position 3, ball position 3, heading 2; 1 in a new ball's first frame; 1 if
#: the ball is in view.
FRAME_COLUMNS = 10
#: Of the newest frames with the base and with the ball: s since their capture; they arrived in this step.
STAMPS = ("base_age", "base_new", "ball_age", "ball_new")
BASE, BALL, HEADING, LAUNCHED, SEEN = wp.constant(0), wp.constant(3), wp.constant(6), wp.constant(8), wp.constant(9)


@wp.func
def _see(
    robot: RobotArrays,
    ball_position: wp.array[wp.vec3],
    line: wp.array2d[wp.float32],
    world: int,
    in_view: bool,
    new_ball: bool,
    new_world: bool,
):
    """Put a motion-capture frame into a world's delay line, newest first; a new world fills all of it."""
    if not new_world:
        for age in range(line.shape[0] - 1, 0, -1):
            for column in range(line.shape[1]):
                line[age, column] = line[age - 1, column]
    for i in range(3):
        line[0, BASE + i] = robot.base_position[world][i]
        line[0, BALL + i] = ball_position[world][i]
    for i in range(2):
        line[0, HEADING + i] = robot.heading[world][i]
    line[0, LAUNCHED] = wp.where(new_ball and not new_world, 1.0, 0.0)
    line[0, SEEN] = wp.where(in_view, 1.0, 0.0)
    if new_world:
        for age in range(1, line.shape[0]):
            for column in range(line.shape[1]):
                line[age, column] = line[0, column]


@wp.func
def _late(line: wp.array2d[wp.float32], delay: float, column: int) -> float:
    """A column ``delay`` control steps ago, linear between frames; between two balls it is that of the older one."""
    age = wp.min(int(delay), line.shape[0] - 2)
    share = delay - float(age)
    if column >= BALL and column < HEADING and line[age, LAUNCHED] > 0.0 and share > 0.0:
        share = 1.0
    return (1.0 - share) * line[age, column] + share * line[age + 1, column]


@wp.func
def _in_view(line: wp.array2d[wp.float32], delay: float) -> bool:
    """Whether the ball was in view ``delay`` control steps ago: in both frames."""
    age = wp.min(int(delay), line.shape[0] - 2)
    return line[age, SEEN] > 0.0 and (line[age + 1, SEEN] > 0.0 or delay == float(age))


@wp.kernel
def _sense(
    mask: wp.array[wp.bool],
    reset: int,
    seed: wp.array[wp.int32],
    robot: RobotArrays,
    ball_position: wp.array[wp.vec3],
    in_view: wp.array[wp.bool],
    control_dt: float,
    own_frames: int,
    nominal: wp.array[wp.float32],
    delay: wp.array[wp.float32],
    delays: wp.vec2,
    scale: wp.array[wp.float32],
    scales: wp.vec2,
    amplitude: wp.array[wp.float32],
    cameras: Cameras,
    slow: wp.array2d[wp.float32],
    line: wp.array3d[wp.float32],
    sensed: wp.array2d[wp.float32],
    base_age: wp.array[wp.float32],
    base_new: wp.array[wp.bool],
    ball_age: wp.array[wp.float32],
    ball_new: wp.array[wp.bool],
):
    """Sense one world. With ``reset`` the masked worlds only, as if they had stood still, with a new delay (control
    steps, from the range ``delays``) and a new scale of the noise; else the ball of the masked worlds is new, and the
    frame of this step may be lost. With ``own_frames`` 1, :mod:`pace.sim.mocap` writes what motion capture gives."""
    world = wp.tid()
    if reset == 1 and not mask[world]:
        return
    _see(robot, ball_position, line[world], world, in_view[world], mask[world], reset == 1)
    row = sensed[world]
    random = wp.rand_init(seed[world])
    if reset == 1:
        delay[world] = delays[0] + wp.randf(random) * (delays[1] - delays[0])
        scale[world] = scales[0] + wp.randf(random) * (scales[1] - scales[0])
    joints = nominal.shape[0]
    mocap = 6 + 2 * joints
    late, lost = wp.float32(delay[world]), bool(own_frames == 1)
    if reset == 0 and own_frames == 0:
        way = wp.rand_init(seed[world], SEQUENCES - 1)
        late += (cameras.jitter[0] + wp.randf(way) * (cameras.jitter[1] - cameras.jitter[0])) / control_dt
        lost = wp.randf(way) < cameras.lost or late * control_dt >= base_age[world] + control_dt  # that is no newer
    if cameras.slow > 0.0 and own_frames == 0:
        drift(cameras, slow[world], wp.where(reset == 1, 0.0, cameras.kept), seed[world], 0)
    seen = _in_view(line[world], late) and not lost
    for column in range(row.shape[0]):
        noise = scale[world] * amplitude[column] * (2.0 * wp.randf(random) - 1.0)
        ball = column >= mocap + BALL and column < mocap + HEADING
        captured = column >= mocap and column < mocap + LAUNCHED
        if captured and column < mocap + HEADING and (cameras.white > 0.0 or cameras.slow > 0.0):
            noise += scale[world] * (cameras.white * wp.randn(random) + slow[world, column - mocap])
        if not (captured and lost) and not (ball and not seen):
            row[column] = noise
    for i in range(3):
        row[i] += robot.base_angular_velocity[world][i]
        row[3 + i] += robot.projected_gravity[world][i]
    for joint in range(joints):
        row[6 + joint] += robot.joint_position[world, joint] - nominal[joint]
        row[6 + joints + joint] += robot.joint_velocity[world, joint]
    if own_frames == 1:
        return
    for column in range(LAUNCHED):
        ball = column >= BALL and column < HEADING
        if seen or (not ball and not lost):
            row[mocap + column] += _late(line[world], late, column)
        elif ball and reset == 1:
            row[mocap + column] = 0.0
    base_new[world] = not lost
    base_age[world] = wp.where(lost, base_age[world] + control_dt, late * control_dt)
    ball_new[world] = seen
    unseen_for = wp.where(reset == 1, UNSEEN, ball_age[world] + control_dt)
    ball_age[world] = wp.where(seen, late * control_dt, unseen_for)


class Sensing(Stateful):
    """Sensed signals of N worlds, overwritten in place once a control step.

    All signals have uniform noise, whose amplitudes have a common scale that is sampled per world at reset. Motion
    capture (base position, heading, ball) also has a delay that is sampled per world at reset, linearly interpolated
    between the control steps around it. A new ball is sensed once the delay has passed since its launch, the old one
    until then; nothing tells them apart. An episode begins as if its ball had been where it is for long. A ball that is
    out of view then is sensed at the origin, in a frame that is ``UNSEEN`` s old, until the first frame shows it.
    The frame of a control step may be lost, have a delay of its own, and slowly changing noise (``config.mocap``). With
    ``config.mocap.rate`` motion capture has frames of its own instead (:class:`pace.sim.mocap.Mocap`). Either way both
    signals keep the newest frame that has arrived.

    Attributes: ``base_angular_velocity`` (N, 3) rad/s body frame, ``projected_gravity`` (N, 3), ``joint_position``
    (N, J) rad from the nominal pose, ``joint_velocity`` (N, J) rad/s, ``base_position`` (N, 3) m,
    ``ball_position`` (N, 3) m, ``heading`` (N, 2), ``base_shift_noise`` (N, 2) m for quantities computed from sensed
    values; ``base_age`` (N,) s since the frame of base position and heading was captured, ``ball_age`` (N,) s since
    that of the ball was, ``base_new`` and ``ball_new`` (N,) bool, that frame arrived in this step; world frame unless
    stated.
    """

    STATE = ("_nominal", "_amplitude", "_sensed", "_line", "_delay", "_scale", "_slow", *STAMPS)

    def __init__(
        self,
        config: SensingConfig,
        num_worlds: int,
        device: torch.device,
        control_dt: float,
        nominal: Tensor,
        generator: torch.Generator,
    ) -> None:
        self._delays = [bound / control_dt for bound in config.mocap_delay]  # least and most, in control steps
        self._scales = config.noise_scale
        self._num_worlds, self._device, self._generator = num_worlds, device, generator
        self._nominal = nominal
        joints = nominal.shape[0]
        sizes = {
            "base_angular_velocity": 3,
            "projected_gravity": 3,
            "joint_position": joints,
            "joint_velocity": joints,
            "base_position": 3,
            "ball_position": 3,
            "heading": 2,
            "base_shift": 2,
        }
        amplitudes = [torch.full((size,), getattr(config, name)) for name, size in sizes.items()]
        self._amplitude = torch.cat(amplitudes).to(device)
        self._sensed = torch.zeros(num_worlds, self._amplitude.shape[0], device=device)
        views = torch.split(self._sensed, list(sizes.values()), dim=1)
        self.base_angular_velocity, self.projected_gravity, self.joint_position, self.joint_velocity = views[:4]
        self.base_position, self.ball_position, self.heading, self.base_shift_noise = views[4:]
        self.base_age, self.ball_age = torch.zeros(2, num_worlds, device=device)
        self.base_new = torch.ones(num_worlds, dtype=torch.bool, device=device)
        self.ball_new = torch.ones(num_worlds, dtype=torch.bool, device=device)
        frames = max(2, math.ceil(self._delays[1] + config.mocap.jitter[1] / control_dt) + 1)
        self._line = torch.zeros(num_worlds, frames, FRAME_COLUMNS, device=device)
        self._delay = torch.zeros(num_worlds, device=device)  # in control steps
        self._scale = torch.ones(num_worlds, device=device)
        self._seed = torch.zeros(num_worlds, dtype=torch.int32, device=device)
        self._slow = torch.zeros(num_worlds, HEADING, device=device)  # m, noise of base and ball
        self._cameras = cameras_of(config.mocap, control_dt)
        self._always = torch.ones(num_worlds, dtype=torch.bool, device=device)  # in view
        self._control_dt = control_dt
        self._mocap = self._make_mocap(config, 6 + 2 * joints) if config.mocap.rate > 0 else None
        self._bound = Bound(self._record, robot=None, ball_position=(num_worlds, 3), in_view=(num_worlds,))

    def _make_mocap(self, config: SensingConfig, first: int) -> Mocap:
        """Motion capture with frames of its own, which writes the columns from ``first`` on."""
        columns = slice(first, first + LAUNCHED)
        own = (self._amplitude[columns], self._sensed[:, columns])
        stamps = {name: getattr(self, name) for name in STAMPS}
        return Mocap(config, self._control_dt, self._delay, self._scale, *own, stamps)

    def state_tensors(self) -> dict[str, Tensor]:
        """See :class:`pace.arrays.state.Stateful`; those of motion capture where it has frames of its own."""
        own = super().state_tensors()
        return own if self._mocap is None else own | with_prefix("mocap", self._mocap.state_tensors())

    @property
    def delay(self) -> Tensor:
        """(N,) control steps, delay of motion capture in each world."""
        return self._delay

    def update(self, robot: RobotState, ball_position: Tensor, launched: Tensor, in_view: Tensor | None = None) -> None:
        """Sense the state after a control step. ``launched`` (N,) bool: a new ball took the old one's place at its end,
        so that no position between the two is sensed; the robot is not told. ``in_view`` (N,) bool: the cameras see
        the ball, else no frame holds it; ``None``: always. Give the same tensors each time, also to :meth:`reset`."""
        self._seed.random_(generator=self._generator)
        for launch in self._bound(robot, ball_position, self._always if in_view is None else in_view)[0]:
            launch(launched)

    def reset(self, mask: Tensor, robot: RobotState, ball_position: Tensor, in_view: Tensor | None = None) -> None:
        """Sample new delays for the worlds of ``mask`` (N,) bool and sense them as if they had stood still so far."""
        self._seed.random_(generator=self._generator)
        for launch in self._bound(robot, ball_position, self._always if in_view is None else in_view)[1]:
            launch(mask)

    def _record(
        self, robot: RobotState, ball_position: Tensor, in_view: Tensor
    ) -> tuple[list[MaskedLaunch], list[MaskedLaunch]]:
        """The launches of an update, and those of a reset."""
        sampled = {"seed": self._seed, "delays": self._delays, "scales": self._scales, "amplitude": self._amplitude}
        truth = {"robot": robot, "ball_position": ball_position, "in_view": in_view, "nominal": self._nominal}
        truth |= {"control_dt": self._control_dt, "own_frames": int(self._mocap is not None)}
        kept: dict[str, object] = {name: getattr(self, name) for name in STAMPS}
        kept |= {"cameras": self._cameras, "slow": self._slow}
        kept |= {"delay": self._delay, "scale": self._scale, "line": self._line, "sensed": self._sensed}
        given = sampled | truth | kept
        launches = [[MaskedLaunch(_sense, self._num_worlds, self._device, reset=reset, **given)] for reset in (0, 1)]
        if self._mocap is not None:
            film = self._mocap.record(robot, ball_position, in_view, self._seed)
            launches = [[*before, after] for before, after in zip(launches, film, strict=True)]
        return launches[0], launches[1]
