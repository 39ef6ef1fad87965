"""Several processes that train one policy: the numbers of one process on all the data, exact resume, no orphans."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from pace.config.base import ConfigError
from pace.config.schedules import START
from pace.config.training import load_train_config
from pace.distributed import ProcessGroup, ProcessGroupError, own_device, process_group, suitable_size
from pace.predictor.network import PredictorNetwork
from pace.predictor.regression import PredictorTrainer
from pace.rl.agent import Agent, RunningNorm
from pace.rl.ppo import PPO
from pace.rl.rollout import Rollout, RolloutError
from pace.rl.trainer import Trainer, restarts_worlds
from pace.runs.checkpoint import CheckpointError, export_weights, flatten_tensors, load_checkpoint, save_checkpoint
from pace.runs.metrics import read_metrics
from tests.helpers.algo import CPU, IN_SAMPLES, small_algo
from tests.helpers.dummy import DummyTask

STEPS, WORLDS = 6, 32


class ThreadGroup(ProcessGroup):
    """A process group of threads, with the arithmetic of the real one; one at a time works, the others wait."""

    def __init__(self, rank: int, board: list[Any], barrier: threading.Barrier, turn: threading.Lock) -> None:
        super().__init__(rank, len(board))
        self.board, self.barrier, self.turn = board, barrier, turn

    def gather(self, value: Any) -> list[Any]:
        self.board[self.rank] = value
        self._meet()
        values = list(self.board)
        self._meet()
        return values

    def _meet(self) -> None:
        self.turn.release()
        try:
            self.barrier.wait()
        finally:
            self.turn.acquire()

    def all_reduce_mean_later(self, tensors: Sequence[Tensor]) -> Callable[[], None]:
        everyone = self.gather([tensor.clone() for tensor in tensors])

        def finish() -> None:
            for index, tensor in enumerate(tensors):
                tensor.copy_(torch.stack([theirs[index] for theirs in everyone]).mean(0))

        return finish

    def all_reduce_sum_(self, tensor: Tensor) -> Tensor:
        return tensor.copy_(torch.stack(self.gather(tensor.clone())).sum(0))

    def broadcast_(self, tensors: Sequence[Tensor]) -> None:
        first = self.gather([tensor.clone() for tensor in tensors])[0]
        for tensor, theirs in zip(tensors, first, strict=True):
            tensor.copy_(theirs)


def together(work: Callable[[ProcessGroup], Any], size: int = 2) -> list[Any]:
    """``work`` of each member of a process group of threads, in the order of ranks."""
    board, barrier, turn = [None] * size, threading.Barrier(size), threading.Lock()

    def run(rank: int) -> Any:
        try:
            with turn:
                return work(ThreadGroup(rank, board, barrier, turn))
        except BaseException:
            barrier.abort()  # or the others would wait for this one for ever
            raise

    with ThreadPoolExecutor(size) as pool:
        return [member.result() for member in [pool.submit(run, rank) for rank in range(size)]]


def agent_of(seed: int = 3) -> Agent:
    torch.manual_seed(seed)
    return Agent(6, 7, 2, small_algo(autocast="fp32", epochs=1, minibatches=1), CPU)


def filled_rollout(agent: Agent, worlds: slice) -> Rollout:
    """The part ``worlds`` of a rollout of WORLDS worlds of made-up numbers, of ``agent``'s policy."""
    generator = torch.Generator().manual_seed(9)

    def draw(*shape: int) -> Tensor:
        return torch.randn(STEPS, WORLDS, *shape, generator=generator)[:, worlds]

    rollout = Rollout(DummyTask(worlds.stop - worlds.start), agent, STEPS)
    rollout.policy.copy_(draw(6))
    rollout.critic[:STEPS].copy_(draw(7))
    with torch.no_grad():
        rollout.scale.copy_(agent.actor.std)
        rollout.loc.copy_(agent.actor.mlp(rollout.policy))
        noise = draw(2)
        rollout.action.copy_(rollout.loc + rollout.scale * noise)
        rollout.log_prob.copy_(torch.distributions.Normal(rollout.loc, rollout.scale).log_prob(rollout.action).sum(-1))
        rollout.value[:STEPS].copy_(agent.critic(rollout.critic[:STEPS]).squeeze(-1))
    rollout.advantage.copy_(draw())
    rollout.value_target.copy_(draw())
    return rollout


