"""Checkpoints: a round trip, and one clear error for each way in which one can be unusable."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import pytest
import torch
from torch import nn

from pace.runs.checkpoint import (
    META,
    TRAINING,
    WEIGHTS,
    Checkpoint,
    CheckpointError,
    export_weights,
    find_checkpoint,
    flatten_tensors,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)
from pace.runs.checkpoint_folders import clear_leftovers, list_checkpoints, prune_checkpoints, update_of


def example(value: float = 1.0) -> Checkpoint:
    shared = torch.full((3, 2), value)
    return Checkpoint(
        config={"name": "test", "algo": {"clip": 0.2}},
        counters={"updates": 7, "samples": 1234},
        weights={"agent": {"w": shared, "w_view": shared.t(), "count": torch.tensor(3.5, dtype=torch.float64)}},
        training={
            "ppo": {"lr": 1e-3, "moments": {"0": {"step": torch.tensor(4.0), "avg": torch.zeros(2)}}},
            "env": {"flags": torch.tensor([True, False]), "names": ["a", "b"], "none": None},
            "random": {"cpu": torch.get_rng_state()},
        },
    )


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return save_checkpoint(tmp_path / "run" / "checkpoints" / "update_00000007", example())


def test_round_trip(saved: Path) -> None:
    loaded, original = load_checkpoint(saved), example()
    assert loaded.config == original.config
    assert loaded.counters == original.counters
    for name, tensor in original.weights["agent"].items():
        assert torch.equal(loaded.weights["agent"][name], tensor)
        assert loaded.weights["agent"][name].dtype == tensor.dtype
    assert loaded.training is not None
    assert loaded.training["ppo"]["lr"] == 1e-3
    assert loaded.training["ppo"]["moments"]["0"]["step"].item() == 4.0
    assert loaded.training["env"]["flags"].tolist() == [True, False]
    assert loaded.training["env"]["names"] == ["a", "b"]
    assert loaded.training["env"]["none"] is None
    assert loaded.training["random"]["cpu"].dtype == torch.uint8


def test_newest_complete_checkpoint_of_a_run_is_found(saved: Path) -> None:
    run = saved.parent.parent
    newer = save_checkpoint(saved.parent / "update_00000012", example(2.0))
    (saved.parent / "update_00000099").mkdir()  # a folder without its meta file is not a checkpoint
    (saved.parent / ".update_00000100.123.tmp").mkdir()
    assert find_checkpoint(run) == newer
    assert find_checkpoint(saved) == saved
    assert find_checkpoint(saved / WEIGHTS) == saved
    prune_checkpoints(run, keep=1)
    assert list_checkpoints(run) == [newer]


def test_saving_again_replaces_and_leaves_nothing_behind(saved: Path) -> None:
    save_checkpoint(saved, example(5.0))
    assert load_checkpoint(saved).weights["agent"]["w"][0, 0].item() == 5.0
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def test_an_unsavable_state_is_named() -> None:
    with pytest.raises(TypeError, match=r"env\.thing is a set"):
        flatten_tensors({"env": {"thing": {1}}}, "", {})


@pytest.mark.parametrize("name", [WEIGHTS, TRAINING])
def test_truncated_tensors(saved: Path, name: str) -> None:
    data = (saved / name).read_bytes()
    (saved / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(CheckpointError, match=f"{name} is broken"):
        load_checkpoint(saved)


def test_garbage_and_missing_files(saved: Path) -> None:
    (saved / WEIGHTS).write_bytes(b"\x80\x04 not safetensors")
    with pytest.raises(CheckpointError, match="is broken"):
        load_checkpoint(saved)
    (saved / WEIGHTS).unlink()
    with pytest.raises(CheckpointError, match="is missing"):
        load_checkpoint(saved)
    (saved / META).write_text("{ not json")
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_checkpoint(saved)
    (saved / META).write_text("[]")
    with pytest.raises(CheckpointError, match="no format number"):
        load_checkpoint(saved)


def test_another_format_number(saved: Path) -> None:
    meta = json.loads((saved / META).read_text())
    meta["format"] = 99
    (saved / META).write_text(json.dumps(meta))
    with pytest.raises(CheckpointError, match="has format 99, this version of pace reads format 1"):
        load_checkpoint(saved)


def test_a_tensor_that_is_not_in_its_file(saved: Path) -> None:
    meta = json.loads((saved / META).read_text())
    meta["weights"]["agent"]["other"] = {"__tensor__": "agent.other"}
    (saved / META).write_text(json.dumps(meta))
    with pytest.raises(CheckpointError, match=r"the tensor agent\.other is missing"):
        load_checkpoint(saved)


def test_not_a_run(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        find_checkpoint(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match="neither a run folder nor a checkpoint"):
        find_checkpoint(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(CheckpointError, match="run folder without a checkpoint"):
        find_checkpoint(tmp_path)


def test_weights_must_fit_the_network() -> None:
    module = nn.Linear(3, 2)
    good = {k: v + 1 for k, v in module.state_dict().items()}
    load_weights(module, good, "here")
    assert torch.equal(module.weight, good["weight"])
    with pytest.raises(CheckpointError, match="here: the tensor bias is missing"):
        load_weights(module, {"weight": good["weight"]}, "here")
    with pytest.raises(CheckpointError, match=r"weight has the shape \(2, 4\), this configuration needs \(2, 3\)"):
        load_weights(module, {**good, "weight": torch.zeros(2, 4)}, "here")
    with pytest.raises(CheckpointError, match="the tensor extra is not of this network"):
        load_weights(module, {**good, "extra": torch.zeros(1)}, "here")


def test_export_keeps_weights_only(saved: Path, tmp_path: Path) -> None:
    folder = export_weights(saved.parent.parent, tmp_path / "pretrained")
    loaded = load_checkpoint(folder)
    assert loaded.training is None
    assert not (folder / TRAINING).exists()
    assert loaded.config == example().config
    assert loaded.weights["agent"]["count"].dtype == torch.float32


def test_copies_beside_the_checkpoints_are_the_users(saved: Path) -> None:
    run, folder = saved.parent.parent, saved.parent
    names = ["update_00000099_copy", "update_00000098 (copy)", "update_9", "best", "update_0000010x", "Update_00000097"]
    for name in names:
        shutil.copytree(saved, folder / name)
    (folder / "update_00000003").symlink_to(folder / "best")
    noted = save_checkpoint(folder / "update_00000004", example())
    (noted / "notes.md").write_text("the good one")
    newest = save_checkpoint(folder / "update_123456789", example())
    assert find_checkpoint(run) == newest
    assert [update_of(path) for path in list_checkpoints(run)] == [3, 4, 7, 123456789]
    prune_checkpoints(run, keep=1)
    left = {"update_00000003", "update_00000004", "update_123456789", *names}
    assert {path.name for path in folder.iterdir()} == left
    assert (noted / "notes.md").read_text() == "the good one"
    assert load_checkpoint(folder / "best").counters["updates"] == 7
    for path in list_checkpoints(run):
        (path / META).unlink()
    with pytest.raises(CheckpointError, match=r"checkpoints/ holds Update_00000097, .*: name one of them"):
        find_checkpoint(run)


def test_what_a_kill_has_left_is_removed_or_put_back(saved: Path) -> None:
    run, folder = saved.parent.parent, saved.parent
    shutil.copytree(saved, folder / ".update_00000009.41.old")  # killed between the two renames of a replacement
    shutil.copytree(saved, folder / ".update_00000007.42.old")
    (folder / ".update_00000010.43.tmp").mkdir()
    (folder / ".update_00000010.43.tmp" / WEIGHTS).write_bytes(b"half")
    (run / ".last_good.44.tmp").mkdir()
    for mine in (folder / ".mine.45.tmp", folder / ".update_00000011.46.tmp"):
        mine.mkdir()
        (mine / "thesis.txt").write_text("mine")
    clear_leftovers(run)
    assert [path.name for path in list_checkpoints(run)] == ["update_00000007", "update_00000009"]
    hidden = {path.name for place in (run, folder) for path in place.glob(".*")}
    assert hidden == {".mine.45.tmp", ".update_00000011.46.tmp"}


def test_a_replaced_checkpoint_keeps_what_a_user_has_put_into_it(saved: Path) -> None:
    (saved / "notes.md").write_text("mine")
    save_checkpoint(saved, example(5.0))
    assert load_checkpoint(saved).weights["agent"]["w"][0, 0].item() == 5.0
    assert [file.read_text() for file in saved.parent.glob(".*/notes.md")] == ["mine"]


@pytest.mark.parametrize("at", [0, 1, 2, 3, 4, 5])
def test_a_checkpoint_that_cannot_be_written_leaves_what_was_there(
    saved: Path, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fills up at each flush in turn: of the three files, the folder, and (once the new one is in place) of
    the folder around it."""
    left = at

    def fsync(handle: int) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fsync)
    if at < 5:
        with pytest.raises(CheckpointError, match="update_00000007 cannot be written: No space left on device"):
            save_checkpoint(saved, example(5.0))
    else:
        save_checkpoint(saved, example(5.0))
    value = load_checkpoint(saved).weights["agent"]["w"][0, 0].item()
    assert value == (1.0 if at < 4 else 5.0)
    clear_leftovers(saved.parent.parent)
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def test_a_path_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    for path in ("x" * 300, "a\0b"):
        with pytest.raises(CheckpointError, match=r"cannot be read|does not exist"):
            find_checkpoint(path)
