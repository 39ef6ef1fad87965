"""A replay on the page and in a video: its states, one world after another, and one line for what is no replay."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from pace.config.base import to_dict
from pace.config.training import load_train_config
from pace.sim.replay import WorldReplay, load_replay, save_replay
from pace.viewer.__main__ import main
from pace.viewer.replay import ReplayPage, load_show
from tests.helpers.outside import command
from tests.helpers.robot import SPEC

DT, JOINTS = 0.02, len(SPEC.joints)


def world(number: int, steps: int) -> WorldReplay:
    """A robot that stands and lifts its joints, and a ball that rises 0.1 m a step."""
    qpos = torch.zeros(steps, 7 + JOINTS)
    qpos[:, 0], qpos[:, 2], qpos[:, 3] = number, 0.7, 1.0
    qpos[:, 7:] = 0.1 * torch.arange(steps).unsqueeze(1)
    ball = torch.zeros(steps, 9)
    ball[:, 2] = 1.0 + 0.1 * torch.arange(steps)
    return WorldReplay(number, qpos, torch.zeros(steps, 6 + JOINTS), ball, torch.zeros(steps, JOINTS))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    worlds = [world(3, 4), world(8, 1)]
    return save_replay(tmp_path / "update_00000012.replay", worlds, to_dict(load_train_config()), "diverged")


def test_states_are_shown_in_their_time_and_one_world_after_another(file: Path) -> None:
    show = load_show(file)
    assert show.text() == "world 3 (1 of 2) | 0.06 s before it | diverged"
    first = show.advance(1.5 * DT)
    np.testing.assert_allclose(first.qpos[7:], 0.15, atol=1e-6)
    np.testing.assert_allclose(first.ball, [0.0, 0.0, 1.15], atol=1e-6)
    np.testing.assert_allclose(first.base_target, [3.0, 0.0, 0.0])
    np.testing.assert_allclose(first.flight[:, 2], [1.0, 1.1, 1.2, 1.3, 1.3], atol=1e-6)
    last = show.advance(3 * DT)
    np.testing.assert_allclose(last.qpos[7:], 0.3, atol=1e-6)
    assert "in the next step" in show.text()
    other = show.advance(0.6)
    assert show.text().startswith("world 8 (2 of 2)")
    assert other.flight_number > first.flight_number
    assert len(other.flight) == 2
    show.advance(0.6)
    assert show.text().startswith("world 3")
    show.choose("world 8")
    assert show.text().startswith("world 8")


def test_a_page_shows_it(file: Path) -> None:
    pytest.importorskip("mjviser")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    page, frames = ReplayPage(load_show(file), "127.0.0.1", port), []

    def ended() -> bool:
        frames.append(page._text.content)
        if len(frames) == 2:
            page._choice.value = "world 8"
        return len(frames) > 4

    thread = threading.Thread(target=page.run, args=(ended,))
    thread.start()
    thread.join(60)
    assert not thread.is_alive()
    assert "world 3" in frames[1]
    assert "world 8" in frames[-1]


def test_a_film_of_it(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("imageio_ffmpeg")
    film = tmp_path / "a.mp4"
    status = command(main, str(file), "--video", str(film), "seconds=0.2", "width=64", "height=48")
    if status == 1:
        pytest.skip(capsys.readouterr().err)  # no OpenGL here
    assert status == 0
    assert film.stat().st_size > 500
    assert "world 3" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"config": {"robot": 1}}, "is of another version of pace"),
        ({"worlds": []}, "holds no states of the robot t1"),
        ({"joints": 4}, "holds no states of the robot t1"),
    ],
)
def test_what_is_no_replay_of_this_robot_is_one_line(
    change: dict, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = change.get("config", to_dict(load_train_config()))
    given = change.get("worlds", [world(1, 2)])
    if "joints" in change:
        given = [WorldReplay(1, torch.zeros(2, 7 + change["joints"]), *(torch.zeros(2, n) for n in (10, 9, 4)))]
    file = save_replay(tmp_path / "a.replay", given, config, "x")
    assert command(main, str(file)) == 1
    assert words in capsys.readouterr().err
    (tmp_path / "b.replay").write_bytes(b"garbage")
    assert command(main, str(tmp_path / "b.replay")) == 1
    assert "b.replay cannot be read" in capsys.readouterr().err


def test_a_replay_takes_no_changes_of_the_task(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(main, str(file), "ball=paper") == 2
    assert "takes no changes of the task" in capsys.readouterr().err
    assert load_replay(file).reason == "diverged"
