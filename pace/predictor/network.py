"""The learned predictor: from the last sensed ball positions to the apex, the paddle's target and the time to it."""

from __future__ import annotations

from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn

from pace.config import ConfigError, PredictorConfig

OUTPUT_SIZES = {"apex": 3, "target": 3, "target_time": 1}

# Scaling to numbers of order one (world frame, m and s). A serve crosses the table (|x| <= 1.37, |y| <= 0.76) between
# its top and about 0.5 m above it, and its apex after the bounce lies at or behind the robot's end of the table.
# Between two frames (20 ms) it moves by about (-0.11, 0, 0) m, and serves differ in that by a few centimetres.
POSITION_CENTRE, POSITION_SCALE = (0.0, 0.0, 1.0), (1.0, 0.4, 0.25)
STEP_CENTRE, STEP_SCALE = (-0.11, 0.0, 0.0), (0.02, 0.02, 0.03)
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


class PredictorNetwork(nn.Module):
    """MLP with ReLU over ``config.frames`` ball positions; input and output are in metres and seconds, world frame.

    The frames are ordered from the oldest to the newest. Inside, they become the newest position and the steps between
    frames, scaled: the same information, but the small differences that carry the velocity are as large as the rest.
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
        self.input_size = 3 * config.frames
        self.output_size = sum(OUTPUT_SIZES[name] for name in self.outputs)
        self._scaling("position", POSITION_CENTRE, POSITION_SCALE)
        self._scaling("step", STEP_CENTRE, STEP_SCALE)
        centre = [value for name in self.outputs for value in OUTPUT_CENTRES[name]]
        scale = [value for name in self.outputs for value in OUTPUT_SCALES[name]]
        self._scaling("output", centre, scale)
        sizes = [self.input_size, *config.hidden]
        hidden = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ReLU())]
        self.layers = nn.Sequential(*hidden, nn.Linear(sizes[-1], self.output_size))

    def _scaling(
        self, name: str, centre: list[float] | tuple[float, ...], scale: list[float] | tuple[float, ...]
    ) -> None:
        self.register_buffer(f"{name}_centre", torch.tensor(centre), persistent=False)
        self.register_buffer(f"{name}_scale", torch.tensor(scale), persistent=False)

    def features(self, positions: Tensor) -> Tensor:
        """(N, 3 frames) ball positions -> (N, 3 frames) scaled newest position and steps."""
        frames = positions.unflatten(1, (self.frames, 3))
        newest = (frames[:, -1] - self.position_centre) / self.position_scale
        steps = (frames[:, 1:] - frames[:, :-1] - self.step_centre) / self.step_scale
        return torch.cat([newest, steps.flatten(1)], dim=1)

    def scaled(self, positions: Tensor) -> Tensor:
        """Outputs in units of their scales, (N, out): what the regression compares."""
        return self.layers(self.features(positions))

    def scale_target(self, target: Tensor) -> Tensor:
        """True outputs (N, out), m and s -> units of their scales."""
        return (target - self.output_centre) / self.output_scale

    def forward(self, positions: Tensor) -> Tensor:
        """(N, 3 frames) ball positions, oldest first -> (N, out) predictions, m and s."""
        return torch.addcmul(self.output_centre, self.scaled(positions), self.output_scale)
