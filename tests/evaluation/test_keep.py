"""A kept policy: the same actions, no training state, nothing of the machine that trained it."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pace.config.base import ConfigError
from pace.evaluation import publish
from pace.evaluation.keep import main
from pace.evaluation.publish import KeepError, keep
from pace.rl.policies import load_policy
from pace.runs.checkpoint import export_weights, load_checkpoint, save_checkpoint
from pace.runs.own_files import LIST
from pace.runs.whole_folder import LOCK, clear_leftovers, replaced
from tests.helpers.saved import save_run

ROW = {"serve": "mid_long", "serves": 5120, "hit": 0.995, "hit_low": 0.991, "hit_high": 0.997}
ROW |= {"success": 0.971, "success_low": 0.965, "success_high": 0.976, "falls_per_1000": 0.39}
EVALUATED = {
    "rows": [ROW], "physics_dt": 0.002, "num_worlds": 256, "warmup_serves": 2, "seed": 1,
    "overrides": ["engine.physics_dt=0.002", "engine.threads=1", "sensing=paper"],
}  # fmt: skip

FORK = multiprocessing.get_context("fork")


def run_main(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["keep", *arguments])
    return main()


def test_the_kept_policy_acts_like_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = save_run(tmp_path / "run")
    (run / "metrics.csv").write_text("update,samples\n3,99\n")
    evaluation = tmp_path / "evaluation"
    evaluation.mkdir()
    (evaluation / "evaluation.json").write_text(json.dumps(EVALUATED))
    (evaluation / "sweep.json").write_text(json.dumps({"cells": [{"kind": "noise", "value": "x 2", "rows": [ROW]}]}))
    (tmp_path / "notes.md").write_text("Made by a test.\n")
    kept = tmp_path / "pretrained" / "mine"
    extra = ["--evaluation", str(evaluation), "--notes", str(tmp_path / "notes.md")]
    assert run_main(monkeypatch, str(run), str(kept), *extra) == 0
    assert "metrics.csv" in capsys.readouterr().out
    names = {file.name for file in kept.iterdir()}
    files = {"checkpoint.json", "weights.safetensors", "metrics.csv", "evaluation.json", "sweep.json", "README.md"}
    assert names == files | {LIST} | {"versions.json"} & names
    assert set((kept / LIST).read_text().split()) == names - {LIST}
    before, after = load_policy(run), load_policy(kept)
    observation = torch.randn(5, 450)
    torch.testing.assert_close(after(observation), before(observation), atol=1e-6, rtol=0)
    assert (after.config.engine.name, after.config.engine.threads, after.config.out) == ("auto", 0, None)


def test_an_evaluation_from_before_the_free_hand_was_counted_makes_a_card(tmp_path: Path) -> None:
    content = json.loads(Path("docs/results/baseline/campaign.json").read_text())
    for row in content["rows"]:
        row["failures"].pop("free_hand")
    old = content["rows"][0]
    (tmp_path / "evaluation.json").write_text(json.dumps(content))
    keep(save_run(tmp_path / "run"), tmp_path / "mine", tmp_path)
    cells = f"| {old['serve']} | {old['serves']:,} | {100 * old['hit']:.1f} "
    assert cells in (tmp_path / "mine" / "README.md").read_text()


def test_the_card_says_what_it_is_and_how_to_play_its_table(tmp_path: Path) -> None:
    run = save_run(tmp_path / "run")
    (tmp_path / "run" / "versions.json").write_text(
        json.dumps({"command": ["train.py", "experiment=generalist"], "packages": {"torch": "2.13.0", "pace": None}})
    )
    (tmp_path / "evaluation.json").write_text(json.dumps(EVALUATED))
    keep(run, tmp_path / "mine", tmp_path, "It limps.")
    text = (tmp_path / "mine" / "README.md").read_text()
    assert text.startswith("# mine\n")
    assert "`ball=rubber`" in text
    assert "| last command | `python -m pace.rl.train experiment=generalist` |" in text
    assert "| versions | torch 2.13.0 |" in text
    assert "\nIt limps.\n" in text
    command = "task=own physics_dt=0.002 num_worlds=256 warmup_serves=2 seed=1 serves=5120 sensing=paper"
    assert f"`python -m pace.evaluation pretrained/mine {command}`" in text
    assert "| mid-long | 5,120 | 99.5 (99.1 to 99.7) | 97.1 (96.5 to 97.6) | 0.4 |" in text
    assert "Robustness sweep" not in text
    assert "Quality of play" not in text  # an older evaluation


def test_the_card_has_all_tables_of_the_evaluation(tmp_path: Path) -> None:
    run = save_run(tmp_path / "run")
    falls = {"falls_waiting_per_1000": 1.5, "falls_waiting_per_1000_low": 0.4, "falls_waiting_per_1000_high": None}
    first = {"serve": "mid_long", "ball": "hidden", "rows": [{**ROW, "wait": 3.0, "robots": 512, **falls}]}
    groups = [{**ROW, "balls": "1", "first": 1, "last": 1}, {**ROW, "balls": "20+", "first": 20, "last": 22}]
    content = {**EVALUATED, "by_ball": {"mid_long": groups, "short": groups[1:]}, "first_ball": first}
    (tmp_path / "evaluation.json").write_text(json.dumps(content))
    (tmp_path / "by_ball.png").write_bytes(b"picture")
    keep(run, tmp_path / "mine", tmp_path)
    text = (tmp_path / "mine" / "README.md").read_text()
    assert "| ball | 1 | 20+ |" in text
    assert "| mid_long, success % | 97.1 (96.5 to 97.6) | 97.1 (96.5 to 97.6) |" in text
    assert "| short, hit % | - | 99.5 (99.1 to 99.7) |" in text
    assert "(mid-long serves; until then the ball is out of view)" in text
    assert "| 3 | 512 | 99.5 | 99.1 to 99.7 | 97.1 | 96.5 to 97.6 | 1.5 | 0.4 to - |" in text
    assert (tmp_path / "mine" / "by_ball.png").read_bytes() == b"picture"


@pytest.mark.parametrize("case", ["no run", "no evaluation", "no notes"])
def test_wrong_folders_are_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "nothing" if case == "no run" else save_run(tmp_path / "run")
    extra = ["--evaluation", str(tmp_path)] if case == "no evaluation" else []
    extra += ["--notes", str(tmp_path / "none.md")] if case == "no notes" else []
    assert run_main(monkeypatch, str(run), str(tmp_path / "kept"), *extra) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "kept").exists()


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_a_folder_with_other_files_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, precious = save_run(tmp_path / "run"), tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("years of work")
    policies = tmp_path / "pretrained"
    keep(run, policies / "a")
    keep(run, policies / "b")
    before = files_of(tmp_path)
    for folder, words in (
        (precious, "holds other files"),
        (policies, "holds other files"),  # the name of the policy was forgotten
        (precious / "thesis.txt", "is no folder"),
        (run, "holds the run itself"),
        (run / "checkpoints" / "update_00000003", "holds the run itself"),
        (run / "checkpoints", "holds the run itself"),
        (tmp_path, "holds the run itself"),
    ):
        assert run_main(monkeypatch, str(run), str(folder)) == 1
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1
    assert files_of(tmp_path) == before
    assert run_main(monkeypatch, str(policies / "a"), str(policies / "a")) == 1  # a policy into itself
    assert run_main(monkeypatch, str(policies / "a"), str(policies)) == 1
    assert files_of(tmp_path) == before


def test_a_published_policy_is_replaced_and_other_files_in_it_stay(tmp_path: Path) -> None:
    run, kept = save_run(tmp_path / "run"), tmp_path / "kept"
    (tmp_path / "evaluation.json").write_text(json.dumps(EVALUATED))
    keep(run, kept, tmp_path, "Old note.")
    (kept / "sweep_of_mine").mkdir()
    (kept / "sweep_of_mine" / "sweep.json").write_text("{}")
    (kept / "notes.txt").write_text("mine")
    keep(run, kept, kept, "New note.")  # with the evaluation that lies in it
    assert "New note." in (kept / "README.md").read_text()
    assert json.loads((kept / "evaluation.json").read_text()) == EVALUATED
    assert (kept / "sweep_of_mine" / "sweep.json").read_text() == "{}"
    assert (kept / "notes.txt").read_text() == "mine"
    keep(run, kept)
    assert not (kept / "evaluation.json").exists()  # it was of the policy before
    assert (kept / "notes.txt").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"run", "kept", "evaluation.json"}


def test_a_training_that_is_kept_goes_when_its_policy_is_done(tmp_path: Path) -> None:
    run, kept = save_run(tmp_path / "run"), tmp_path / "kept"
    newest = load_checkpoint(run)
    assert newest.path is not None
    newest.training = {"algorithm": {"moment": torch.ones(3)}, "processes": [{"env": torch.zeros(9)}]}
    save_checkpoint(newest.path, newest)
    keep(run, kept, training=True)
    training = load_checkpoint(kept).training
    assert training is not None
    assert training["algorithm"]["moment"].tolist() == [1.0, 1.0, 1.0]
    assert training["processes"] == []
    keep(run, kept)
    assert load_checkpoint(kept).training is None
    assert "training.safetensors" not in files_of(kept)


def test_the_policies_of_the_repository_can_be_replaced(tmp_path: Path) -> None:
    run = save_run(tmp_path / "run")
    for policy in sorted(Path("pretrained").glob("*/")):
        shutil.copytree(policy, tmp_path / policy.name)
        assert "README.md" in {file.name for file in keep(run, tmp_path / policy.name)}


def test_a_published_policy_can_be_published_again_elsewhere(tmp_path: Path) -> None:
    old = Path("pretrained/pace")
    keep(old, tmp_path / "new", old, "Another note.")
    assert (tmp_path / "new" / "metrics.csv").read_text() == (old / "metrics.csv").read_text()
    assert (tmp_path / "new" / "versions.json").read_bytes() == (old / "versions.json").read_bytes()
    assert "Another note." in (tmp_path / "new" / "README.md").read_text()


def test_a_policy_that_cannot_be_finished_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = save_run(tmp_path / "run")
    keep(run, tmp_path / "kept", notes="Old note.")
    before = files_of(tmp_path)

    def fails(*_: object) -> str:
        raise OSError("disk is full")

    monkeypatch.setattr(publish, "card", fails)
    with pytest.raises(OSError, match="disk is full"):
        keep(run, tmp_path / "kept")
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("error", [OSError("disk is full"), KeyboardInterrupt()])
def test_a_folder_that_cannot_be_replaced_is_put_back(
    error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second of the two renames fails; or Ctrl-C comes between them."""
    run = save_run(tmp_path / "run")
    keep(run, tmp_path / "kept", notes="Old note.")
    (tmp_path / "kept" / "notes.txt").write_text("mine")
    before, rename = files_of(tmp_path), Path.rename

    def fails(self: Path, target: Path) -> Path:
        if self.name == "kept" and target.name == "kept":
            assert not target.exists()
            raise error
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(type(error)):
        keep(run, tmp_path / "kept")
    assert files_of(tmp_path) == before
    monkeypatch.undo()
    keep(run, tmp_path / "kept")
    assert {path.name for path in tmp_path.iterdir()} == {"run", "kept"}


