"""PPO: its update and the algorithm that the trainer runs.

The update is TorchRL's ClipPPOLoss and KL-adaptive learning rate, over minibatches gathered into fixed buffers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR

from pace.arrays.state import under_prefix
from pace.config.base import ConfigError
from pace.config.training import AlgoConfig
from pace.distributed import ProcessGroup
from pace.rl.agent import Agent, Policy, RunningNorm, Sizes, scheduled
from pace.rl.rollout import Rollout, RolloutError, VectorTask
from pace.runs.checkpoint import load_weights
from pace.runs.optimiser import load_optimiser_state, optimiser_state

LOSS_METRICS = (
    "loss_objective",
    "loss_critic",
    "entropy",
    "clip_fraction",
    "value_clip_fraction",
    "explained_variance",
)
METRICS = ("kl", "grad_norm_actor", "grad_norm_critic", *LOSS_METRICS)


class PPOLoss(ClipPPOLoss):
    """ClipPPOLoss that also reports the exact mean KL divergence between the two Gaussians.

    The loss's ``kl_approx`` is a mean of log-ratios: over a small minibatch its noise is comparable to the KL target,
    and it can be negative, which the learning-rate schedule ignores.
    """

    kl: Tensor

    def _get_cur_log_prob(self, tensordict: TensorDictBase, params: Any = None) -> tuple[Tensor, Any, bool]:
        log_prob, dist, composite = super()._get_cur_log_prob(tensordict, params)
        with torch.no_grad():
            ratio = tensordict["old_scale"].square() / dist.variance
            shift = (tensordict["old_loc"] - dist.mean).square() / dist.variance
            self.kl = 0.5 * (shift + ratio - ratio.log() - 1.0).sum(-1).mean()
        return log_prob, dist, composite


class PPO:
    """Learner of an :class:`Agent`: one optimiser, gradient bound and parameter set each for actor and critic.

    The processes of a ``group`` learn from the union of their rollouts: gradients, KL and metrics are means over them.
    """

    def __init__(self, agent: Agent, config: AlgoConfig, group: ProcessGroup | None = None) -> None:
        self.agent, self.config, self.group = agent, config, group or ProcessGroup()
        self.loss = PPOLoss(
            agent.actor_operator(),
            agent.critic_operator(),
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy[0].value,
            critic_coeff=config.value_coefficient,
            loss_critic_type="l2",
            clip_value=config.clip if config.clip_value else None,
            functional=False,
        )
        self.actor_parameters = list(agent.actor.parameters())
        self.critic_parameters = list(agent.critic.parameters())
        self.actor_optimiser = torch.optim.Adam(self.actor_parameters, lr=config.learning_rate, fused=True)
        self.critic_optimiser = torch.optim.Adam(self.critic_parameters, lr=config.learning_rate, fused=True)
        self.schedule = KLAdaptiveLR(
            self.actor_optimiser,
            config.kl_target[0].value,
            min_lr=config.learning_rate_min,
            max_lr=config.learning_rate_max,
        )
        self._minibatch: tuple[Rollout, TensorDict] | None = None

    def update(self, rollout: Rollout, samples: float) -> dict[str, float]:
        """Learn from one rollout, ``samples`` control steps into the run; returns the means of the update's metrics.

        Errors: :class:`RolloutError` if a loss is not finite; the weights must then not be saved.
        """
        self.loss.get_buffer("entropy_coeff").fill_(scheduled(self.config.entropy, samples))
        self.schedule.target_kl = scheduled(self.config.kl_target, samples)
        sources, batch = self._sources(rollout), self._buffers(rollout)
        rows = batch.batch_size[0]
        totals: list[Tensor] = []
        for _ in range(self.config.epochs):
            order = torch.randperm(rollout.steps * rollout.num_worlds, device=rollout.reward.device)
            for index in order[: rows * self.config.minibatches].split(rows):
                for name, source in sources.items():
                    torch.index_select(source, 0, index, out=batch[name])
                totals.append(self._learn(batch))
        self.agent.actor.bound_std(self.config.std_floor, scheduled(self.config.std, samples))
        mean = torch.stack(totals).mean(0)
        self.group.all_reduce_mean_([mean])
        metrics: dict[str, float] = dict(zip(METRICS, mean.tolist(), strict=True))
        self._require_finite(metrics)
        metrics["lr"] = self.schedule.get_last_lr()[0]
        metrics["policy_std"] = self.agent.actor.std.mean().item()
        return metrics

    def _learn(self, batch: TensorDict) -> Tensor:
        """One optimiser step of each network; returns its METRICS as one tensor."""
        self.actor_optimiser.zero_grad(set_to_none=True)
        self.critic_optimiser.zero_grad(set_to_none=True)
        out = self.loss(batch)
        (out["loss_objective"] + out["loss_entropy"]).backward()
        receive_actors = self.group.all_reduce_mean_later([self.loss.kl, *gradients(self.actor_parameters)])
        out["loss_critic"].backward()  # overlaps with the all-reduce of the actor's gradients, and vice versa below
        receive_critics = self.group.all_reduce_mean_later(gradients(self.critic_parameters))
        receive_actors()
        kl = self.loss.kl.item()
        if not math.isfinite(kl):
            raise RolloutError("not finite: the policy's output in the PPO update (its KL divergence)")
        self.schedule.step(kl)
        actor_norm = nn.utils.clip_grad_norm_(self.actor_parameters, self.config.max_grad_norm)
        self.actor_optimiser.step()
        receive_critics()
        critic_norm = nn.utils.clip_grad_norm_(self.critic_parameters, self.config.max_grad_norm)
        self.critic_optimiser.step()
        values = [out.get(name, self.loss.kl.new_zeros(())) for name in LOSS_METRICS]
        return torch.stack([v.detach().reshape(()) for v in (self.loss.kl, actor_norm, critic_norm, *values)])

    def _sources(self, rollout: Rollout) -> dict[str, Tensor]:
        """Flat (steps * N, ...) views of the rollout by the loss's names; advantages standardised over all samples."""
        steps = rollout.steps
        advantage = rollout.advantage.view(-1, 1)
        mean = advantage.mean()
        self.group.all_reduce_mean_([mean])
        variance = (advantage - mean).square().mean()
        self.group.all_reduce_mean_([variance])
        return {
            "policy": rollout.policy.flatten(0, 1),
            "critic": rollout.critic[:steps].flatten(0, 1),
            "action": rollout.action.flatten(0, 1),
            "old_loc": rollout.loc.flatten(0, 1),
            "action_log_prob": rollout.log_prob.view(-1),
            "advantage": (advantage - mean) / (variance.sqrt() + 1e-8),
            "value_target": rollout.value_target.view(-1, 1),
            "state_value": rollout.value[:steps].view(-1, 1),
        }

    def _buffers(self, rollout: Rollout) -> TensorDict:
        """The minibatch buffers that all gathers write into; allocated at the first update from that storage."""
        if self._minibatch is None or self._minibatch[0] is not rollout:
            rows = rollout.steps * rollout.num_worlds // self.config.minibatches
            if rows < 1:
                raise ConfigError(
                    f"algo.minibatches {self.config.minibatches} is more than the samples of an update, "
                    f"num_worlds x algo.steps = {rollout.steps * rollout.num_worlds}"
                )
            sources = self._sources(rollout)
            buffers = {name: torch.empty_like(source[:rows]) for name, source in sources.items()}
            batch = TensorDict(buffers, batch_size=[rows])
            batch["old_scale"] = rollout.scale.expand(rows, -1)
            self._minibatch = rollout, batch
        return self._minibatch[1]

    def _require_finite(self, metrics: dict[str, float]) -> None:
        for name, value in metrics.items():
            if not math.isfinite(value):
                raise RolloutError(f"not finite: {name} of the PPO update")

    def state_dict(self) -> dict[str, Any]:
        """Both optimisers' moments and the adapted learning rates."""
        return {
            "actor_optimiser": optimiser_state(self.actor_optimiser),
            "critic_optimiser": optimiser_state(self.critic_optimiser),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        load_optimiser_state(self.actor_optimiser, state["actor_optimiser"])
        load_optimiser_state(self.critic_optimiser, state["critic_optimiser"])


def gradients(parameters: list[nn.Parameter]) -> list[Tensor]:
    """The gradients of those parameters that have one."""
    return [parameter.grad for parameter in parameters if parameter.grad is not None]


class AsymmetricPPO:
    """PPO with an actor on sensed and a critic on true observations: see :class:`pace.rl.algorithm.Algorithm`.

    Attributes: ``agent``, ``ppo`` its learner, ``rollout`` its storage, ``None`` before the first :meth:`prepare`.
    """

    rollout: Rollout | None = None

    def __init__(self, sizes: Sizes, config: AlgoConfig, device: torch.device, group: ProcessGroup) -> None:
        self.config, self.group = config, group
        self.agent = Agent(*sizes, config, device)
        self.ppo = PPO(self.agent, config, group)

    def prepare(self, env: VectorTask, samples: float) -> int:
        """Allocate storage for these worlds, apply ``algo.later_steps``, and choose the networks' number format."""
        steps, old = self.config.steps_at(samples), self.rollout
        self.agent.choose_dtype()
        fits = old is not None and old.env is env and old.steps == steps
        if old is None or not fits or old.policy.dtype != self.agent.observation_dtype:
            self.rollout = Rollout(env, self.agent, steps)
        return steps

    @property
    def _stored(self) -> Rollout:
        assert self.rollout is not None  # prepare() comes first
        return self.rollout

    def begin(self) -> None:
        """Freeze the policy's standard deviation; copy the normalisers' moments."""
        self._moments = [norm.moments() for norm in self._norms()]
        self._stored.begin()

    def step(self, t: int) -> None:
        """See :meth:`Rollout.step`."""
        self._stored.step(t)

    def finish(self) -> None:
        """Values and advantages."""
        self._stored.finish(self.config.gamma, self.config.gae_lambda)

    def fault(self) -> str | None:
        """See :meth:`Rollout.fault`."""
        return self._stored.fault()

    def update(self, samples: float) -> dict[str, float]:
        """One set of normalisers for all processes, then :meth:`PPO.update`."""
        for norm, moments in zip(self._norms(), self._moments, strict=True):
            norm.pool(moments, self.group)
        return self.ppo.update(self._stored, samples)

    def _norms(self) -> tuple[RunningNorm, RunningNorm]:
        return self.agent.policy_norm, self.agent.critic_norm

    def weights_loaded(self, new_run: bool) -> None:
        """A new run begins with the standard deviation of its configuration."""
        if new_run:
            self.agent.actor.bound_std(self.config.std_floor, self.config.std[0].value)
        self.agent.choose_dtype()

    def describe(self) -> str:
        """The networks' number format."""
        agent = self.agent
        number_format = str(agent.observation_dtype).removeprefix("torch.")
        if agent.observation_dtype != torch.float32 and agent.fp32_below > 0.0:
            number_format += f" (float32 below a std of {agent.fp32_below:g})"
        return f"networks in {number_format}"

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`PPO.state_dict`."""
        return self.ppo.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        self.ppo.load_state_dict(state)

    @staticmethod
    def load_policy(weights: Mapping[str, Tensor], sizes: Sizes, config: AlgoConfig, source: str) -> Policy:
        """The mean action of the trained actor."""
        network = Policy.build(sizes.policy, sizes.actions, config)
        parts = (("normaliser", network.norm, "policy_norm"), ("actor", network.mlp, "actor.mlp"))
        for name, module, prefix in parts:
            load_weights(module, under_prefix(prefix, dict(weights)), f"{source} ({name})")
        return network