def test_two_halves_learn_what_the_whole_does() -> None:
    def learn(agent: Agent, worlds: slice, group: ProcessGroup) -> dict[str, float]:
        return PPO(agent, small_algo(epochs=1, minibatches=1), group).update(filled_rollout(agent, worlds), START)

    whole, halves = agent_of(), (agent_of(), agent_of())
    metrics = learn(whole, slice(0, WORLDS), ProcessGroup())
    parts = (slice(0, WORLDS // 2), slice(WORLDS // 2, WORLDS))
    half_metrics = together(lambda group: learn(halves[group.rank], parts[group.rank], group))
    assert half_metrics[0] == half_metrics[1]
    assert half_metrics[0] == pytest.approx(metrics, rel=1e-4, abs=1e-6)
    rollout = filled_rollout(agent_of(), slice(0, WORLDS))
    rest, target = (rollout.value_target - rollout.value[:STEPS]).double(), rollout.value_target.double()
    assert metrics["explained_variance"] == pytest.approx(1.0 - float(rest.var() / target.var()), abs=1e-5)
    for half in halves:
        for name, tensor in whole.state_dict().items():
            torch.testing.assert_close(half.state_dict()[name], tensor, rtol=0, atol=2e-6, msg=name)
    start = agent_of().state_dict()["critic.layers.0.weight"]
    assert (whole.state_dict()["critic.layers.0.weight"] - start).abs().max() > 1e-4


def test_moments_are_those_of_all_observations() -> None:
    generator = torch.Generator().manual_seed(1)
    first, second, third = (5.0 + 3.0 * torch.randn(count, 4, generator=generator) for count in (40, 30, 50))

    def play(group: ProcessGroup) -> RunningNorm:
        norm = RunningNorm(4, 8.0)
        norm.update(first)
        before = norm.moments()
        norm.update((second, third)[group.rank])
        norm.pool(before, group)
        return norm

    everything = torch.cat((first, second, third)).double()
    for norm in together(play):
        assert norm.count.item() == 120
        torch.testing.assert_close(norm.mean, everything.mean(0), rtol=1e-6, atol=0)
        torch.testing.assert_close(norm.var, everything.var(0, unbiased=False), rtol=1e-5, atol=0)
        expected = (first[0].double() - everything.mean(0)) / (everything.var(0, unbiased=False) + 1e-4).sqrt()
        torch.testing.assert_close(norm(first[0]), expected.float(), rtol=1e-4, atol=1e-5)


def test_the_predictor_of_a_group_is_one_and_its_error_that_of_all_samples() -> None:
    config = load_train_config(["predictor.batches_per_update=3"]).predictor

    torch.manual_seed(4)
    networks = [PredictorNetwork(config), PredictorNetwork(config)]
    networks[1].load_state_dict(networks[0].state_dict())
    inputs, targets = torch.randn(2, STEPS, 16, 15), torch.randn(2, STEPS, 16, networks[0].output_size)
    with torch.no_grad():
        error = networks[0](inputs.flatten(0, 2)) - targets.flatten(0, 2)
    expected = 100.0 * error[:, networks[0].slices["apex"]].square().sum(1).mean().sqrt()

    def fit(group: ProcessGroup) -> dict[str, float]:
        trainer = PredictorTrainer(networks[group.rank], config, STEPS, 16, group)
        trainer.inputs.copy_(inputs[group.rank])
        trainer.targets.copy_(targets[group.rank])
        trainer.valid.fill_(True)
        return trainer.update()

    before = [parameter.detach().clone() for parameter in networks[0].parameters()]
    first, second = together(fit)
    assert first["predictor_rmse_cm"] == second["predictor_rmse_cm"] == pytest.approx(float(expected), rel=1e-5)
    for one, other, old in zip(networks[0].parameters(), networks[1].parameters(), before, strict=True):
        assert torch.equal(one, other)
        assert not torch.equal(one, old)


def trainer_of(group: ProcessGroup) -> Trainer:
    """Of a small run on the dummy task, without a run folder."""
    config = load_train_config(["num_worlds=8", "tensorboard=false", "progress=false", "algo.actor_hidden=[8]"])
    torch.manual_seed(1)
    return Trainer(config, DummyTask(8, group.rank), PredictorNetwork(config.predictor), None, group)


def test_rates_count_every_process() -> None:
    def rates(group: ProcessGroup) -> dict[str, float]:
        counts = {"serves": (4.0, 12.0), "hits": (4.0, 0.0), "successes": (1.0, 1.0), "falls": (0.0, 2.0)}
        rest = {"steps": (50.0, 50.0), "episodes": (1.0, 2.0), "reward_sum": (5.0, 15.0)}
        trainer = trainer_of(group)
        popped = {name: torch.tensor(v[group.rank]) for name, v in (counts | rest).items()}
        trainer.env.pop_statistics = lambda: popped  # type: ignore[method-assign]
        return trainer.update()

    for row in together(rates):
        assert row["hit_rate"] == 0.25
        assert row["success_rate"] == 0.125
        assert row["fall_rate"] == pytest.approx(1.0)
        assert row["mean_reward"] == pytest.approx(0.2)


def test_a_fault_of_one_process_ends_all() -> None:
    def fault(group: ProcessGroup) -> str:
        trainer = trainer_of(group)
        trainer.env.poison_step = 3 if group.rank == 1 else -1  # type: ignore[attr-defined]
        with pytest.raises(RolloutError) as found:
            trainer.update()
        return str(found.value)

    assert all("policy column 1 of world 3 at step 3" in text for text in together(fault))


def test_a_signal_to_any_process_ends_the_run_and_rank_0_says_when_else() -> None:
    def asked(group: ProcessGroup, signalled: int, samples: int) -> tuple[str | None, bool, str | None]:
        trainer = trainer_of(group)
        trainer.config.samples, trainer.config.checkpoint_minutes = 100, 1e6
        trainer.samples = samples if group.rank == 0 else 0  # clocks differ, and so may what is due
        trainer.stop.name = "SIGTERM" if group.rank == signalled else None
        return *trainer._asked(0.0), trainer.stop.name

    nobody = 2
    for signalled, samples, found in (
        (0, 0, ("stopped by SIGTERM", False, "SIGTERM")),
        (1, 100, ("stopped by SIGTERM", False, "SIGTERM")),
        (nobody, 0, (None, False, None)),
        (nobody, 100, ("samples=100 reached", False, None)),
    ):
        assert together(partial(asked, signalled=signalled, samples=samples)) == [found, found]


def spoil_rollout(trainer: Trainer) -> None:
    trainer.env.poison_step = 3  # type: ignore[attr-defined]


def spoil_gradient(trainer: Trainer) -> None:
    weight = next(trainer.agent.parameters())

    def spoilt(gradient: Tensor) -> Tensor:
        hook.remove()
        return gradient * torch.nan

    hook = weight.register_hook(spoilt)


@pytest.mark.parametrize("spoil", [spoil_rollout, spoil_gradient])
def test_an_update_that_one_process_spoils_is_skipped_by_all(spoil: Callable[[Trainer], None]) -> None:
    def train(group: ProcessGroup) -> tuple[list[float], dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]:
        trainer, skipped, states = trainer_of(group), [], []
        for number in range(3):
            if number == 1 and group.rank == 1:
                spoil(trainer)
            skipped.append(trainer._safe_update()["skipped"])
            states.append({name: tensor.clone() for name, tensor in trainer.agent.state_dict().items()})
            trainer.env.reset_worlds(torch.ones(trainer.num_worlds, dtype=torch.bool))  # this task has no such guard
        assert trainer.updates == 3
        return skipped, *states

    first, second = together(train)
    for skipped, before, after, then in (first, second):
        assert skipped == [0.0, 1.0, 0.0]
        assert all(torch.equal(before[name], after[name]) for name in before)
        assert any(not torch.equal(after[name], then[name]) for name in after)
        assert all(bool(tensor.isfinite().all()) for tensor in then.values())
    assert all(torch.equal(first[3][name], second[3][name]) for name in first[3])


def test_size_suits_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pace.distributed.usable_cores", lambda: 6)
    assert suitable_size(8, CPU) == 1
    assert suitable_size(1024, CPU) == 4
    assert suitable_size(4096, CPU) == 4  # 6 and 5 do not divide it
    assert suitable_size(6000, CPU) == 6
    assert suitable_size(4096, torch.device("cuda")) == 1
    with pytest.raises(ConfigError, match="cannot be shared equally by 3 processes"):
        load_train_config(["num_worlds=1024", "processes=3"])


def test_each_process_of_torchrun_has_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert own_device("cuda") == "cuda"
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "run")
    monkeypatch.setenv("LOCAL_RANK", "3")
    assert [own_device(name) for name in ("cuda", "auto", "cuda:1", "cpu")] == ["cuda:3", "cuda:3", "cuda:1", "cpu"]
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert own_device("auto") == "auto"


def test_processes_of_this_machine_do_not_share_a_gpu() -> None:
    with pytest.raises(ProcessGroupError, match="torchrun --nproc-per-node=2"), process_group(2, torch.device("cuda")):
        pass


def test_seeds_differ_between_processes_and_rank_0_keeps_the_configured_one() -> None:
    seeds = [ProcessGroup(rank, 4).seed(seed) for seed in (1, 2) for rank in range(4)]
    assert len(set(seeds)) == 8
    assert seeds[0] == 1
    assert seeds[4] == 2


def assert_same_learner(second: Trainer, first: Trainer) -> None:
    """Counters, weights, and the state of the algorithm and of the regression, bit for bit."""
    assert (second.updates, second.samples) == (first.updates, first.samples)
    states: list[dict[str, Tensor]] = []
    for trainer in (second, first):
        saved, found = trainer.checkpoint(), dict[str, Tensor]()
        assert saved.training is not None
        parts = {part: saved.training[part] for part in ("algorithm", "regression")}
        flatten_tensors({"weights": saved.weights, **parts}, "", found)
        states.append(found)
    assert states[0].keys() == states[1].keys()
    assert len(states[0]) > 50
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_another_number_of_processes_resumes_what_was_learned() -> None:
    config = load_train_config(["num_worlds=8", "tensorboard=false", "progress=false", "algo.std_floor=0.0"])
    first, second = (Trainer(config, DummyTask(8), PredictorNetwork(config.predictor), None) for _ in range(2))
    first.update()
    saved = first.checkpoint()
    assert saved.training is not None
    played = saved.training["processes"]
    assert not restarts_worlds(saved, ProcessGroup(), CPU)
    assert restarts_worlds(saved, ProcessGroup(), torch.device("cuda"))
    saved.training["processes"] = [{"env": "of worlds that are not these"}] * 2
    assert restarts_worlds(saved, ProcessGroup(), CPU)
    second.resume(saved)
    saved.training["processes"] = [{"env": "of worlds on a GPU", "random_cuda": played[0]["random"]}]
    second.resume(saved)
    assert_same_learner(second, first)
    second.update()


def test_a_kept_training_is_resumed_on_another_machine(tmp_path: Path) -> None:
    config = load_train_config(["num_worlds=8", "tensorboard=false", "progress=false", "algo.std_floor=0.0"])
    first, second = (Trainer(config, DummyTask(8), PredictorNetwork(config.predictor), None) for _ in range(2))
    for _ in range(3):
        first.update()
    save_checkpoint(tmp_path / "run", first.checkpoint())
    kept = load_checkpoint(export_weights(tmp_path / "run", tmp_path / "kept", training=True))
    assert restarts_worlds(kept, ProcessGroup(), CPU)
    second.resume(kept)
    assert_same_learner(second, first)
    second.update()
    export_weights(tmp_path / "kept", tmp_path / "done")
    with pytest.raises(CheckpointError, match="weights only: its training cannot be resumed"):
        export_weights(tmp_path / "done", tmp_path / "again", training=True)


# --- the command --------------------------------------------------------------------------------------------------

UPDATE = 8 * 12
SMALL = (
    "num_worlds=8", "processes=2", "algo.steps=12", "algo.actor_hidden=[32]", "algo.critic_hidden=[32]",
    "predictor.batches_per_update=2", "progress=false", "tensorboard=false", *IN_SAMPLES,
)  # fmt: skip


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pace.rl.train", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


def wait_for_rows(run: Path, process: subprocess.Popen[str], rows: int = 2) -> None:
    while process.poll() is None:
        if (run / "metrics.csv").exists() and len((run / "metrics.csv").read_text().splitlines()) > rows:
            return
        time.sleep(0.05)
    raise AssertionError(process.communicate())


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.slow
def test_two_processes_train_and_resume_exactly_and_one_resumes_from_them(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    status, out, err = finish(start(f"out={whole}", f"samples={3 * UPDATE}", *SMALL))
    assert status == 0, err
    assert "8 worlds on cpu in 2 processes" in out
    assert f"3 updates, {3 * UPDATE} samples" in out
    assert finish(start(f"out={parts}", f"samples={2 * UPDATE}", *SMALL))[0] == 0
    status, _, err = finish(start(f"resume={parts}", f"samples={3 * UPDATE}", "progress=false"))
    assert status == 0, err
    expected, resumed = load_checkpoint(whole), load_checkpoint(parts)
    assert expected.counters["samples"] == resumed.counters["samples"] == 3 * UPDATE
    assert expected.weights["agent"]["policy_norm.count"].item() == 3 * UPDATE
    for part, tensors in expected.weights.items():
        for name, tensor in tensors.items():
            assert torch.equal(tensor, resumed.weights[part][name]), f"{part} {name}"
    assert read_metrics(whole / "metrics.csv")["mean_reward"] == read_metrics(parts / "metrics.csv")["mean_reward"]
    first, second = (worlds["env"]["worlds.position"] for worlds in expected.training["processes"])  # type: ignore[index]
    assert not torch.equal(first, second)  # each process simulates separate worlds
    status, out, err = finish(start(f"resume={parts}", f"samples={4 * UPDATE}", "progress=false", "processes=1"))
    assert status == 0, err
    assert "resuming from" in out
    assert "update_00000003, with new worlds" in out
    alone = load_checkpoint(parts)
    assert alone.counters["samples"] == 4 * UPDATE
    assert alone.weights["agent"]["policy_norm.count"].item() == 4 * UPDATE
    assert len(alone.training["processes"]) == 1  # type: ignore[index]


@pytest.mark.long
def test_the_jobs_of_a_sweep_have_separate_workers(tmp_path: Path) -> None:
    """Hydra's ``-m`` runs the command once for each value; a worker simulates the task of its rank 0's job."""
    folder = f"out={tmp_path}/${{seed}}_${{sensing.name}}"
    status, _, err = finish(
        start("-m", "sensing=clean,wide", f"hydra.sweep.dir={tmp_path}", folder, f"samples={UPDATE}", *SMALL)
    )
    assert status == 0, err
    delays = []
    for name in ("clean", "wide"):
        training = load_checkpoint(tmp_path / f"1_{name}").training
        assert training is not None
        delays.append([float(own["env"]["sensing._delay"].max()) for own in training["processes"]])
    assert delays[0] == [0.0, 0.0]
    assert min(delays[1]) > 0.5  # control steps


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for child processes in /proc")
def test_ctrl_c_saves_and_a_lost_process_is_told(tmp_path: Path) -> None:
    process = start(f"out={tmp_path / 'stopped'}", "minutes=10", *SMALL)
    wait_for_rows(tmp_path / "stopped", process)
    children = children_of(process.pid)
    process.send_signal(signal.SIGINT)
    status, out, err = finish(process)
    assert status == 0, err
    assert "stopped by SIGINT" in out
    updates = len(read_metrics(tmp_path / "stopped" / "metrics.csv")["update"])
    assert load_checkpoint(tmp_path / "stopped").counters["updates"] == updates
    assert len(children) == 1
    assert not Path(f"/proc/{children[0]}").exists()

    process = start(f"out={tmp_path / 'lost'}", "minutes=10", *SMALL)
    wait_for_rows(tmp_path / "lost", process)
    os.kill(children_of(process.pid)[0], signal.SIGKILL)
    status, _, err = finish(process)
    assert status == 1
    assert "error: process 1 of 2 ended with status -9" in err

    process = start(f"out={tmp_path / 'killed'}", "minutes=10", *SMALL)
    wait_for_rows(tmp_path / "killed", process)
    (orphan,) = children_of(process.pid)
    process.kill()
    finish(process)
    deadline = time.monotonic() + 30.0
    while Path(f"/proc/{orphan}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{orphan}").exists()  # a worker ends with rank 0
