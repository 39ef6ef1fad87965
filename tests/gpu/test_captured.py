"""The parts of an update as CUDA graphs, which a dry run cannot show: ``python -m pytest -m gpu -s tests/gpu``."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch import nn

from pace.arrays.gradients import Gradients
from pace.arrays.graph import CapturedCall, CudaGraph, Graphs
from pace.config.training import load_train_config
from pace.distributed import ProcessGroup
from pace.predictor.network import make_predictor
from pace.predictor.priors import resolve_priors
from pace.rl.train import main
from pace.rl.trainer import Trainer
from pace.runs.checkpoint import load_checkpoint
from pace.runs.metrics import read_metrics
from pace.runs.optimiser import adam, learning_rate
from pace.task.env import TableTennisEnv
from tests.helpers.groups import Echo, connected

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="captures CUDA graphs"),
]
WORLDS = 64
SMALL = (
    f"num_worlds={WORLDS}", "device=cuda", "samples=1e9", "minutes=0", "algo.steps=4", "algo.actor_hidden=[64]",
    "algo.critic_hidden=[64]", "predictor.batches_per_update=4", "tensorboard=false", "progress=false",
)  # fmt: skip


@pytest.fixture
def device() -> Iterator[torch.device]:
    yield torch.device("cuda:0")
    torch.cuda.set_sync_debug_mode("default")


class Fit:
    """A network that is fitted to random samples, on the way that the learners take."""

    def __init__(self, device: torch.device) -> None:
        torch.manual_seed(1)
        self.device = device
        self.network = nn.Sequential(nn.Linear(4, 8), nn.ELU(inplace=True), nn.Linear(8, 1)).to(device)
        parameters = list(self.network.parameters())
        self.gradients, self.optimiser = Gradients(parameters), adam(parameters, 0.1)
        self.gradients.hold()
        self.generator = torch.Generator(device).manual_seed(2)

    def step(self) -> None:
        x = torch.rand(16, 4, generator=self.generator, device=self.device)
        loss = (self.network(x) - x.sum(1, keepdim=True)).square().mean()
        self.gradients.zero_()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        learning_rate(self.optimiser).mul_(0.99)


def test_a_captured_fit_is_the_fit(device: torch.device) -> None:
    """Its gradients are zeroed inside, its backward pass was warmed up on the capture's stream, its random numbers go
    on and its learning rate is read from the device."""
    plain, graphed = Fit(device), Fit(device)
    call = CapturedCall(graphed.step, device, Graphs.CUDA, graphed.generator)
    for _ in range(8):
        plain.step()
        call()
    assert isinstance(call._graph, CudaGraph)
    for mine, theirs in zip(graphed.network.parameters(), plain.network.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)
    assert torch.equal(plain.generator.get_state(), graphed.generator.get_state())


def test_after_a_failed_capture_generators_and_streams_are_as_before(device: torch.device) -> None:
    """On torch 2.11 the generators of a failed capture refused to work."""
    generator, total = torch.Generator(device).manual_seed(3), torch.zeros((), device=device)
    stream = torch.cuda.current_stream(device)

    def reading() -> None:
        total.add_(torch.rand((), device=device, generator=generator) + torch.rand((), device=device))
        total.item()

    call = CapturedCall(reading, device, Graphs.CUDA, generator)
    call()
    before = generator.get_state()
    with pytest.raises(RuntimeError, match=r"engine\.graph=never runs without graphs"):
        call()
    assert torch.cuda.current_stream(device) == stream
    assert torch.equal(generator.get_state(), before)
    torch.rand(3, device=device, generator=generator)
    torch.rand(3, device=device)
    torch.cuda.synchronize()
    fit = Fit(device)
    good = CapturedCall(fit.step, device, Graphs.CUDA, fit.generator)
    for _ in range(3):
        good()
    assert all(parameter.isfinite().all() for parameter in fit.network.parameters())


def trainer_of(graph: str, group: ProcessGroup | None = None, *overrides: str) -> Trainer:
    config = load_train_config([*SMALL, f"engine.graph={graph}", *overrides])
    config.predictor = resolve_priors(config)
    torch.manual_seed(config.seed)
    predictor = make_predictor(config.predictor).to("cuda:0")
    env = TableTennisEnv(config, WORLDS, "cuda:0", config.seed, predictor)
    return Trainer(config, env, predictor, None, group)


def test_an_update_waits_for_the_device_once(device: torch.device) -> None:
    trainer = trainer_of("always")
    for _ in range(4):
        trainer._safe_update()
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        trainer._safe_update()  # as a run does, with what could undo it
    waits = [str(warning.message) for warning in caught if "synchronizing" in str(warning.message)]
    assert len(waits) == 1, waits


def test_captured_updates_learn_what_the_calls_do(device: torch.device) -> None:
    """Up to MuJoCo Warp's order of summation: over few updates, metrics of the learner agree."""
    rows = {}
    for graph in ("never", "always"):
        trainer = trainer_of(graph)
        rows[graph] = [trainer.update() for _ in range(6)]
    for name in ("loss_critic", "entropy", "policy_std", "lr", "predictor_rmse_cm"):
        first, second = (torch.tensor([row[name] for row in rows[graph]]) for graph in ("never", "always"))
        torch.testing.assert_close(second, first, rtol=0.1, atol=1e-3, msg=lambda text, n=name: f"{n}: {text}")


