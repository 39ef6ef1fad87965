"""The learned predictor: from the last sensed ball positions to the apex, the paddle's target and the time to it.

``features: steps`` sees positions and nothing else (paper). For windows that hold the whole flight, ``counted`` sees
the last five of them and how many there were, and ``flight`` fits two parabolas to all (:mod:`pace.predictor.filter`)
and learns what these get wrong.
"""

from __future__ import annotations

from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn

from pace.config.base import ConfigError
from pace.config.task import COUNTED_FRAMES, PredictorConfig
from pace.predictor.filter import FALL, RISE, FlightFilter

OUTPUT_SIZES = {"apex": 3, "target": 3, "target_time": 1}

# Scaling to numbers of order one (world frame, m and s). A serve crosses the table (|x| <= 1.37, |y| <= 0.76) between
# its top and about 0.5 m above it, and its apex after the bounce lies at or behind the robot's end of the table.
# Between two frames (20 ms) it moves by about (-0.11, 0, 0) m, and serves differ in that by a few centimetres.
POSITION_CENTRE, POSITION_SCALE = (0.0, 0.0, 1.0), (1.0, 0.4, 0.25)
STEP_CENTRE, STEP_SCALE = (-0.11, 0.0, 0.0), (0.02, 0.02, 0.03)
COUNT_CENTRE, COUNT_SCALE = 20.0, 10.0  # frames since the launch
# What the fit of a flight says, likewise (m, s, m/s): times, velocities before and after the bounce, where it bounces.
AGE_CENTRE, AGE_SCALE, FRAMES_SCALE = 0.35, 0.25, 6.0
FALL_CENTRE, FALL_SCALE = (-5.2, -0.2, -0.5), (0.5, 0.35, 1.5)
RISE_CENTRE, RISE_SCALE = (-4.1, -0.15, 2.6), (0.5, 0.3, 0.25)
BOUNCE_CENTRE, BOUNCE_SCALE = (-1.0, -0.1, 0.78), (0.25, 0.2, 0.02)
LARGEST_FEATURE = 5.0
OUTPUT_CENTRES = {"apex": (-1.5, 0.0, 1.0), "target": (-1.6, 0.0, 1.0), "target_time": (0.3,)}
OUTPUT_SCALES = {"apex": (0.3, 0.25, 0.12), "target": (0.25, 0.25, 0.15), "target_time": (0.25,)}


def predictor_slices(outputs: list[str]) -> dict[str, slice]:
    """Columns of each named part of the predictor's output.

    Errors: :class:`ConfigError` for an unknown name, or when the apex is not among them.
    """
    unknown = [name for name in outputs if name not in OUTPUT_SIZES]
    if unknown or "apex" not in outputs:
        raise ConfigError(f"predictor.outputs must hold apex and may hold {list(OUTPUT_SIZES)}: {outputs}")
    ends = list(accumulate(OUTPUT_SIZES[name] for name in outputs))
    return {name: slice(end - OUTPUT_SIZES[name], end) for name, end in zip(outputs, ends, strict=True)}


