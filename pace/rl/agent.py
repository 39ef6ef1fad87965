"""Actor and critic: observation normalisation, the two networks, and the Gaussian policy with its bounded std."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from tensordict.nn import (
    AddStateIndependentNormalScale,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torchrl.modules import IndependentNormal

from pace.config.automatic import number_format
from pace.config.base import ConfigError
from pace.config.training import AlgoConfig
from pace.devices import has_bf16
from pace.distributed import ProcessGroup

SMALLEST_STD = 1e-4  # the scale module's own lower bound
VARIANCE_FLOOR = 1e-4  # the divisor is at least 0.01, so that nearly constant observations stay small


def compute_dtype(autocast: str, device: torch.device) -> torch.dtype:
    """Number format of the matrix products: bf16 if configured, or (``auto``) if it is the choice for the device."""
    chosen = number_format(device.type, has_bf16(device)) if autocast == "auto" else autocast
    return torch.float32 if chosen == "fp32" else torch.bfloat16


class Sizes(NamedTuple):
    """Numbers in the actor's and the critic's observation, and in the action."""

    policy: int
    critic: int
    actions: int


class RunningNorm(nn.Module):
    """Running mean and variance of an observation, and the clipped standard score by them.

    The moments of batches are merged in float64 (Chan et al. 1979), so that a long run neither drifts nor saturates.
    A batch with a NaN or an infinity is skipped and clears ``finite``, the run's cheap check. Without ``learns`` the
    moments stay 0 and 1: an observation is clipped in its own units.
    """

    count: Tensor
    mean: Tensor
    var: Tensor
    finite: Tensor
    _scale: Tensor
    _shift: Tensor

    def __init__(self, size: int, clip: float, learns: bool = True) -> None:
        super().__init__()
        self.size = size
        self.clip = clip
        self.learns = learns
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("finite", torch.ones((), dtype=torch.bool), persistent=False)
        self.register_buffer("_scale", torch.ones(size), persistent=False)
        self.register_buffer("_shift", torch.zeros(size), persistent=False)
        self.register_load_state_dict_post_hook(lambda module, _: module._loaded())

    @torch.no_grad()
    def update(self, observation: Tensor) -> None:
        """Merge a batch (N, size), float32, into the moments."""
        if not self.learns:
            self.finite.logical_and_(torch.isfinite(observation).all())
            return
        batch = observation.shape[0]
        batch_mean = observation.mean(0)
        batch_var = (observation - batch_mean).square_().mean(0).double()
        finite = torch.isfinite(batch_var).all()
        delta = batch_mean.double() - self.mean
        total = self.count + batch
        share = batch / total
        merged = self.var * (1.0 - share) + batch_var * share + delta.square() * (share * (1.0 - share))
        self.mean.copy_(torch.where(finite, self.mean + delta * share, self.mean))
        self.var.copy_(torch.where(finite, merged, self.var))
        self.count.copy_(torch.where(finite, total, self.count))
        self.finite.logical_and_(finite)
        self._refresh()

    def _loaded(self) -> None:
        """After other moments were loaded: the batches that ``finite`` is about are not those behind them."""
        self.finite.fill_(True)
        self._refresh()

    def moments(self) -> tuple[Tensor, Tensor, Tensor]:
        """Copies of count (), mean (size,) and variance (size,), for :meth:`pool`."""
        return self.count.clone(), self.mean.clone(), self.var.clone()

    @torch.no_grad()
    def pool(self, before: tuple[Tensor, Tensor, Tensor], group: ProcessGroup) -> None:
        """Merge the batches of all processes of ``group`` since they had the moments ``before``.

        In powers about the old mean, the batches of a process are a plain difference of sums, and sums add up.
        """
        if group.size == 1 or not self.learns:
            return
        count, mean, var = before
        shift = self.mean - mean
        first = self.count * shift
        second = self.count * (self.var + shift.square()) - count * var
        seen = group.all_reduce_sum_(torch.cat(((self.count - count).view(1), first, second)))
        self.count.copy_(count + seen[0])
        shift = seen[1 : self.size + 1] / self.count
        self.mean.copy_(mean + shift)
        self.var.copy_((count * var + seen[self.size + 1 :]) / self.count - shift.square())
        self._refresh()

    def _refresh(self) -> None:
        scale = (self.var + VARIANCE_FLOOR).rsqrt()
        self._scale.copy_(scale)
        self._shift.copy_(-self.mean * scale)

    def forward(self, observation: Tensor) -> Tensor:
        """Standard score (..., size) of a raw observation, clipped to +-clip."""
        return torch.addcmul(self._shift, observation, self._scale).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def normalise_into(self, observation: Tensor, out: Tensor) -> None:
        """Write the clipped standard score into ``out`` (its dtype may be bf16)."""
        out.copy_(torch.addcmul(self._shift, observation, self._scale).clamp_(-self.clip, self.clip))


class MLP(nn.Module):
    """Linear layers with ELU between them, orthogonal initial weights, matrix products in ``dtype``, float32 output."""

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int, last_gain: float, dtype: torch.dtype) -> None:
        super().__init__()
        self.dtype = dtype
        sizes = [inputs, *hidden, outputs]
        layers: list[nn.Module] = []
        for index, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            last = index == len(sizes) - 2
            linear = nn.Linear(fan_in, fan_out)
            nn.init.orthogonal_(linear.weight, last_gain if last else math.sqrt(2.0))
            nn.init.zeros_(linear.bias)
            layers.append(linear)
            if not last:
                layers.append(nn.ELU(inplace=True))
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) in float32 or ``dtype`` -> (..., outputs) in float32."""
        if self.dtype == torch.float32:
            return self.layers(x.float())
        with torch.autocast(x.device.type, dtype=self.dtype):
            return self.layers(x).float()


