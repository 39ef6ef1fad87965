"""TorchRL's loss of PPO, without a wait for the device."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import ClipPPOLoss

from pace.config.training import AlgoConfig
from pace.rl.agent import Agent


class PPOLoss(ClipPPOLoss):
    """ClipPPOLoss that also reports the exact mean KL divergence between the two Gaussians, as ``kl``.

    The loss's ``kl_approx`` is a mean of log-ratios: over a small minibatch its noise is comparable to the KL target,
    and it can be negative, which the learning-rate schedule ignores.
    """

    kl: Tensor

    def __init__(self, agent: Agent, config: AlgoConfig) -> None:
        clip_value = config.clip if config.clip_value else None
        super().__init__(
            agent.actor_operator(),
            agent.critic_operator(),
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy[0].value,
            critic_coeff=config.value_coefficient,
            loss_critic_type="l2",
            clip_value=clip_value,
            functional=False,
            log_explained_variance=False,  # of a minibatch: the learner has that of all samples
        )
        if clip_value is not None:  # TorchRL asks whether it is zero, which of its buffer the host would have to read
            del self.clip_value
            self.clip_value = clip_value

    def _get_entropy(self, dist: Any, adv_shape: torch.Size) -> Tensor:
        """In closed form (...,  1). TorchRL's looks whether it is finite, to sample it otherwise."""
        return dist.entropy().unsqueeze(-1)

    def _get_cur_log_prob(self, tensordict: TensorDictBase, params: Any = None) -> tuple[Tensor, Any, bool]:
        log_prob, dist, composite = super()._get_cur_log_prob(tensordict, params)
        with torch.no_grad():
            ratio = tensordict["old_scale"].square() / dist.variance
            shift = (tensordict["old_loc"] - dist.mean).square() / dist.variance
            self.kl = 0.5 * (shift + ratio - ratio.log() - 1.0).sum(-1).mean()
        return log_prob, dist, composite
