"""Samples a second and pass of the PPO update: ours, rsl_rl's own, and the matrix products alone."""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable
from dataclasses import replace

import torch
from tensordict import TensorDict
from torch import Tensor

from pace.arrays.graph import Graphs
from pace.bench.timing import median_seconds
from pace.bench.training import SELDOM
from pace.config.commands import BenchConfig, BenchOptions
from pace.config.schedules import START
from pace.config.training import AlgoConfig, load_train_config
from pace.rl.agent import Agent, Sizes, compute_dtype
from pace.rl.ppo import PPO
from pace.rl.rollout import Rollout
from pace.task.env import TableTennisEnv

Call = Callable[[], object]


class RandomTask:
    """Worlds of random observations and rewards: they fill a rollout and cost nothing in the update."""

    def __init__(self, options: BenchOptions, device: torch.device) -> None:
        worlds = options.update_worlds
        self.graphs = Graphs.CUDA if device.type == "cuda" else Graphs.NONE
        self.generator = torch.Generator(device)
        self.policy_observation = torch.randn(worlds, options.policy_size, device=device)
        self.critic_observation = torch.randn(worlds, options.critic_size, device=device)
        self.reward = torch.zeros(worlds, device=device)
        self.terminated = torch.zeros(worlds, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(worlds, dtype=torch.bool, device=device)

    def advance(self, action: Tensor) -> None:
        """New random observations, whatever the action."""
        self.policy_observation.normal_()
        self.critic_observation.normal_()
        self.reward.normal_()

    def reset_worlds(self, mask: Tensor) -> None:
        """No episode ends."""

    def first_bad(self) -> str | None:
        """Random numbers are finite."""
        return None


def our_update(options: BenchOptions, algo: AlgoConfig, precision: str, device: torch.device) -> Call:
    """One update of :class:`pace.rl.ppo.PPO` on a filled rollout."""
    algo = replace(algo, autocast=precision)
    agent = Agent(options.policy_size, options.critic_size, options.action_size, algo, device)
    rollout = Rollout(RandomTask(options, device), agent, algo.steps)
    rollout.begin()
    for step in range(algo.steps):
        rollout.step(step)
    rollout.finish(algo.gamma, algo.gae_lambda)
    learner = PPO(agent, algo)
    return lambda: learner.update(rollout, START)


def rsl_rl_update(options: BenchOptions, algo: AlgoConfig, mixed_precision: bool, device: torch.device) -> Call:
    """One update of rsl_rl's PPO on a filled storage of the same shapes, observations normalised as ours are."""
    from rsl_rl.algorithms import PPO as RslPPO
    from rsl_rl.models import MLPModel
    from rsl_rl.storage import RolloutStorage

    task, worlds = RandomTask(options, device), options.update_worlds
    sizes = {"policy": task.policy_observation, "critic": task.critic_observation}
    observation = TensorDict(sizes, batch_size=[worlds], device=device)
    groups = {"actor": ["policy"], "critic": ["critic"]}
    gaussian = {"class_name": "GaussianDistribution", "init_std": algo.std[0].value}
    actor = MLPModel(observation, groups, "actor", options.action_size, algo.actor_hidden, "elu", True, gaussian)
    critic = MLPModel(observation, groups, "critic", 1, algo.critic_hidden, "elu", True)
    storage = RolloutStorage("rl", worlds, algo.steps, observation, [options.action_size], str(device))
    learner = RslPPO(
        actor,
        critic,
        storage,
        num_learning_epochs=algo.epochs,
        num_mini_batches=algo.minibatches,
        use_mixed_precision=mixed_precision,
        device=str(device),
    )
    with torch.inference_mode():
        for _ in range(algo.steps):
            task.advance(learner.act(observation))
            learner.process_env_step(observation, task.reward, task.terminated, {})
        learner.compute_returns(observation)
    return learner.update


def product_rates(config: BenchConfig, device: torch.device) -> dict[str, float]:
    """Samples a second of the matrix products of one pass of the configured training, at its own minibatches: at its
    steps an update, and at :data:`SELDOM`. Nothing where bf16 has no units."""
    if compute_dtype("auto", device) != torch.bfloat16:
        return {}
    env = TableTennisEnv(config, 2, device, config.seed, None)
    sizes = Sizes(env.policy_observation.shape[1], env.critic_observation.shape[1], env.action_spec.shape[-1])
    algos = {"matmul_train": config.algo, "matmul_train_12": replace(config.algo, steps=SELDOM)}
    calls = {name: matrix_products(config.num_worlds, sizes, algo, device) for name, algo in algos.items()}
    seconds = median_seconds(calls, config.bench.repeats, device)
    return {f"{name}_samples_per_s": config.num_worlds * algo.steps / seconds[name] for name, algo in algos.items()}


def matrix_products(worlds: int, sizes: Sizes, algo: AlgoConfig, device: torch.device) -> Call:
    """The bf16 matrix products of one pass, forward and backward, over the same minibatches; nothing else."""
    rows = worlds * algo.steps // algo.minibatches
    networks = [
        _layers(rows, [sizes.policy, *algo.actor_hidden, sizes.actions], device),
        _layers(rows, [sizes.critic, *algo.critic_hidden, 1], device),
    ]

    def run() -> None:
        for _ in range(algo.minibatches):
            for layers in networks:
                for depth, (x, weight, y, weight_gradient, x_gradient) in enumerate(layers):
                    torch.mm(x, weight.t(), out=y)
                    torch.mm(y.t(), x, out=weight_gradient)
                    if depth > 0:  # the gradient of an observation is not needed
                        torch.mm(y, weight, out=x_gradient)

    return run


def _layers(rows: int, sizes: list[int], device: torch.device) -> list[tuple[Tensor, ...]]:
    def matrix(*shape: int) -> Tensor:
        return torch.randn(shape, device=device).bfloat16()

    pairs = itertools.pairwise(sizes)
    return [(matrix(rows, i), matrix(o, i), matrix(rows, o), matrix(o, i), matrix(rows, i)) for i, o in pairs]


def update_rates(config: BenchConfig, device: torch.device) -> dict[str, float]:
    """All updates in turn, with the networks, steps, passes and minibatches of ``configs/algo/paper.yaml``.

    bf16 is left out if the hardware has no units for it, rsl_rl if it is not installed.
    """
    options, algo = config.bench, load_train_config(["algo=paper"]).algo
    measured: dict[str, Call] = {"ppo_fp32": our_update(options, algo, "fp32", device)}
    has_rsl = importlib.util.find_spec("rsl_rl") is not None
    if has_rsl:
        measured["rsl_rl_fp32"] = rsl_rl_update(options, algo, False, device)
    else:
        print("  rsl_rl is left out: it is not installed (pip install rsl-rl-lib, or the extra `dev`)", flush=True)
    if compute_dtype("auto", device) == torch.bfloat16:
        measured["ppo_bf16"] = our_update(options, algo, "bf16", device)
        if has_rsl:
            measured["rsl_rl_bf16"] = rsl_rl_update(options, algo, True, device)
        sizes = Sizes(options.policy_size, options.critic_size, options.action_size)
        measured["matmul_bf16"] = matrix_products(options.update_worlds, sizes, algo, device)
    else:
        print("  bf16 is left out: this hardware has no units for it", flush=True)
    seconds = median_seconds(measured, options.repeats, device)
    samples = options.update_worlds * algo.steps
    passes = {name: 1 if name == "matmul_bf16" else algo.epochs for name in measured}
    return {f"{name}_samples_per_s": samples * passes[name] / seconds[name] for name in measured}
