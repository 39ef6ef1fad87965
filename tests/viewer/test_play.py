"""Watching a policy: the state that is shown, the film, and the page in a real browser."""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pace.command.arguments import name_options
from pace.command.table import COMMANDS
from pace.config.base import ConfigError, compose, parse
from pace.config.commands import ExportConfig
from pace.config.page import PlayConfig
from pace.deploy.export import ExportError, export_policy
from pace.rl.policies import TaskPolicy, built_in_policy, load_policy
from pace.runs.checkpoint_folders import list_checkpoints
from pace.sim import render
from pace.sim.ball.ball import ball_preset
from pace.sim.render import RenderError
from pace.viewer import video
from pace.viewer.__main__ import main
from pace.viewer.playback import Score, Serve, Show
from pace.viewer.video import write_video
from tests.helpers.browser import Chromium, find_chromium, wait_for
from tests.helpers.saved import make_config, save_run

QUICK = ["engine.physics_dt=0.01", "randomization=none"]


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> TaskPolicy:
    return load_policy(save_run(tmp_path_factory.mktemp("run")))


def standing(overrides: list[str] | None = None) -> Show:
    """The show of a robot that stands still."""
    return Show(built_in_policy("zero", 1), [*QUICK, *(overrides or [])])


def test_a_chosen_serve_is_played_next() -> None:
    show = standing()
    before = show.flights
    serve = Serve(6.0, 5.0, 1.8, topspin=40.0, sidespin=-10.0)
    show.next_serve(serve)
    show.advance(1.5 * show.control_dt)  # into the step after the one that is shown now
    ball = show.env.worlds.ball
    expected = [-6.0 * np.cos(np.radians(5.0)), 6.0 * np.sin(np.radians(5.0)), 1.8]
    assert ball.velocity[0].tolist() == pytest.approx(expected)
    assert ball.spin[0].tolist() == [0.0, -40.0, -10.0]
    assert ball.position[0, 0] == pytest.approx(1.35)
    assert show.flights == before + 1
    assert (show.score.serves, show.score.last) == (0, "skipped")
    show.next_serve(None)
    show.advance(show.control_dt)
    assert -6.5 <= float(ball.velocity[0, 0]) <= -5.2  # as in the paper's evaluation
    assert float(ball.spin.abs().max()) == 0.0


def test_the_line_is_the_flight_and_nothing_jumps() -> None:
    show, table = standing(), ball_preset("rubber").table
    show.next_serve(Serve(5.8, 0.0, 1.75))
    line = show.advance(2.1 * show.control_dt).flight
    lowest = np.argmin(np.where(line[:, 0] > -1.3, line[:, 2], 9.0))
    assert line[lowest, 2] == pytest.approx(table.height + 0.02, abs=1e-3)  # the bounce itself is on the line
    assert line[-1, 2] < 0.1
    # until 0.6 s: in front of the robot
    seen = np.array([show.advance(0.25 * show.control_dt).ball for _ in range(120)])
    assert np.linalg.norm(np.diff(seen, axis=0), axis=1).max() < 8.0 * 0.25 * show.control_dt
    gaps = [min(_to_segment(place, a, b) for a, b in pairwise(line)) for place in seen]
    assert max(gaps) < 0.002  # curved between the points of both
    assert seen[:, 2].min() < table.height + 0.03