class GaussianActor(nn.Module):
    """Mean of the action by an MLP, and a standard deviation that does not depend on the state."""

    def __init__(self, inputs: int, actions: int, config: AlgoConfig, dtype: torch.dtype) -> None:
        super().__init__()
        self.mlp = MLP(inputs, config.actor_hidden, actions, config.last_layer_gain, dtype)
        self.spread = AddStateIndependentNormalScale(
            actions,
            scale_mapping="exp",
            scale_lb=SMALLEST_STD,  # type: ignore[arg-type]  # annotated as numbers.Number
            init_value=math.log(config.std[0].value),
        )

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised observation (..., inputs) -> mean and standard deviation (..., actions), float32."""
        return self.spread(self.mlp(observation))

    @property
    def std(self) -> Tensor:
        """Standard deviation (actions,)."""
        return self.spread.state_independent_scale.detach().exp().clamp_min(SMALLEST_STD)

    @torch.no_grad()
    def bound_std(self, lowest: float, highest: float) -> None:
        """Keep the standard deviation within [lowest, highest]."""
        low = math.log(max(lowest, SMALLEST_STD))
        self.spread.state_independent_scale.clamp_(low, max(low, math.log(highest)))


class Agent(nn.Module):
    """All that PPO trains: the normalisers, the actor on ``policy`` and the critic on ``critic`` observations."""

    def __init__(
        self, policy_size: int, critic_size: int, actions: int, config: AlgoConfig, device: torch.device
    ) -> None:
        super().__init__()
        if config.std_floor > min(point.value for point in config.std):
            raise ConfigError(f"algo.std_floor {config.std_floor} is above a value of the algo.std schedule")
        self.fast_dtype = compute_dtype(config.autocast, device)
        self.fp32_below = config.fp32_below if config.autocast in ("auto", "mixed") else 0.0
        self.fine = config.std[0].value < self.fp32_below
        self.observation_dtype = torch.float32 if self.fine else self.fast_dtype
        self.num_actions = actions
        self.policy_norm = RunningNorm(policy_size, config.observation_clip, config.observation_norm)
        self.critic_norm = RunningNorm(critic_size, config.observation_clip, config.observation_norm)
        self.actor = GaussianActor(policy_size, actions, config, self.observation_dtype)
        self.critic = MLP(critic_size, config.critic_hidden, 1, 1.0, self.fast_dtype)
        self.to(device)

    def choose_dtype(self, std: float) -> None:
        """Act in float32 once the policy's mean ``std`` is so small that rounding to bf16 is comparable to it.

        The rounding errors differ with every change of the weights: the KL divergence of an update then measures the
        rounding, and the learning rate, which follows the KL divergence, falls to its floor. The critic's values
        are not compared so, and it stays as it is. There is no way back: each change replaces the storage of the
        rollouts and the graphs on it.
        """
        self.compute_fine(self.fine or std < self.fp32_below)

    def compute_fine(self, fine: bool) -> None:
        """The actor computes in float32 from now on, or in the configured format."""
        self.fine = fine
        self.observation_dtype = self.actor.mlp.dtype = torch.float32 if fine else self.fast_dtype

    def actor_operator(self) -> ProbabilisticTensorDictSequential:
        """The actor as a TorchRL module: normalised ``policy`` -> ``loc``, ``scale`` -> ``action``."""
        return ProbabilisticTensorDictSequential(  # type: ignore[call-overload]
            TensorDictModule(self.actor, in_keys=["policy"], out_keys=["loc", "scale"]),  # type: ignore[arg-type]
            ProbabilisticTensorDictModule(  # type: ignore[arg-type]
                in_keys=["loc", "scale"],
                out_keys=["action"],
                distribution_class=IndependentNormal,
                distribution_kwargs={"validate_args": False},
                return_log_prob=True,
            ),
        )

    def critic_operator(self) -> TensorDictModule:
        """The critic as a TorchRL module: normalised ``critic`` -> ``state_value`` (..., 1)."""
        return TensorDictModule(self.critic, in_keys=["critic"], out_keys=["state_value"])


class Policy(nn.Module):
    """The deterministic policy in float32, for evaluation and export: raw ``policy`` observation in, action out."""

    def __init__(self, norm: RunningNorm, mlp: MLP) -> None:
        super().__init__()
        self.norm = norm
        self.mlp = mlp

    @classmethod
    def build(cls, policy_size: int, actions: int, config: AlgoConfig) -> Policy:
        """An untrained policy of the right shape, to load weights into."""
        norm = RunningNorm(policy_size, config.observation_clip, config.observation_norm)
        return cls(norm, MLP(policy_size, config.actor_hidden, actions, config.last_layer_gain, torch.float32))

    def forward(self, observation: Tensor) -> Tensor:
        """Raw observation (N, policy_size) -> mean action (N, actions)."""
        return self.mlp(self.norm(observation))