@pytest.mark.parametrize("last", ["card", "rename to old", "rename to kept", "remove"])
def test_what_a_killed_call_has_left_is_finished_or_undone_by_the_next(last: str, tmp_path: Path) -> None:
    run, kept = save_run(tmp_path / "run"), tmp_path / "policies" / "kept"
    keep(run, kept, notes="Old note.")
    (kept / "notes.txt").write_text("mine")
    before = files_of(kept)

    def work() -> None:
        """Publish again, and be killed before something is done."""

        def kill(*_: object, **__: object) -> None:
            os.kill(os.getpid(), signal.SIGKILL)

        def rename(self: Path, target: Path, rename: Callable[[Path, Path], Path] = Path.rename) -> Path:
            if self.name == "kept" and last == f"rename to {target.name}":
                kill()
            return rename(self, target)

        Path.rename = rename  # type: ignore[method-assign]
        if last == "card":
            publish.card = kill  # type: ignore[assignment]
        if last == "remove":
            shutil.rmtree = kill  # type: ignore[assignment]
        keep(run, kept, notes="New note.")

    process = FORK.Process(target=work)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    left = [path.name for path in kept.parent.iterdir() if path.name != "kept"]
    assert len(left) == 1
    assert kept.exists() == (last != "rename to kept")
    clear_leftovers(kept.parent)
    assert [path.name for path in kept.parent.iterdir()] == ["kept"]
    assert (kept / "notes.txt").read_text() == "mine"
    assert (files_of(kept) == before) == (last != "remove")  # then the new one was complete
    keep(kept, tmp_path / "policies" / "other")
    assert {path.name for path in kept.parent.iterdir()} == {"kept", "other"}


