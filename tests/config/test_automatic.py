"""``auto`` in the configuration: chosen for the machine, said in a line, saved as chosen, and never chosen again."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from pace.arrays.graph import Graphs, graphs_of
from pace.config.automatic import CPU, KEYS, Machine, choose, in_words, left_open
from pace.config.base import ConfigError, compose, parse, to_dict
from pace.config.training import TrainConfig, load_train_config
from pace.rl import session
from pace.rl.agent import compute_dtype
from pace.rl.train import main
from pace.runs.checkpoint import Checkpoint, load_checkpoint


def chosen(machine: Machine, *overrides: str) -> tuple[TrainConfig, dict[str, Any]]:
    composed, values = choose(compose("train", list(overrides)), machine)
    return parse(composed, TrainConfig), values


def test_a_big_gpu_gets_what_was_measured() -> None:
    config, values = chosen(Machine("cuda", 139.8, True))
    assert (config.num_worlds, config.algo.steps, config.algo.minibatches) == (8192, 4, 4)
    assert config.algo.autocast == "fp32"  # as the run that reached 99.8 %
    assert set(values) == set(KEYS)
    assert in_words(values) == "8192 worlds, 4 steps an update, 4 minibatches, number format fp32"


@pytest.mark.parametrize(("memory", "worlds"), [(24.0, 8192), (8.0, 8192), (6.0, 4096), (4.0, 2048), (0.1, 1)])
def test_a_small_card_gets_as_many_worlds_as_fit(memory: float, worlds: int) -> None:
    """2 GiB and 0.5 MiB (0.5e-3 GiB) a world, in 80 % of the memory."""
    assert chosen(Machine("cuda", memory, False))[0].num_worlds == worlds


def test_several_gpus_get_as_many_worlds_each() -> None:
    assert chosen(Machine("cuda", 80.0, True, count=4))[0].num_worlds == 4 * 8192


def test_what_is_given_stays() -> None:
    given = ("num_worlds=64", "algo.steps=6", "algo.autocast=bf16")
    config, values = chosen(Machine("cuda", 80.0, True), *given)
    assert (config.num_worlds, config.algo.steps, config.algo.autocast) == (64, 6, "bf16")
    assert values == {"algo.minibatches": 4}
    assert left_open(compose("train", list(given))) == {"algo.minibatches"}
    paper, values = chosen(Machine("cuda", 80.0, True), "experiment=paper")
    assert (paper.num_worlds, paper.algo.steps, paper.algo.minibatches) == (4096, 24, 4)
    assert values == {"algo.autocast": "fp32"}


def test_without_a_machine_the_values_are_those_of_a_cpu() -> None:
    config = load_train_config()
    assert (config.num_worlds, config.algo.steps, config.algo.minibatches) == (1024, 4, 4)
    assert config.algo.autocast == "auto"  # the hardware decides when a run begins
    assert chosen(CPU._replace(bf16=True))[0].algo.autocast == "mixed"
    assert chosen(CPU._replace(bf16=False))[0].algo.autocast == "fp32"


def test_mixed_is_bf16_on_any_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    formats = {name: compute_dtype(name, torch.device("cpu")) for name in ("auto", "mixed", "bf16", "fp32")}
    assert formats == dict.fromkeys(("mixed", "bf16"), torch.bfloat16) | dict.fromkeys(("auto", "fp32"), torch.float32)


def test_a_gpu_computes_in_float32_unless_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: True)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    cuda, cpu = torch.device("cuda"), torch.device("cpu")
    assert compute_dtype("auto", cuda) == torch.float32
    assert compute_dtype("mixed", cuda) == compute_dtype("auto", cpu) == torch.bfloat16
    assert chosen(Machine("cuda", 80.0, True), "algo.autocast=mixed")[0].algo.autocast == "mixed"


SMALL = ("algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "predictor.batches_per_update=2", "progress=false")


@pytest.mark.slow
def test_a_run_says_and_saves_what_it_has_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def train(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["train", *arguments])
        assert main() == 0
        return capsys.readouterr().out

    monkeypatch.setattr(session, "machine_of", lambda *_: Machine("cuda", 1.0, True))
    said = train(f"out={tmp_path}", "samples=64", "device=cpu", "processes=1", "num_worlds=16", *SMALL)
    assert "for this device: 4 steps an update, 4 minibatches, number format fp32\n" in said
    algo = load_checkpoint(tmp_path).config["algo"]
    assert (algo["steps"], algo["minibatches"], algo["autocast"]) == (4, 4, "fp32")
    monkeypatch.setattr(session, "machine_of", lambda *_: pytest.fail("a resumed run keeps its values"))
    assert "for this device" not in train(f"resume={tmp_path}", "samples=128", "progress=false")
    assert load_checkpoint(tmp_path).config["algo"]["autocast"] == "fp32"


def test_a_run_of_a_gpu_that_goes_on_without_bf16_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    config, saved = chosen(Machine("cuda", 80.0, True), "algo.autocast=mixed")[0], None
    monkeypatch.setattr(session, "device_type_of", lambda _: "cuda")
    for supported, number_format in ((True, "mixed"), (False, "fp32")):
        monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda value=supported: value)
        changed = session.adapt(config, saved, torch.device("cpu"), [])  # type: ignore[arg-type]
        assert config.algo.autocast == number_format
        assert changed == ({} if supported else {"algo.autocast": "fp32"})


@pytest.mark.parametrize(("saved_on", "graph", "resumed_on"), [("cuda", "always", "cpu"), ("cpu", "dry", "cuda")])
def test_a_run_that_changes_devices_leaves_graphs_of_the_other_kind(
    saved_on: str, graph: str, resumed_on: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "device_type_of", lambda _: saved_on)
    monkeypatch.setattr(session, "has_bf16", lambda _: True)
    monkeypatch.setattr("pace.arrays.graph.memory_pool_is_off", lambda _: False)
    config, device = load_train_config([f"engine.graph={graph}"]), torch.device(resumed_on)
    with pytest.raises(ConfigError, match=r"give device=cpu|needs a GPU"):
        graphs_of(config.engine, device)
    changed = session.adapt(config, None, device, [])  # type: ignore[arg-type]
    assert in_words(changed) == "engine.graph=auto"
    assert graphs_of(config.engine, device) is (Graphs.NONE if resumed_on == "cpu" else Graphs.TRY)
    config.engine.graph = "never"  # is for both
    assert session.adapt(config, None, device, []) == {}  # type: ignore[arg-type]


def test_the_graphs_of_a_resumed_run_may_be_given(monkeypatch: pytest.MonkeyPatch) -> None:
    saved = Checkpoint(to_dict(load_train_config(["engine.graph=dry"])), {"samples": 1.0}, {}, None)
    for given, engine in (["engine.graph=auto"], "mjwarp"), ([], "auto"):
        config = session.resumed_config(saved, "somewhere", given)
        assert config.engine.graph == (given[0].split("=")[1] if given else "dry")
        session.adapt(config, saved, torch.device("cpu"), given)
        assert config.engine.name == engine  # that of the worlds
    monkeypatch.setattr(session, "device_type_of", lambda _: "cuda")
    config = session.resumed_config(saved, "somewhere", ["engine.graph=never"])
    assert session.adapt(config, saved, torch.device("cpu"), ["engine.graph=never"]) == {}
    assert config.engine.graph == "never"
