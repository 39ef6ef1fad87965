"""Frames of a motion-capture system with a rate of its own: captured, delayed each by its own time, lost or hidden."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import warp as wp
from torch import Tensor

from pace.arrays.launch import MaskedLaunch
from pace.arrays.state import Stateful
from pace.config.sim import MocapConfig, SensingConfig
from pace.sim.robot_state import RobotArrays, RobotState

#: Values of a frame, and of the truth between which a camera sees it: base 3, ball 3, heading 2; truth: paddle 3 too.
VALUES, TRUTH = wp.constant(8), wp.constant(11)
#: Columns of a frame on its way, after its values: age and time until it arrives, s; 1 if the ball is in it.
AGE, WAIT, BALL_SEEN = wp.constant(8), wp.constant(9), wp.constant(10)
FRAME_COLUMNS = 11
#: Random sequences of a frame: one a column of its values, one a column of its slow noise, one for its way.
SEQUENCES = wp.constant(16)
#: s; a frame that never arrives, and one that is older than all.
NEVER = wp.constant(1.0e9)
#: s, age of the ball's frame at the start of an episode with the ball out of view: there is none.
UNSEEN = wp.constant(1.0e3)


@wp.struct
class Cameras:
    """The numbers of :class:`pace.config.sim.MocapConfig`, per frame: s, m, 1; and the control step, s."""

    control_dt: float
    period: float
    white: float
    slow: float
    kept: float  # share of the slow noise that the next frame keeps
    lost: float
    gap_chance: float  # that a run of lost frames begins with a frame
    gap: wp.vec2
    jitter: wp.vec2
    occlusion: float


@wp.struct
class Film:
    """The state of N worlds' cameras, and what their owner sampled for them: see :class:`Mocap`."""

    delay: wp.array[wp.float32]  # control steps
    scale: wp.array[wp.float32]  # of the noise
    amplitude: wp.array[wp.float32]  # m, 1: of the uniform noise, one a column of the values
    truth: wp.array3d[wp.float32]  # now and one control step ago
    slow: wp.array2d[wp.float32]  # m
    ring: wp.array3d[wp.float32]  # frames on their way
    phase: wp.array[wp.float32]  # s since the last frame
    gap: wp.array[wp.float32]  # s left of a run of lost frames
    base_age: wp.array[wp.float32]  # s
    base_new: wp.array[wp.bool]
    ball_age: wp.array[wp.float32]  # s
    ball_new: wp.array[wp.bool]
    sensed: wp.array2d[wp.float32]


@wp.func
def _truth(robot: RobotArrays, ball_position: wp.array[wp.vec3], world: int, column: int) -> float:
    """A column of the truth now."""
    if column < 3:
        return robot.base_position[world][column]
    if column < 6:
        return ball_position[world][column - 3]
    if column < VALUES:
        return robot.heading[world][column - 6]
    return robot.paddle_position[world][column - VALUES]


@wp.func
def _noise(
    cameras: Cameras, amplitude: wp.array[wp.float32], slow: wp.array[wp.float32], column: int, seed: int, number: int
) -> float:
    """Error of a column at a noise scale of 1: uniform, and for positions white and slow noise besides.

    A frame's number and a column have their own random sequence: Warp hands a generator to a function as a copy."""
    random = wp.rand_init(seed, SEQUENCES * number + column)
    error = amplitude[column] * (2.0 * wp.randf(random) - 1.0)
    if column < 6:
        error += cameras.white * wp.randn(random) + slow[column]
    return error


@wp.func
def _capture(
    cameras: Cameras,
    truth: wp.array2d[wp.float32],
    share: float,
    launched: bool,
    scale: float,
    amplitude: wp.array[wp.float32],
    slow: wp.array[wp.float32],
    frame: wp.array[wp.float32],
    seed: int,
    number: int,
):
    """The values of a frame at a share of the way between two control steps, and whether the ball is in it.

    Until a ball is launched, at the end of a step, the old one is where it was at the step's beginning."""
    square = wp.float32(0.0)
    for column in range(VALUES):
        value = (1.0 - share) * truth[1, column] + share * truth[0, column]
        if column >= 3 and column < 6:
            if launched and share < 1.0:
                value = truth[1, column]
            paddle = (1.0 - share) * truth[1, column + 5] + share * truth[0, column + 5]
            square += (value - paddle) * (value - paddle)
        frame[column] = value + scale * _noise(cameras, amplitude, slow, column, seed, number)
    frame[BALL_SEEN] = wp.where(square < cameras.occlusion * cameras.occlusion, 0.0, 1.0)


