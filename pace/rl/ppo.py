"""PPO: its update and the algorithm that the trainer runs.

The update is TorchRL's ClipPPOLoss and KL-adaptive learning rate, over minibatches gathered into fixed buffers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from pace.arrays.gradients import Gradients
from pace.arrays.graph import CapturedCall, Graphs
from pace.arrays.launch import Bound
from pace.arrays.state import under_prefix
from pace.config.schedules import START, Position, scheduled
from pace.config.training import AlgoConfig
from pace.distributed import ProcessGroup
from pace.rl.adaptive_rate import KLAdaptiveRate
from pace.rl.agent import Agent, Policy, RunningNorm, Sizes
from pace.rl.loss import PPOLoss
from pace.rl.minibatch import gather, minibatch_of
from pace.rl.rollout import Rollout, VectorTask, require_finite
from pace.runs.checkpoint import load_weights
from pace.runs.optimiser import adam, learning_rate, live_state, load_optimiser_state, optimiser_state
from pace.runs.reading import read

LOSS_METRICS = ("loss_objective", "loss_critic", "entropy", "clip_fraction", "value_clip_fraction")
METRICS = ("kl", "grad_norm_actor", "grad_norm_critic", *LOSS_METRICS)


class PPO:
    """Learner of an :class:`Agent`: one optimiser, gradient bound and parameter set each for actor and critic.

    The processes of a ``group`` learn from the union of their rollouts: gradients, KL and metrics are means over them.
    An optimiser step is a graph if the rollout's environment has graphs; in a group it is two, with the exchange of the
    gradients between them.
    """

    def __init__(self, agent: Agent, config: AlgoConfig, group: ProcessGroup | None = None) -> None:
        self.agent, self.config, self.group = agent, config, group or ProcessGroup()
        self.loss = PPOLoss(agent, config)
        self.actor_parameters = list(agent.actor.parameters())
        self.critic_parameters = list(agent.critic.parameters())
        self.actor_optimiser = adam(self.actor_parameters, config.learning_rate)
        self.critic_optimiser = adam(self.critic_parameters, config.learning_rate)
        rate = learning_rate(self.actor_optimiser)
        self.schedule = KLAdaptiveRate(rate, config.learning_rate_min, config.learning_rate_max)
        self._gradients = Gradients(self.actor_parameters, self.critic_parameters)
        self._metrics = torch.zeros(len(METRICS), device=rate.device)  # of an optimiser step
        self._mean = torch.zeros_like(self._metrics)  # of an update
        self._minibatch = Bound(self._make_minibatch, rollout=None)

    def update(self, rollout: Rollout, at: Position) -> dict[str, float]:
        """:meth:`learn`, and read the metrics.

        Errors: :class:`RolloutError` if one of them is not finite; the weights must then not be saved.
        """
        metrics = read(self.learn(rollout, at))
        require_finite(metrics)
        return metrics

    def learn(self, rollout: Rollout, at: Position) -> dict[str, Tensor]:
        """Learn from one rollout, ``at`` a place in the run, without a wait for the device.

        Returns the means of the update's metrics, (). Unless all are finite, the weights must not be saved.
        """
        self.loss.get_buffer("entropy_coeff").fill_(scheduled(self.config.entropy, at))
        self.schedule.target.fill_(scheduled(self.config.kl_target, at))
        explained = rollout.explained_variance(self.group)
        sources = self._sources(rollout)
        batch, step = self._minibatch(rollout)
        rows, count = batch.batch_size[0], self.config.minibatches
        self._mean.zero_()
        for _ in range(self.config.epochs):
            order = torch.randperm(rollout.steps * rollout.num_worlds, device=rollout.reward.device)
            for index in order[: rows * count].split(rows):
                gather(sources, index, batch)
                step()
        self.agent.actor.bound_std(self.config.std_floor, scheduled(self.config.std, at))
        self._mean.div_(self.config.epochs * count)
        self.group.all_reduce_mean_([self._mean])
        metrics = dict(zip(METRICS, self._mean.unbind(), strict=True)) | {"explained_variance": explained}
        return metrics | {"lr": learning_rate(self.actor_optimiser), "policy_std": self.agent.actor.std.mean()}

    def _make_minibatch(self, rollout: Rollout) -> tuple[TensorDict, Callable[[], None]]:
        """The buffers of a minibatch, and the optimiser step on them."""
        batch = minibatch_of(rollout, self._sources(rollout), self.config.minibatches)
        captured = partial(CapturedCall, device=rollout.reward.device, graphs=rollout.env.graphs)
        if self.group.size > 1 or rollout.env.graphs is not Graphs.NONE:
            self._gradients.hold()
        if self.group.size == 1:
            return batch, captured(partial(self._step, batch))
        if rollout.env.graphs is Graphs.NONE:
            return batch, partial(self._step_overlapping, batch)
        return batch, partial(self._step_in_two, captured(partial(self._differentiate, batch)), captured(self._apply))

    def _step(self, batch: TensorDict) -> None:
        """One optimiser step of each network."""
        self._differentiate(batch)
        self._apply()

    def _step_in_two(self, differentiate: Callable[[], None], apply: Callable[[], None]) -> None:
        """The same in a group, in two graphs: the exchange between them is in none."""
        differentiate()
        self.group.all_reduce_mean_([self._gradients.flat])
        apply()

    def _step_overlapping(self, batch: TensorDict) -> None:
        """The same in a group, without graphs: the exchange overlaps with the work on the other network."""
        of_actor, of_critic = self._gradients.parts
        out = self._differentiate_actor(batch)
        receive_actors = self.group.all_reduce_mean_later([of_actor])
        self._differentiate_critic(out)
        receive_critics = self.group.all_reduce_mean_later([of_critic])
        receive_actors()
        self._apply_actor()
        receive_critics()
        self._apply_critic()

    def _differentiate(self, batch: TensorDict) -> None:
        self._differentiate_critic(self._differentiate_actor(batch))

    def _differentiate_actor(self, batch: TensorDict) -> TensorDictBase:
        """All losses; the actor's gradients, and the KL divergence beside them."""
        self._gradients.zero_()
        out = self.loss(batch)
        (out["loss_objective"] + out["loss_entropy"]).backward()
        self._gradients.first.copy_(self.loss.kl)
        return out

    def _differentiate_critic(self, out: TensorDictBase) -> None:
        out["loss_critic"].backward()
        values = [out.get(name, self.loss.kl.new_zeros(())) for name in LOSS_METRICS]
        self._metrics[-len(values) :].copy_(torch.stack([value.detach().reshape(()) for value in values]))

    def _apply(self) -> None:
        self._apply_actor()
        self._apply_critic()

    def _apply_actor(self) -> None:
        kl = self._gradients.first
        self.schedule.adapt(kl)
        self._metrics[0].copy_(kl)
        self._metrics[1].copy_(nn.utils.clip_grad_norm_(self.actor_parameters, self.config.max_grad_norm))
        self.actor_optimiser.step()

    def _apply_critic(self) -> None:
        self._metrics[2].copy_(nn.utils.clip_grad_norm_(self.critic_parameters, self.config.max_grad_norm))
        self.critic_optimiser.step()
        self._mean.add_(self._metrics)

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

    def state_dict(self) -> dict[str, Any]:
        """Both optimisers' moments and the adapted learning rates."""
        return {name: optimiser_state(optimiser) for name, optimiser in self._optimisers()}

    def live_state(self) -> dict[str, Any]:
        """:meth:`state_dict` without a wait for the device: the tensors themselves."""
        return {name: live_state(optimiser) for name, optimiser in self._optimisers()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        for name, optimiser in self._optimisers():
            load_optimiser_state(optimiser, state[name])

    def _optimisers(self) -> tuple[tuple[str, torch.optim.Adam], ...]:
        return ("actor_optimiser", self.actor_optimiser), ("critic_optimiser", self.critic_optimiser)


class AsymmetricPPO:
    """PPO with an actor on sensed and a critic on true observations.

    See :class:`pace.rl.algorithm.Algorithm` and :class:`pace.rl.algorithm.InPlace`.

    Attributes: ``agent``, ``ppo`` its learner, ``rollout`` its storage, ``None`` before the first :meth:`prepare`.
    """

    rollout: Rollout | None = None

    def __init__(self, sizes: Sizes, config: AlgoConfig, device: torch.device, group: ProcessGroup) -> None:
        self.config, self.group = config, group
        self.agent = Agent(*sizes, config, device)
        self.ppo = PPO(self.agent, config, group)
        self._finish = Bound(self._make_finish, rollout=None)
        self._begins = ""

    def prepare(self, env: VectorTask, at: Position) -> int:
        """Allocate storage for these worlds in the networks' number format, and apply ``algo.later_steps``."""
        steps, old = self.config.steps_at(at), self.rollout
        fits = old is not None and old.env is env and old.steps == steps
        if old is None or not fits or old.policy.dtype != self.agent.observation_dtype:
            self.rollout = Rollout(env, self.agent, steps)
        return steps

    def storage(self) -> Rollout:
        """The storage of the rollout."""
        assert self.rollout is not None  # prepare() comes first
        return self.rollout

    def begin(self) -> None:
        """Freeze the policy's standard deviation; copy the normalisers' moments."""
        self._moments = [norm.moments() for norm in self._norms()]
        self.storage().begin()

    def step(self, t: int) -> None:
        """See :meth:`Rollout.step`."""
        self.storage().step(t)

    def finish(self) -> None:
        """Values and advantages."""
        self._finish(self.storage())()

    def _make_finish(self, rollout: Rollout) -> CapturedCall:
        finish = partial(rollout.finish, self.config.gamma, self.config.gae_lambda)
        return CapturedCall(finish, rollout.reward.device, rollout.env.graphs)

    def healthy(self) -> Tensor:
        """See :meth:`Rollout.healthy`."""
        return self.storage().healthy()

    def fault(self) -> str | None:
        """See :meth:`Rollout.fault`."""
        return self.storage().fault()

    def update(self, at: Position) -> dict[str, Tensor]:
        """One set of normalisers for all, then :meth:`PPO.learn`."""
        for norm, moments in zip(self._norms(), self._moments, strict=True):
            norm.pool(moments, self.group)
        return self.ppo.learn(self.storage(), at)

    def learned(self, metrics: Mapping[str, float]) -> None:
        """Choose the networks' number format by the policy's standard deviation."""
        self.agent.choose_dtype(metrics["policy_std"])

    def _norms(self) -> tuple[RunningNorm, RunningNorm]:
        return self.agent.policy_norm, self.agent.critic_norm

    def weights_loaded(self, new_run: bool) -> None:
        """A new run begins with a standard deviation of its configuration, and with steps that the loaded one allows:
        the KL divergence of a step grows with the square of the learning rate over the standard deviation."""
        if new_run:
            self.agent.actor.bound_std(self.config.std_floor, scheduled(self.config.std, START))
            std = self.agent.actor.std.mean().item()
            share = std / self.config.std[0].value
            rate = max(self.config.learning_rate * share**2, self.config.learning_rate_min)
            if rate < self.config.learning_rate:
                self.ppo.schedule.begin_at(rate)
                self._begins = f", the actor's learning rate at {rate:.2g} first, as a std of {std:.2g} allows"
        self.agent.choose_dtype(self.agent.actor.std.mean().item())

    def describe(self) -> str:
        """The networks' number format; how a run that starts from weights begins."""
        agent = self.agent
        number_format = str(agent.observation_dtype).removeprefix("torch.")
        if agent.observation_dtype != torch.float32 and agent.fp32_below > 0.0:
            number_format += f" (the actor in float32 below a std of {agent.fp32_below:g})"
        return f"networks in {number_format}{self._begins}"

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`PPO.state_dict`; and whether the networks have come to float32."""
        return self.ppo.state_dict() | {"fine": self.agent.fine}

    def live_state(self) -> dict[str, Any]:
        """See :meth:`PPO.live_state`."""
        return self.ppo.live_state() | {"fine": self.agent.fine}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`. The number format of older runs follows from the policy."""
        self.ppo.load_state_dict(state)
        if "fine" in state:
            self.agent.compute_fine(state["fine"])

    @staticmethod
    def load_policy(weights: Mapping[str, Tensor], sizes: Sizes, config: AlgoConfig, source: str) -> Policy:
        """The mean action of the trained actor."""
        network = Policy.build(sizes.policy, sizes.actions, config)
        parts = (("normaliser", network.norm, "policy_norm"), ("actor", network.mlp, "actor.mlp"))
        for name, module, prefix in parts:
            load_weights(module, under_prefix(prefix, dict(weights)), f"{source} ({name})")
        return network
