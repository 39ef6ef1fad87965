"""The learned predictor: from the last sensed ball positions to the apex, the paddle's target and the time to it.

``features: steps`` takes positions alone (paper). For windows over the whole flight, ``counted`` takes the last five
positions and their total number, and ``flight`` fits two parabolas to all (:mod:`pace.predictor.filter`) and learns the
residual. Any other predictor is a :class:`BallPredictor`, from the package or from outside
(:mod:`pace.config.plugins`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn

from pace.config import plugins
from pace.config.base import ConfigError
from pace.config.predictor import COUNTED_FRAMES, FEATURES, FlightFit, PredictorConfig, PredictorPriors, Prior
from pace.predictor.filter import FlightFilter

OUTPUT_SIZES = {"apex": 3, "target": 3, "target_time": 1}

LARGEST_FEATURE = 5.0


def predictor_slices(outputs: list[str]) -> dict[str, slice]:
    """Columns of each named part of the predictor's output.

    Errors: :class:`ConfigError` for an unknown name, or if the apex is not among them.
    """
    unknown = [name for name in outputs if name not in OUTPUT_SIZES]
    if unknown or "apex" not in outputs:
        raise ConfigError(f"predictor.outputs must hold apex and may hold {list(OUTPUT_SIZES)}: {outputs}")
    ends = list(accumulate(OUTPUT_SIZES[name] for name in outputs))
    return {name: slice(end - OUTPUT_SIZES[name], end) for name, end in zip(outputs, ends, strict=True)}


class FlightFeatures(nn.Module):
    """Features of the fit of a whole flight: ``size`` numbers of order one."""

    centre: Tensor
    scale: Tensor
    size = 26

    def __init__(self, frames: int, priors: PredictorPriors, fit: FlightFit) -> None:
        super().__init__()
        self.filter = FlightFilter(frames, priors, fit)
        (age, spread), (start, bounced) = ((prior.mean[0], prior.std[0]) for prior in (priors.age, priors.bounced))
        times = Prior([age, 0.0, age, start, 0.0], [spread, spread, spread, bounced, 1.0])
        before, after = (priors.position, priors.fall_velocity, priors.fall), (priors.rise_velocity, priors.rise)
        parts = (times, *before, priors.bounce, *after, priors.apex)
        self.register_buffer("centre", torch.tensor([v for part in parts for v in part.mean]), persistent=False)
        self.register_buffer("scale", torch.tensor([v for part in parts for v in part.std]), persistent=False)

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N, W, 3) m -> features (N, size), apex (N, 3) m, and time to it (N, 1) s, both as fitted."""
        flight = self.filter(frames)
        ages = [flight.age, flight.bounce_age, flight.apex_delay, flight.seen, 1.0 / (1.0 + flight.seen)]
        values = torch.cat([*ages, *flight.before, *flight.after, flight.apex], dim=1)
        features = ((values - self.centre) / self.scale).clamp(-LARGEST_FEATURE, LARGEST_FEATURE)
        return features, flight.apex, flight.apex_delay - flight.bounce_age


class BallPredictor(nn.Module, ABC):
    """A predictor: (N, 3 frames) ball positions -> (N, out), both in m and s, world frame.

    The frames are ordered from the oldest to the newest, 20 ms apart; until a ball has been sensed so often, its first
    position is repeated. Outputs are in the order of ``config.outputs``; ``slices[name]`` are their columns. The
    regression compares them in units of their scales, which are priors.

    Args: config: of the predictor, with priors (:func:`pace.predictor.priors.resolve_priors`); default: the measured.
    Errors: :class:`ConfigError` for unknown outputs, and fewer than two frames.
    """

    output_centre: Tensor
    output_scale: Tensor

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__()
        self.slices = predictor_slices(config.outputs)
        if config.frames < 2:
            raise ConfigError(f"predictor.frames must be at least 2 to see a velocity, got {config.frames}")
        self.frames = config.frames
        self.outputs = list(config.outputs)
        self.priors = config.priors or PredictorPriors()
        self.input_size = 3 * config.frames
        self.output_size = sum(OUTPUT_SIZES[name] for name in self.outputs)
        known = {"apex": self.priors.apex, "target": self.priors.target, "target_time": self.priors.target_time}
        mean = [value for name in self.outputs for value in known[name].mean]
        self.register_scaling("output", Prior(mean, [value for name in self.outputs for value in known[name].std]))

    def register_scaling(self, name: str, prior: Prior) -> None:
        """Register buffers ``<name>_centre`` and ``<name>_scale``, which are configuration and not weights."""
        self.register_buffer(f"{name}_centre", torch.tensor(prior.mean), persistent=False)
        self.register_buffer(f"{name}_scale", torch.tensor(prior.std), persistent=False)

    @abstractmethod
    def scaled(self, positions: Tensor) -> Tensor:
        """Outputs in units of their scales, (N, out), for the regression."""

    def scale_target(self, target: Tensor) -> Tensor:
        """True outputs (N, out), m and s -> units of their scales."""
        return (target - self.output_centre) / self.output_scale

    def forward(self, positions: Tensor) -> Tensor:
        """(N, 3 frames) ball positions, oldest first -> (N, out) predictions, m and s."""
        return torch.addcmul(self.output_centre, self.scaled(positions), self.output_scale)