@wp.func
def drift(cameras: Cameras, slow: wp.array[wp.float32], kept: float, seed: int, number: int):
    """The slow noise one frame later; with ``kept`` 0 from scratch."""
    for column in range(6):
        random = wp.rand_init(seed, SEQUENCES * number + VALUES + column)
        slow[column] = kept * slow[column] + wp.sqrt(1.0 - kept * kept) * cameras.slow * wp.randn(random)


@wp.func
def _send(
    cameras: Cameras, frame: wp.array[wp.float32], gap: float, delay: float, age: float, seed: int, number: int
) -> float:
    """Send a frame of this age, s, which arrives ``delay`` s and its own jitter after its capture, or is lost; the time
    left, s, of the run of lost frames."""
    random = wp.rand_init(seed, SEQUENCES * number + SEQUENCES - 1)
    jitter = cameras.jitter[0] + wp.randf(random) * (cameras.jitter[1] - cameras.jitter[0])
    lost = wp.randf(random) < cameras.lost
    if gap <= 0.0 and wp.randf(random) < cameras.gap_chance:
        gap = cameras.gap[0] + wp.randf(random) * (cameras.gap[1] - cameras.gap[0])
    frame[AGE] = age
    frame[WAIT] = wp.where(lost or gap > 0.0, NEVER, delay + jitter - age)
    return gap - cameras.period


@wp.func
def _oldest(ring: wp.array2d[wp.float32]) -> int:
    """The slot of the oldest frame."""
    found = wp.int32(0)
    for slot in range(1, ring.shape[0]):
        if ring[slot, AGE] > ring[found, AGE]:
            found = slot
    return found


@wp.func
def _deliver(ring: wp.array2d[wp.float32], ball: bool, age: float, row: wp.array[wp.float32]) -> float:
    """Put the newest frame that has arrived into the row, if it is newer than ``age`` s; the age of what the row holds.
    Either its ball, if the ball is in it, or all but the ball."""
    newest = wp.int32(-1)
    for slot in range(ring.shape[0]):
        usable = ring[slot, WAIT] <= 0.0 and (ring[slot, BALL_SEEN] > 0.0 or not ball)
        if usable and ring[slot, AGE] < age:
            age = ring[slot, AGE]
            newest = slot
    if newest >= 0:
        for column in range(VALUES):
            if ball == (column >= 3 and column < 6):
                row[column] = ring[newest, column]
    return age


@wp.kernel
def _begin(
    mask: wp.array[wp.bool],
    seed: wp.array[wp.int32],
    cameras: Cameras,
    robot: RobotArrays,
    ball_position: wp.array[wp.vec3],
    in_view: wp.array[wp.bool],
    film: Film,
):
    """The masked worlds' robots know where they stand, from a frame that is as old as their delay; no other is sent."""
    world = wp.tid()
    if not mask[world]:
        return
    drift(cameras, film.slow[world], 0.0, seed[world], 0)
    for column in range(TRUTH):
        film.truth[world, 0, column] = _truth(robot, ball_position, world, column)
    for slot in range(film.ring.shape[1]):
        film.ring[world, slot, AGE] = NEVER
        film.ring[world, slot, WAIT] = NEVER
    for column in range(VALUES):
        error = _noise(cameras, film.amplitude, film.slow[world], column, seed[world], 0)
        film.sensed[world, column] = film.truth[world, 0, column] + film.scale[world] * error
        if column >= 3 and column < 6 and not in_view[world]:
            film.sensed[world, column] = 0.0
    film.phase[world] = cameras.period * wp.randf(wp.rand_init(seed[world], SEQUENCES - 1))
    film.gap[world] = 0.0
    film.base_age[world] = film.delay[world] * cameras.control_dt
    film.base_new[world] = True
    film.ball_age[world] = wp.where(in_view[world], film.delay[world] * cameras.control_dt, UNSEEN)
    film.ball_new[world] = in_view[world]


