"""Watching a run while it trains: the newest checkpoint is taken, and the reward terms are bars."""

from __future__ import annotations

import re
import shutil
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pace.config.base import ConfigError
from pace.rl.policies import load_policy
from pace.runs.metrics import last_row
from pace.viewer.bars import LEAST_SCALE, RewardBars
from pace.viewer.following import progress, wait_for_checkpoint
from pace.viewer.playback import Show
from pace.viewer.watch import main
from tests.helpers.saved import make_config, save_run

QUICK = ["engine.physics_dt=0.01", "randomization=none"]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = save_run(tmp_path / "run")
    (folder / "config.yaml").write_text("# format: 1\nrobot: {}\nalgo: {}\n")
    (folder / "metrics.csv").write_text("update,samples,hit_rate,success_rate\n7,250000,0.25,\n8,500000,0.5,0.125\n")
    return folder


@pytest.fixture
def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def test_bars_are_rates_that_fade() -> None:
    bars = RewardBars(["paid", "<b>"], 0.02)
    for _ in range(500):
        bars.update(np.array([0.04, -0.01]))
    np.testing.assert_allclose(bars.rates, [2.0, -0.5], rtol=1e-3)  # reward/s
    assert re.findall(r"width:([\d.]+)%", bars.html()) == ["50.0", "12.5"]
    assert "&lt;b&gt;" in bars.html()
    assert "sum +1.50 /s" in bars.html()
    for _ in range(50):  # 1 s
        bars.update(np.zeros(2))
    assert bars.rates[0] == pytest.approx(2.0 / np.e, rel=0.02)
    bars.update(np.array([np.nan, 0.0]))
    assert np.isfinite(bars.rates).all()
    assert f"{50 * 0.002 / LEAST_SCALE:.1f}" in _after_one(0.002 * 0.02 * 50).html()


def _after_one(reward: float) -> RewardBars:
    """One term, after one update of 0.02 s."""
    bars = RewardBars(["small"], 0.02)
    bars.update(np.array([reward]))
    return bars


def test_the_bars_of_a_show_add_up_to_the_reward(run: Path) -> None:
    show = Show(load_policy(run), QUICK, rewards=True)
    assert show.bars is not None
    assert show.bars.names == tuple(make_config().reward.terms)
    for _ in range(3):
        show.advance(show.control_dt)
    assert float(show.env.rewards.weighted.sum()) == pytest.approx(float(show.env.reward), abs=1e-5)
    assert np.abs(show.bars.rates).max() > 0.0
    assert Show(load_policy(run), QUICK).bars is None


def test_the_page_takes_a_newer_checkpoint_unless_it_is_told_not_to(run: Path, port: int) -> None:
    pytest.importorskip("mjviser")
    from pace.viewer.following import FollowingPage

    page = FollowingPage(run, load_policy(run), QUICK, ["paper"], True, port=port)
    try:
        assert "update 8, 0.50 M samples, hits 50.0 %, returns 12.5 % while exploring" in page._progress.content
        first = page._policy.source
        for number, follow in ((9, True), (10, False)):
            shutil.copytree(first, Path(first).with_name(f"update_{number:08d}"))
            page._newest.value, page._next_look = follow, 0.0
            page._look_for_checkpoints()
            assert Path(page._policy.source).name == "update_00000009"
            assert page._checkpoint.value == "update_00000009"
        before = page._bars.content
        page.draw(page.show.advance(0.1))
        assert page._bars.content != before
    finally:
        page.server.stop()


def test_the_last_row_is_read_while_the_file_grows(run: Path) -> None:
    file = run / "metrics.csv"
    assert last_row(file) == {"update": 8.0, "samples": 500000.0, "hit_rate": 0.5, "success_rate": 0.125}
    with file.open("a") as text:
        text.write("9,6000")  # a row that is being written
    assert last_row(file)["update"] == 8.0
    file.write_text("update,samples,hit_rate\n7,250000,\n")
    assert progress(run) == "training: update 7, 0.25 M samples"
    file.write_text("update,samples\n")
    assert last_row(file) == {}
    file.unlink()
    assert progress(run) == "no update yet"


def test_it_waits_for_the_first_checkpoint(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (run / "checkpoints").rename(run / "later")
    said: list[str] = []

    def pause(_: float) -> None:
        (run / "later").rename(run / "checkpoints")

    monkeypatch.setattr("time.sleep", pause)
    wait_for_checkpoint(run, said.append)
    wait_for_checkpoint(run, said.append)
    assert len(said) == 1
    assert "has no checkpoint yet" in said[0]


def test_a_term_of_ones_own_needs_its_module(run: Path) -> None:
    policy = load_policy(run)
    with pytest.raises(ConfigError, match=r"unknown reward term 'reward.terms.jump'|reward.terms.jump"):
        Show(policy, [*QUICK, "reward.terms.jump.weight=1.0"], rewards=True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "which run? give its folder"),
        (("nowhere",), "nowhere is no run folder"),
        (("RUN", "port=0"), "port must lie in 1 to 65535"),
        (("RUN", "video=a.mp4"), "there is no key 'video'"),
    ],
)
def test_bad_input_is_one_line(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, arguments: tuple[str, ...], words: str
) -> None:
    pytest.importorskip("mjviser")
    monkeypatch.setattr("sys.argv", ["pace watch", *(str(run) if a == "RUN" else a for a in arguments)])
    assert main() in (1, 2)
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1