def _to_segment(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    way = end - start
    share = np.clip((point - start) @ way / max(way @ way, 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(start + share * way - point))


def test_serves_are_counted_and_a_seed_repeats(policy: TaskPolicy) -> None:
    shows = [Show(policy, QUICK, seed) for seed in (3, 3, 4)]
    first, again, other = ([show.advance(0.013) for _ in range(300)] for show in shows)
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.qpos, b.qpos)
        assert np.array_equal(a.ball, b.ball)
    assert not np.array_equal(first[-1].qpos, other[-1].qpos)
    score = shows[0].score
    assert score.serves >= 1
    assert score.returns <= score.hits <= score.serves
    assert score.text().startswith(f"serves {score.serves} | hits {score.hits} (")
    assert Score(4, 3, 1, "out").text() == "serves 4 | hits 3 (75 %) | returns 1 (25 %) | last: out"


def test_what_the_marks_show(policy: TaskPolicy) -> None:
    show = Show(policy, [*QUICK, "sensing=clean"])
    show.next_serve(Serve(5.8, 0.0, 1.75))
    snapshot = show.advance(4 * show.control_dt)
    env = show.env
    assert snapshot.apex is not None
    assert snapshot.prediction is not None
    assert snapshot.apex.tolist() == env.game.target.apex[0].tolist()
    assert snapshot.prediction.tolist() == env.actor.prediction[0, :3].tolist()
    target = env.actor.target[0, :2] + torch.tensor(env.config.reward.arm_offset)
    assert snapshot.base_target[:2] == pytest.approx(target.numpy(), abs=1e-5)
    assert len(snapshot.marks()) == 4
    assert np.linalg.norm(snapshot.flight - snapshot.apex, axis=1).min() < 0.03  # the line passes its apex
    while bool(env.game.target.something_to_hit):
        snapshot = show.advance(show.control_dt)
    assert snapshot.apex is None


def test_video_option() -> None:
    def video_option(arguments: list[str]) -> list[str]:
        return name_options(arguments, COMMANDS["play"])

    assert video_option(["r", "--video", "a.mp4", "seconds=2"]) == ["r", "video=a.mp4", "seconds=2"]
    assert video_option(["r", "--video=a.mp4"]) == ["r", "video=a.mp4"]
    assert video_option(["r", "video=a.mp4"]) == ["r", "video=a.mp4"]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("speed=2", "speed must lie in"),
        ("video=a.avi", r"end in \.mp4"),
        ("view=near", "both or strike"),
        ("width=321", "even number"),
        ("port=0", "port must lie"),
        ("seconds=0", "seconds must be positive"),
        ("policy=none", "policy must be run, zero or random, not 'none'"),
    ],
)
def test_wrong_values(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(compose("play", ["run=any", override]), PlayConfig)


def test_a_film_has_all_its_pictures(policy: TaskPolicy, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    file, seen = tmp_path / "new folder" / "out.mp4", []
    try:
        write_video(file, Show(policy, QUICK), 0.1, 20, 0.25, 128, 64, lambda: seen.append(1))
    except RenderError as error:
        pytest.skip(str(error))
    count, seconds = ffmpeg.count_frames_and_secs(str(file))
    assert count == len(seen) == 8  # 0.1 s of play, four times slower, 20 a second
    assert seconds == pytest.approx(0.4, abs=0.06)
    assert next(ffmpeg.read_frames(str(file)))["size"] == (128, 128)


@pytest.mark.parametrize("suffix", ["webp", "gif"])
def test_an_animation_has_all_its_pictures_of_one_view(suffix: str, policy: TaskPolicy, tmp_path: Path) -> None:
    file = tmp_path / f"out.{suffix}"
    try:
        write_video(file, Show(policy, QUICK), 0.1, 20, 0.5, 128, 64, view="strike")
    except RenderError as error:
        pytest.skip(str(error))
    with Image.open(file) as film:
        assert (film.size, film.n_frames, film.info["loop"]) == ((128, 64), 4, 0)  # type: ignore[attr-defined]
        film.load()
        assert film.info["duration"] == 50


def test_a_film_that_is_not_finished_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The encoder says nothing of a disk that is full at its end."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")

    def cut(path: str, *_: object, **__: object) -> Iterator[None]:
        Path(path).write_bytes(b"\0" * 1000)
        with suppress(GeneratorExit):
            while True:
                yield

    monkeypatch.setattr(ffmpeg, "write_frames", cut)
    monkeypatch.setattr(video, "pictures", lambda *_: iter([np.zeros((128, 64, 3), np.uint8)] * 2))
    (tmp_path / "out.mp4").write_text("the old film")
    with pytest.raises(RenderError, match=r"out.mp4 cannot be written"):
        write_video(tmp_path / "out.mp4", standing(), 0.1, 20, 1.0, 64, 64)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("out.mp4", "the old film")]


def run_main(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["play", *arguments])
    return main()