def test_a_group_is_captured_up_to_the_exchange(device: torch.device) -> None:
    """With an echo of this process in place of another."""
    trainer = trainer_of("always", Echo(), "algo.observation_norm=false")
    for _ in range(4):
        row = trainer.update()
    assert math.isfinite(row["kl"])
    assert all(value.isfinite().all() for value in trainer.agent.state_dict().values())


def test_a_group_of_one_exchanges_over_nccl(device: torch.device) -> None:
    """Real messages between the two graphs of an optimiser step, on one card; between two cards nothing was tried.
    tests/rl/test_dry.py does the same over gloo, bit for bit."""
    with connected(device) as group:
        assert "nccl" in dist.get_backend_config()
        trainer = trainer_of("always", group, "algo.observation_norm=false")
        for _ in range(6):
            row = trainer.update()
        torch.cuda.synchronize()
        algo = trainer.config.algo
        assert len(group.messages) > 6 * algo.epochs * algo.minibatches
    assert row["kl"] > 0
    assert all(math.isfinite(row[name]) for name in ("kl", "loss_critic", "predictor_rmse_cm"))
    assert all(value.isfinite().all() for value in trainer.agent.state_dict().values())


def train(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    return main()


def test_a_run_passes_through_all_changes_and_resumes_on_both_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Number format, steps of an update, the curriculum's stage; then on a CPU, and on the GPU again."""
    changes = (
        "algo.std=[{samples: 512, value: 0.5},{samples: 768, value: 0.2}]", "algo.autocast=mixed",
        "algo.later_steps=[{samples: 2048, value: 6}]",
        "curriculum=[{samples: 3500, task: ['serve.pause=[0.0,0.3]', 'sensing=wide', 'serve=mixed']}]",
    )  # fmt: skip
    arguments = [argument for argument in SMALL if not argument.startswith("samples")]
    assert train(monkeypatch, *arguments, *changes, f"out={tmp_path}", "samples=5000") == 0
    training = load_checkpoint(tmp_path).training
    assert training is not None
    assert training["algorithm"]["fine"]
    for samples, device in ((5600, "cpu"), (7000, "cuda")):
        assert train(monkeypatch, f"resume={tmp_path}", f"samples={samples}", f"device={device}", "progress=false") == 0
    rows = read_metrics(tmp_path / "metrics.csv")
    assert rows["stage"][-1] == 1.0
    assert all(math.isfinite(value) for value in rows["kl"])
    for weights in load_checkpoint(tmp_path).weights.values():
        assert all(value.isfinite().all() for value in weights.values())


def test_old_graphs_give_their_memory_back(device: torch.device) -> None:
    """A change of the steps makes new graphs; those of before are freed, not kept beside them."""
    trainer = trainer_of("always")
    used = []
    for steps in (4, 6, 4, 6, 4):
        trainer.config.algo.steps = steps
        for _ in range(3):
            trainer.update()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        used.append(torch.cuda.memory_reserved())
    print("reserved MiB after each change:", [round(size / 2**20) for size in used])
    assert used[4] < 1.3 * used[2]