@wp.kernel
def _advance(
    mask: wp.array[wp.bool],
    seed: wp.array[wp.int32],
    cameras: Cameras,
    robot: RobotArrays,
    ball_position: wp.array[wp.vec3],
    in_view: wp.array[wp.bool],
    film: Film,
):
    """One control step of the cameras; in the worlds of the mask it ended with a launch."""
    world = wp.tid()
    control_dt = cameras.control_dt
    for column in range(TRUTH):
        film.truth[world, 1, column] = film.truth[world, 0, column]
        film.truth[world, 0, column] = _truth(robot, ball_position, world, column)
    ring, slow, truth = film.ring[world], film.slow[world], film.truth[world]
    for slot in range(ring.shape[0]):
        ring[slot, AGE] = ring[slot, AGE] + control_dt
        ring[slot, WAIT] = ring[slot, WAIT] - control_dt
    late, number = film.delay[world] * control_dt, wp.int32(0)
    time = cameras.period - film.phase[world]  # of the next frame, from the step's beginning
    while time <= control_dt:
        number += 1
        frame = ring[_oldest(ring)]
        drift(cameras, slow, cameras.kept, seed[world], number)
        share = time / control_dt
        noise = film.scale[world]
        _capture(cameras, truth, share, mask[world], noise, film.amplitude, slow, frame, seed[world], number)
        if not in_view[world]:
            frame[BALL_SEEN] = 0.0
        film.gap[world] = _send(cameras, frame, film.gap[world], late, control_dt - time, seed[world], number)
        time += cameras.period
    film.phase[world] = control_dt - (time - cameras.period)
    held = film.base_age[world] + control_dt
    film.base_age[world] = _deliver(ring, False, held, film.sensed[world])
    film.base_new[world] = film.base_age[world] < held
    held = film.ball_age[world] + control_dt
    film.ball_age[world] = _deliver(ring, True, held, film.sensed[world])
    film.ball_new[world] = film.ball_age[world] < held


class Mocap(Stateful):
    """Motion capture of N worlds with frames of its own rate: numbers and their sources in
    :class:`pace.config.sim.MocapConfig`.

    Truth between two control steps is interpolated linearly: a ball that falls freely is at most g dt^2 / 8 = 0.5 mm
    off, one that bounces or is hit at most a quarter of the change of its velocity times dt (5 cm at 10 m/s).

    Args: config; control_dt: s; delay (N,) control steps and scale (N,) of the noise, both sampled by the owner;
    amplitude (8,) of uniform noise and sensed (N, 8), what the robot reads: base 3, ball 3, heading 2;
    stamps: ``base_age``, ``ball_age`` (N,) s of the frames that it holds, ``base_new``, ``ball_new`` (N,) bool, they
    arrived in this step.
    """

    STATE = ("_truth", "_slow", "_ring", "_phase", "_gap")

    def __init__(
        self,
        config: SensingConfig,
        control_dt: float,
        delay: Tensor,
        scale: Tensor,
        amplitude: Tensor,
        sensed: Tensor,
        stamps: Mapping[str, Tensor],
    ) -> None:
        self._device, self._count = delay.device, len(delay)
        frames = math.ceil((config.mocap_delay[1] + config.mocap.jitter[1] + control_dt) * config.mocap.rate) + 2

        def zeros(*size: int) -> Tensor:
            return torch.zeros(self._count, *size, device=self._device)

        self._truth, self._slow, self._ring = zeros(2, TRUTH), zeros(6), zeros(frames, FRAME_COLUMNS)
        self._phase, self._gap = zeros(), zeros()
        own = {name.removeprefix("_"): getattr(self, name) for name in self.STATE}
        given = {"delay": delay, "scale": scale, "amplitude": amplitude}
        self._film = given | own | {**stamps, "sensed": sensed}
        self._cameras = cameras_of(config.mocap, control_dt)

    def record(
        self, robot: RobotState, ball_position: Tensor, in_view: Tensor, seed: Tensor
    ) -> tuple[MaskedLaunch, MaskedLaunch]:
        """Launches of a control step (mask: the ball was launched at its end) and of a beginning, for these tensors."""
        given = {"robot": robot, "ball_position": ball_position, "seed": seed, "in_view": in_view}
        given |= {"cameras": self._cameras, "film": self._film}
        advance = MaskedLaunch(_advance, self._count, self._device, **given)
        return advance, MaskedLaunch(_begin, self._count, self._device, **given)


def cameras_of(config: MocapConfig, control_dt: float) -> dict[str, float | list[float]]:
    """The fields of :class:`Cameras`; ``control_dt`` in s, between frames without a rate of their own."""
    period = 1.0 / config.rate if config.rate > 0.0 else control_dt
    return {
        "control_dt": control_dt,
        "period": period,
        "white": config.white_noise,
        "slow": config.slow_noise,
        "kept": math.exp(-period / config.slow_noise_time),
        "lost": config.lost,
        "gap_chance": 1.0 - math.exp(-config.gap_rate * period),
        "gap": config.gap,
        "jitter": config.jitter,
        "occlusion": config.occlusion,
    }
