"""The kernels of a run are compiled before it begins, and a second start compiles none."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp
from warp._src import context

from pace.config.base import ConfigError
from pace.config.training import load_train_config
from pace.distributed import is_first_here
from pace.rl.kernels import architecture, kernels_of, kernels_of_a_gpu
from pace.rl.train import main as train
from pace.rl.warm import main as warm

CPU = torch.device("cpu")
SMALL = (
    "device=cpu", "processes=1", "num_worlds=16", "samples=128", "engine=native", "algo.actor_hidden=[8]",
    "algo.critic_hidden=[8]", "predictor.batches_per_update=2", "progress=false", "tensorboard=false",
)  # fmt: skip


@pytest.fixture
def empty_cache(tmp_path: Path) -> Iterator[None]:
    """An empty folder of kernels, and no module loaded."""
    before, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, str(tmp_path / "kernels")
    for module in context.user_modules.values():
        module.unload()
    yield
    wp.config.kernel_cache_dir = before


def run(monkeypatch: pytest.MonkeyPatch, main: Any, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    return main()


@pytest.mark.slow
@pytest.mark.usefixtures("empty_cache")
def test_a_run_compiles_before_it_begins_and_a_second_one_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    compiled: list[str] = []
    compile_module = context.Module._compile

    def noted(module: Any, *args: Any, **kwargs: Any) -> bool:
        done = compile_module(module, *args, **kwargs)
        compiled.extend([module.name] * done)
        return done

    monkeypatch.setattr(context.Module, "_compile", noted)
    assert run(monkeypatch, warm, "device=cpu", "engine=native") == 0
    said = capsys.readouterr().out
    assert f"compiling kernels: {len(compiled)} modules" in said
    assert len(set(compiled)) == len(compiled) > 10
    before = list(compiled)
    assert run(monkeypatch, train, *SMALL, f"out={tmp_path / 'run'}") == 0  # with more worlds, and through updates
    assert compiled == before
    assert "compiling" not in capsys.readouterr().out


def test_a_gpus_kernels_are_known_without_one() -> None:
    found = kernels_of_a_gpu(load_train_config())
    names = {each.module.name for each in found}
    assert {"pace.sim.ball.step_kernel", "pace.task.game_kernels", "mujoco_warp._src.forward"} <= names
    assert len(names) > 50
    assert 256 in {each.block_dim for each in found}
    assert 1 not in {each.block_dim for each in found}


def test_a_stage_with_another_robot_brings_its_kernels() -> None:
    plain = kernels_of(load_train_config(["engine=mjwarp"]), CPU)
    stage = "curriculum=[{share: 0.5, task: ['robot=t1_29dof']}]"
    both = kernels_of(load_train_config(["engine=mjwarp", stage]), CPU)
    assert {each.module.name for each in plain} < {each.module.name for each in both}


def test_a_stage_of_pauses_and_of_motion_capture_brings_their_kernels() -> None:
    stages = "{share: 0.3, task: ['serve.pause=[0.0,1.0]']}, {share: 0.5, task: ['sensing=mocap']}"
    plain, both = (
        {each.module.name for each in kernels_of(load_train_config(["engine=native", *given]), CPU)}
        for given in ([], [f"curriculum=[{stages}]"])
    )
    assert both - plain == {"pace.task.pauses", "pace.sim.mocap"}


def test_all_stages_of_the_generalist_are_rehearsed() -> None:
    """The last one has a machine's serves, which are sampled until they land: nothing lands in a rehearsal."""
    names = {each.module.name for each in kernels_of_a_gpu(load_train_config(["experiment=generalist"]))}
    assert {"pace.task.pauses", "pace.sim.mocap"} <= names


def test_an_architecture_is_one_of_warps() -> None:
    if not context.runtime.nvrtc_supported_archs:
        pytest.skip("Warp has no CUDA compiler here")
    assert architecture("sm_90") == architecture("90") == 90
    for wrong in ("sm_9", "hopper", "sm_90a"):
        with pytest.raises(ConfigError, match=f"arch must be one that Warp can compile for .*sm_90.*, not {wrong}"):
            architecture(wrong)


def test_one_process_of_a_machine_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_first_here()
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "1")
    for rank, first in (("0", True), ("3", False)):
        monkeypatch.setenv("LOCAL_RANK", rank)
        assert is_first_here() is first
    monkeypatch.delenv("TORCHELASTIC_RUN_ID")
    monkeypatch.setenv("PACE_PROCESS_GROUP", "1 2 1234")
    assert not is_first_here()
