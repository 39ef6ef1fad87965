"""Every command that takes a device, with ``device=auto``, and the notebooks, on this machine."""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pace.bench.__main__ import main as bench
from pace.deploy.__main__ import main as export
from pace.devices import resolve_device
from pace.evaluation.__main__ import main as evaluate
from pace.predictor.__main__ import main as predictor
from pace.rl.policies import load_policy
from pace.rl.train import main as train
from pace.rl.warm import main as warm
from pace.runs.checkpoint import load_checkpoint
from pace.runs.metrics import markdown
from pace.viewer.__main__ import main as play
from pace.viewer.playback import Show
from tests.helpers.gpu import NETWORK
from tests.helpers.outside import command
from tests.helpers.saved import save_run

pytestmark = pytest.mark.gpu
TINY = ("num_worlds=8", "progress=false")
ROOT = Path(__file__).parents[2]
Page = Callable[[str, str], None]
ROWS: list[list[str]] = []


@pytest.fixture(autouse=True)
def auto_is_the_device(device: torch.device) -> None:
    """``auto`` must mean the device of these tests, or they show nothing."""
    assert resolve_device("auto").type == device.type


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A saved policy of random weights."""
    return save_run(tmp_path / "run")


def done_in(page: Page, name: str, started: float, what: str = "done") -> None:
    """Add a row to the page."""
    ROWS.append([name, what, f"{time.perf_counter() - started:.0f}"])
    page("Commands with device=auto, in tiny sizes", markdown(["", "", "s"], ROWS))


def test_train_and_resume(tmp_path: Path, page: Page) -> None:
    started, out = time.perf_counter(), tmp_path / "trained"
    given = (*TINY, *NETWORK, "algo.steps=4", "algo.minibatches=4", "tensorboard=false", "processes=1")
    assert command(train, *given, f"out={out}", "samples=128") == 0
    assert command(train, f"resume={out}", "samples=256", "progress=false") == 0
    assert load_checkpoint(out).counters["samples"] == 256
    policy = load_policy(out)  # on a CPU, wherever it was trained
    env = policy.make_env(2, "cpu", overrides=["engine=native"])
    assert policy.act(env.policy_observation).isfinite().all()
    done_in(page, "`pace train`", started)


def test_evaluate(run: Path, tmp_path: Path, page: Page) -> None:
    started, out = time.perf_counter(), tmp_path / "table"
    rows = ("serves=4", "rows=[mixed]", "physics_dt=0.01", "first_ball=[0.0]", "first_ball_worlds=4")
    assert command(evaluate, str(run), *rows, "num_worlds=2", "progress=false", f"out={out}") == 0
    assert any(out.iterdir())
    done_in(page, "`pace evaluate`", started)


def test_play(run: Path, tmp_path: Path, page: Page) -> None:
    """The game itself; and a video where one can be drawn (EGL) and written."""
    started = time.perf_counter()
    show = Show(load_policy(run), ["engine.physics_dt=0.01"])
    snapshot = show.advance(0.5)
    assert snapshot is not None
    text = "played"
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        film = tmp_path / "film.mp4"
        small = ("seconds=0.2", "fps=10", "width=128", "height=64", "physics_dt=0.01")
        status = command(play, str(run), "--video", str(film), *small)
        assert status in (0, 1)  # 1: one line, for a machine that cannot draw
        assert film.exists() == (status == 0)
        text += " and filmed" if status == 0 else "; this machine cannot draw a video"
    done_in(page, "`pace play`", started, text)


def test_export(run: Path, tmp_path: Path, page: Page) -> None:
    pytest.importorskip("onnxscript")
    started = time.perf_counter()
    assert command(export, str(run), f"out={tmp_path / 'robot'}", "check_worlds=2", "check_steps=10") == 0
    assert (tmp_path / "robot" / "policy.onnx").exists()
    done_in(page, "`pace export`", started)


def test_bench(tmp_path: Path, page: Page) -> None:
    started = time.perf_counter()
    small = ("bench=quick", "num_worlds=8", "bench.update_worlds=8", "bench.parts=[physics,mjwarp,update,train]")
    assert command(bench, *small, f"out={tmp_path / 'bench'}") == 0
    written = json.loads((tmp_path / "bench" / "bench.json").read_text())
    assert written["mjwarp_env_steps_per_s"] > 0
    assert written["device"] == str(resolve_device("auto"))
    done_in(page, "`pace bench`", started)


def test_predictor(tmp_path: Path, page: Page) -> None:
    started = time.perf_counter()
    assert command(predictor, *TINY, "samples=192", f"out={tmp_path / 'predictor'}") == 0
    done_in(page, "`pace predictor`", started)


def test_warm(capsys: pytest.CaptureFixture[str], page: Page) -> None:
    started = time.perf_counter()
    assert command(warm) == 0
    assert f"for {resolve_device('auto')}: kernels are in" in capsys.readouterr().out
    done_in(page, "`pace warm`", started)


@pytest.mark.parametrize("name", ["01_physics.ipynb", "02_policy.ipynb"])
def test_a_notebook(name: str, device: torch.device, page: Page) -> None:
    if device.type != "cuda":
        pytest.skip("tests/test_notebooks.py runs them on a CPU")
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    started = time.perf_counter()
    notebook = nbformat.read(ROOT / "notebooks" / name, as_version=4)
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(ROOT)}}).execute()
    done_in(page, name, started)