def test_what_lives_or_is_somebody_elses_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, place = save_run(tmp_path / "run"), tmp_path / "policies"
    theirs = place / ".pace_new_theirs"
    theirs.mkdir(parents=True)
    (theirs / "thesis.txt").write_text("years of work")
    (place / ".pace_new_file").write_text("no folder")
    (place / ".pace_new_link").symlink_to(run)
    with replaced(place / "kept") as fresh:  # which another process is about to finish
        fresh.mkdir()
        before = files_of(tmp_path)
        clear_leftovers(place)
        assert files_of(tmp_path) == before
    lost = place / ".pace_new_lost"  # killed before it had replaced kept, which was made again since
    for part in ("old", "fresh"):
        (lost / part / "kept").mkdir(parents=True)
    (lost / "old" / "notes.txt").write_text("mine")
    (lost / LOCK).touch()
    keep(run, place / "kept")
    assert (lost / "old" / "notes.txt").read_text() == "mine"
    assert (theirs / "thesis.txt").read_text() == "years of work"
    assert "both stay" in capsys.readouterr().err


def test_a_strangers_folder_is_no_published_policy_and_files_in_one_are_the_users(tmp_path: Path) -> None:
    run, theirs = save_run(tmp_path / "run"), tmp_path / "theirs"
    export_weights(run, theirs)
    (theirs / "README.md").write_text("# The policy of my thesis\n")
    before = files_of(theirs)
    with pytest.raises(KeepError, match="holds other files"):
        keep(run, theirs)
    assert files_of(theirs) == before
    keep(run, tmp_path / "kept")
    (tmp_path / "kept" / "sweep.json").write_text("mine")
    with pytest.raises(ConfigError, match=r"sweep.json is no file that pace has written"):
        keep(run, tmp_path / "kept")
    (tmp_path / "kept" / "sweep.json").unlink()
    (tmp_path / "kept" / "README.md").write_text("written again by hand")  # it stays a published policy
    keep(run, tmp_path / "kept")


def test_an_empty_folder_may_be_written(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    keep(save_run(tmp_path / "run"), tmp_path / "empty")
    assert load_policy(tmp_path / "empty").counters["updates"] == 3
    with pytest.raises(KeepError, match="holds the run itself"):
        keep(tmp_path / "run", tmp_path / "run" / ".." / "run")