class FlightFeatures(nn.Module):
    """What the fit of a whole flight says, in numbers of order one: ``size`` of them."""

    centre: Tensor
    scale: Tensor
    size = 26

    def __init__(self, frames: int) -> None:
        super().__init__()
        self.filter = FlightFilter(frames)
        times = ((AGE_CENTRE, 0.0, AGE_CENTRE, 0.0, 0.0), (AGE_SCALE, AGE_SCALE, AGE_SCALE, FRAMES_SCALE, 1.0))
        places = (POSITION_CENTRE, POSITION_SCALE), (FALL_CENTRE, FALL_SCALE), FALL
        places = *places, (BOUNCE_CENTRE, BOUNCE_SCALE), (RISE_CENTRE, RISE_SCALE), RISE
        apex = OUTPUT_CENTRES["apex"], OUTPUT_SCALES["apex"]
        centre, scale = zip(times, *places, apex, strict=True)
        self.register_buffer("centre", torch.tensor([v for part in centre for v in part]), persistent=False)
        self.register_buffer("scale", torch.tensor([v for part in scale for v in part]), persistent=False)

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N, W, 3) m -> features (N, size), apex (N, 3) m, and time to it (N, 1) s, both as fitted."""
        flight = self.filter(frames)
        ages = [flight.age, flight.bounce_age, flight.apex_delay, flight.seen, 1.0 / (1.0 + flight.seen)]
        values = torch.cat([*ages, *flight.before, *flight.after, flight.apex], dim=1)
        features = ((values - self.centre) / self.scale).clamp(-LARGEST_FEATURE, LARGEST_FEATURE)
        return features, flight.apex, flight.apex_delay - flight.bounce_age


class PredictorNetwork(nn.Module):
    """MLP with ReLU over ``config.frames`` ball positions; input and output are in metres and seconds, world frame.

    The frames are ordered from the oldest to the newest. Inside, they become the newest position and the steps between
    frames, scaled: the same information, but the small differences that carry the velocity are as large as the rest.
    With ``config.features`` "counted" those are the last five, and the number of frames since the launch goes with
    them: the window holds its first position over and over where the flight was shorter.
    With "flight" they become a fit of the flight, and the MLP gives what its apex lacks.
    Outputs stand in the order of ``config.outputs``; ``slices[name]`` finds them.
    """

    position_centre: Tensor
    position_scale: Tensor
    step_centre: Tensor
    step_scale: Tensor
    output_centre: Tensor
    output_scale: Tensor

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__()
        self.slices = predictor_slices(config.outputs)
        if config.frames < 2:
            raise ConfigError(f"predictor.frames must be at least 2 to see a velocity, got {config.frames}")
        self.frames = config.frames
        self.outputs = list(config.outputs)
        self.flight = FlightFeatures(config.frames) if config.features == "flight" else None
        self.input_size = 3 * config.frames
        self.output_size = sum(OUTPUT_SIZES[name] for name in self.outputs)
        self._scaling("position", POSITION_CENTRE, POSITION_SCALE)
        self._scaling("step", STEP_CENTRE, STEP_SCALE)
        centre = [value for name in self.outputs for value in OUTPUT_CENTRES[name]]
        scale = [value for name in self.outputs for value in OUTPUT_SCALES[name]]
        self._scaling("output", centre, scale)
        self.counted = config.features == "counted"
        seen = 3 * COUNTED_FRAMES + 1 if self.counted else self.input_size
        sizes = [self.flight.size if self.flight else seen, *config.hidden]
        hidden = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ReLU())]
        self.layers = nn.Sequential(*hidden, nn.Linear(sizes[-1], self.output_size))

    def _scaling(
        self, name: str, centre: list[float] | tuple[float, ...], scale: list[float] | tuple[float, ...]
    ) -> None:
        self.register_buffer(f"{name}_centre", torch.tensor(centre), persistent=False)
        self.register_buffer(f"{name}_scale", torch.tensor(scale), persistent=False)

    def features(self, positions: Tensor) -> Tensor:
        """(N, 3 frames) ball positions -> scaled newest position and steps (N, 3 frames), or those of the last five and
        the count of frames (N, 16)."""
        frames = positions.unflatten(1, (self.frames, 3))
        if self.counted:
            moved = (frames[:, 1:] != frames[:, :-1]).any(2).sum(1, keepdim=True)
            count = (moved - COUNT_CENTRE) / COUNT_SCALE
            return torch.cat([self._steps(frames[:, -COUNTED_FRAMES:]), count], dim=1)
        return self._steps(frames)

    def _steps(self, frames: Tensor) -> Tensor:
        newest = (frames[:, -1] - self.position_centre) / self.position_scale
        steps = (frames[:, 1:] - frames[:, :-1] - self.step_centre) / self.step_scale
        return torch.cat([newest, steps.flatten(1)], dim=1)

    def scaled(self, positions: Tensor) -> Tensor:
        """Outputs in units of their scales, (N, out): what the regression compares."""
        if self.flight is None:
            return self.layers(self.features(positions))
        features, apex, delay = self.flight(positions.unflatten(1, (self.frames, 3)))
        known = {"apex": apex, "target": apex, "target_time": delay}
        fitted = self.scale_target(torch.cat([known[name] for name in self.outputs], dim=1))
        return self.layers(features) + fitted.clamp(-LARGEST_FEATURE, LARGEST_FEATURE)

    def scale_target(self, target: Tensor) -> Tensor:
        """True outputs (N, out), m and s -> units of their scales."""
        return (target - self.output_centre) / self.output_scale

    def forward(self, positions: Tensor) -> Tensor:
        """(N, 3 frames) ball positions, oldest first -> (N, out) predictions, m and s."""
        return torch.addcmul(self.output_centre, self.scaled(positions), self.output_scale)