class PredictorNetwork(BallPredictor):
    """MLP with ReLU over ``config.frames`` ball positions.

    The input is transformed to the newest position and the steps between frames, scaled: the same information, but the
    small differences that carry the velocity are of order one too.
    With ``config.features`` "counted" those are the last five, and the number of frames since the launch is added: the
    window repeats its first position if the flight was shorter.
    With "flight" the input is transformed to a fit of the flight, and the MLP outputs the correction of its apex.
    """

    position_centre: Tensor
    position_scale: Tensor
    step_centre: Tensor
    step_scale: Tensor

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__(config)
        self.flight = FlightFeatures(config.frames, self.priors, config.fit) if config.features == "flight" else None
        self.register_scaling("position", self.priors.position)
        self.register_scaling("step", self.priors.step)
        self.counted = config.features == "counted"
        seen = 3 * COUNTED_FRAMES + 1 if self.counted else self.input_size
        sizes = [self.flight.size if self.flight else seen, *config.hidden]
        hidden = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ReLU())]
        self.layers = nn.Sequential(*hidden, nn.Linear(sizes[-1], self.output_size))

    def features(self, positions: Tensor) -> Tensor:
        """(N, 3 frames) ball positions -> scaled newest position and steps (N, 3 frames), or those of the last five and
        the count of frames (N, 16)."""
        frames = positions.unflatten(1, (self.frames, 3))
        if self.counted:
            moved = (frames[:, 1:] != frames[:, :-1]).any(2).sum(1, keepdim=True)
            count = (moved - self.priors.count.mean[0]) / self.priors.count.std[0]
            return torch.cat([self._steps(frames[:, -COUNTED_FRAMES:]), count], dim=1)
        return self._steps(frames)

    def _steps(self, frames: Tensor) -> Tensor:
        newest = (frames[:, -1] - self.position_centre) / self.position_scale
        steps = (frames[:, 1:] - frames[:, :-1] - self.step_centre) / self.step_scale
        return torch.cat([newest, steps.flatten(1)], dim=1)

    def scaled(self, positions: Tensor) -> Tensor:
        """See :class:`BallPredictor`."""
        if self.flight is None:
            return self.layers(self.features(positions))
        features, apex, delay = self.flight(positions.unflatten(1, (self.frames, 3)))
        known = {"apex": apex, "target": apex, "target_time": delay}
        fitted = self.scale_target(torch.cat([known[name] for name in self.outputs], dim=1))
        return self.layers(features) + fitted.clamp(-LARGEST_FEATURE, LARGEST_FEATURE)


def _accept(found: object) -> type[BallPredictor]:
    if not (isinstance(found, type) and issubclass(found, BallPredictor)):
        raise TypeError("a predictor is a subclass of pace.predictor.network.BallPredictor")
    return found


#: All predictors by ``predictor.features``.
PREDICTORS: plugins.Registry[type[BallPredictor]] = plugins.Registry(
    "predictor", plugins.PREDICTORS, _accept, dict.fromkeys(FEATURES, PredictorNetwork), where="predictor.features="
)


def make_predictor(config: PredictorConfig) -> BallPredictor:
    """An untrained predictor. Errors: :class:`ConfigError` for unknown features or outputs."""
    return PREDICTORS[config.features](config)