def test_a_task_is_shown_without_a_trained_policy(policy: TaskPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[TaskPolicy] = []
    monkeypatch.setattr("pace.viewer.play.page", lambda config, policy, overrides: shown.append(policy))
    for name in ("zero", "random"):
        assert run_main(monkeypatch, policy.source, f"policy={name}") == 0
        assert shown[-1].config == policy.config
    observation = torch.zeros(2, 3)
    assert [float(each(observation).abs().max()) > 0.0 for each in shown] == [False, True]


def test_bad_input_is_one_line(
    policy: TaskPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mjviser")
    monkeypatch.setattr(render, "_gl_context", _no_gl)
    film = ["--video", str(tmp_path / "out.mp4"), "physics_dt=0.01"]
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for arguments, status, message in (
            (["/nowhere"], 1, "does not exist"),
            (["run=null"], 2, "which run?"),
            ([policy.source, f"port={port}"], 1, f"port {port} of 127.0.0.1 cannot be opened"),
            ([policy.source, "host=nobody.invalid"], 1, "of nobody.invalid cannot be opened"),
            ([policy.source, "ball=wood"], 2, "wood"),
            ([policy.source, *film], 1, "apt install libegl1"),
        ):
            assert run_main(monkeypatch, *arguments) == status, arguments
            error = [line for line in capsys.readouterr().err.splitlines() if "picture" not in line and line]
            assert len(error) == 1
            assert error[0].startswith("error: ")
            assert message in error[0]
    assert not (tmp_path / "out.mp4").exists()


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch, policy: TaskPolicy, tmp_path: Path) -> None:
    from pace.viewer.server import PageError, require_viewer

    monkeypatch.setitem(sys.modules, "mjviser", None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(PageError, match=r"mjviser.*pip install .*(mjviser|\[viewer\])"):
        require_viewer()
    with pytest.raises(RenderError, match=r"imageio_ffmpeg.*pip install .*(imageio-ffmpeg|\[viewer\])"):
        write_video(tmp_path / "a.mp4", standing(), 0.1, 20, 1.0, 64, 64)
    with pytest.raises(ExportError, match=r"onnxscript.*pip install .*(onnxscript|\[export\])"):
        export_policy(policy, tmp_path / "a.onnx", parse(compose("export", ["run=any"]), ExportConfig))


def _no_gl() -> object:
    raise ImportError("no EGL here")


@pytest.fixture
def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@pytest.fixture
def page(policy: TaskPolicy, port: int) -> Iterator[tuple[object, threading.Thread]]:
    """A page that plays on a separate thread, and the thread."""
    pytest.importorskip("mjviser")
    from pace.viewer.web import Page

    shown, ended = Page(policy, QUICK, ["paper", "venue"], port=port), threading.Event()
    thread = threading.Thread(target=shown.run, args=(ended.is_set,))
    thread.start()
    yield shown, thread
    ended.set()
    thread.join(timeout=60)
    assert not thread.is_alive()


@pytest.mark.skipif(find_chromium() is None, reason="chromium is not installed (Debian, Ubuntu: apt install chromium)")
def test_the_page_in_a_browser(page: tuple, port: int, tmp_path: Path) -> None:
    shown, thread = page
    with Chromium(480, 360) as browser:
        browser.open(shown.url)
        wait_for(lambda: "serves " in browser.text, "the page")
        wait_for(lambda: bool(shown.server.get_clients()), "the connection")
        before, first = shown.show.advance(0.0).qpos, browser.screenshot()
        wait_for(lambda: not np.allclose(shown.show.advance(0.0).qpos, before, atol=1e-3), "the robot to move")
        wait_for(lambda: browser.screenshot() != first, "the picture to change")
        flights = shown.show.flights

        def serve_is_skipped() -> bool:  # again and again: a slow page may not show it before that serve is over too
            browser.click("Next serve")
            return "last: skipped" in browser.text

        wait_for(serve_is_skipped, "the next serve")
        assert shown.show.flights > flights
        browser.click("venue")
        wait_for(lambda: "ball venue" in browser.text, "the other ball")
        assert shown.show.env.config.ball.name == "venue"
        (tmp_path / "page.png").write_bytes(browser.screenshot())
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")
    wait_for(lambda: not shown.server.get_clients(), "the browser to be missed")
    assert thread.is_alive()  # it goes on, and lets the next one in
    with Chromium(320, 240) as browser:
        browser.open(shown.url)
        wait_for(lambda: bool(shown.server.get_clients()), "the second browser")


def test_controls_of_the_page(policy: TaskPolicy, port: int) -> None:
    pytest.importorskip("mjviser")
    from pace.viewer.server import PageError
    from pace.viewer.web import Page, checkpoints_of

    shown = Page(policy, QUICK, ["paper", "rubber"], port=port)
    try:
        with pytest.raises(PageError, match="cannot be opened"):
            Page(policy, QUICK, ["paper"], port=port)
        assert shown.serve is None
        shown._take_sliders()
        assert shown.serve == Serve(5.8, -1.0, 1.75)
        assert shown.show.env.chosen.choice == shown.serve
        shown._change_ball("paper")
        assert shown.show.env.config.ball.name == "paper"
        assert shown.show.env.chosen.choice == shown.serve  # kept
        shown._change_ball("wood")
        assert "wood" in shown._status.content
        own = Path(policy.source)
        assert checkpoints_of(policy) == list_checkpoints(own.parent.parent) == [own]
        later = own.with_name("update_00000009")
        os.symlink(own, later)
        shown._look_for_checkpoints()
        assert shown._checkpoint.options == ("update_00000009", own.name)
        shown._change_checkpoint(later.name)
        assert shown._policy.source == str(later)
        assert "update_00000009" in shown._status.content
        later.unlink()
        shown._change_checkpoint("update_00000010")
        assert "does not exist" in shown._status.content
    finally:
        shown.server.stop()


@pytest.mark.parametrize("speed", [0.04, 0.001, 0.07, 1.0])
def test_a_page_begins_at_any_speed_of_time(policy: TaskPolicy, port: int, speed: float) -> None:
    pytest.importorskip("mjviser")
    from pace.viewer.web import Page

    shown = Page(policy, QUICK, ["paper"], port=port, speed=speed)
    assert shown._time.value == speed
    shown.server.stop()


def test_the_saved_task_is_played() -> None:
    show = standing(["serve=short", "ball=paper", "serve.serves_per_episode=3"])
    config = show.env.config
    assert (config.serve.name, config.ball.name) == ("short", "paper")
    assert config.reset.base_x == [-2.01, -2.0]
    assert config.serve.serves_per_episode == 0  # it plays on
    assert make_config().serve.serves_per_episode == 5
