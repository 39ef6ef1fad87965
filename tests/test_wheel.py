"""The wheel: what it carries, and that its commands run where there is no checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from pace.command.table import COMMANDS
from tests.helpers.outside import SMALL

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.long


def outside() -> dict[str, str]:
    """Variables of a process that does not know this checkout."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return environment | {"OMP_NUM_THREADS": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}


def run(*line: str | Path, folder: Path) -> str:
    """Standard output of a program in ``folder`` that does not know this checkout; it must end with status 0."""
    arguments = [str(part) for part in line]
    done = subprocess.run(arguments, cwd=folder, env=outside(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(arguments)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", ROOT, "--no-deps", "-w", folder, folder=folder)
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the programs of a fresh environment with the wheel; it borrows the dependencies of this one."""
    home = tmp_path_factory.mktemp("installed")
    venv.create(home, symlinks=True)
    python = home / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", wheel, folder=home)
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    own = Path(run(python, "-c", code, folder=home).strip())
    # a path in a .pth file comes after the environment's own packages, and .pth files in it are not read
    (own / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python.parent


@pytest.fixture
def empty(tmp_path: Path) -> Path:
    return tmp_path


def test_it_carries_the_package_its_configs_and_its_models_and_nothing_else(wheel: Path) -> None:
    names = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    configs = {f"pace/{path.relative_to(ROOT)}" for path in (ROOT / "configs").rglob("*.yaml")}
    sources = {str(path.relative_to(ROOT)) for path in (ROOT / "pace").rglob("*.py")}
    models = {str(path.relative_to(ROOT)) for path in (ROOT / "pace" / "sim" / "assets").glob("*.xml")}
    assert {"pace/sim/assets/scene.xml", "pace/sim/assets/t1_paddle.xml"} <= models
    assert "pace/configs/train.yaml" in configs
    policy = {f"pace/pretrained/campaign/{name}" for name in ("checkpoint.json", "weights.safetensors")}
    assert names == configs | sources | models | policy
    assert sum(part.compress_size for part in ZipFile(wheel).infolist()) < 5e6


def test_it_carries_its_licences(wheel: Path) -> None:
    with ZipFile(wheel) as opened:
        texts = {
            name.rsplit("/", 1)[1]: opened.read(name).decode() for name in opened.namelist() if "/licenses/" in name
        }
    assert set(texts) == {"LICENSE", "NOTICE"}
    for word in ("booster_gym", "booster_assets", "TTRL-ICRA2026", "BSD 3-Clause", "MIT License", "pretrained/"):
        assert word in texts["NOTICE"]


def test_its_command_is_pace(wheel: Path) -> None:
    with ZipFile(wheel) as opened:
        (name,) = (name for name in opened.namelist() if name.endswith("entry_points.txt"))
        assert "pace = pace.__main__:main" in opened.read(name).decode()


def test_the_package_of_the_environment_is_that_of_the_wheel(installed: Path, empty: Path) -> None:
    printed = run(installed / "python", "-c", "import pace, torch; print(pace.__file__)", folder=empty)
    assert Path(printed.strip()).is_relative_to(installed.parent)


def test_it_lists_its_commands(installed: Path, empty: Path) -> None:
    printed = run(installed / "pace", folder=empty)
    assert all(f"{name} " in printed for name in COMMANDS)
    assert "out" in run(installed / "pace", "export", "--help", folder=empty)


TABLE = (
    "rows=[mixed]", "serves=2", "num_worlds=2", "warmup_serves=0", "physics_dt=0.01", "progress=false", "first_ball=[]",
    "engine.threads=1",
)  # fmt: skip


def test_it_trains_evaluates_plays_and_exports_in_an_empty_folder(installed: Path, empty: Path) -> None:
    run(installed / "pace", "train", "out=run", *SMALL, folder=empty)
    assert (empty / "run" / "metrics.csv").is_file()
    run(installed / "pace", "evaluate", "run", "out=table", *TABLE, folder=empty)
    assert (empty / "table" / "evaluation.json").is_file()
    run(installed / "pace", "export", "run", "out=robot", "check_worlds=2", "check_steps=3", folder=empty)
    assert (empty / "robot" / "policy.onnx").is_file()
    assert {path.name for path in empty.iterdir()} == {"run", "table", "robot"}


def test_its_own_policy_evaluates_and_plays(installed: Path, empty: Path) -> None:
    run(installed / "pace", "evaluate", "campaign", "out=own", *TABLE, folder=empty)
    assert json.loads((empty / "own" / "evaluation.json").read_text())["rows"][0]["hit"] == 1.0
    small = ("seconds=0.2", "width=64", "height=64", "physics_dt=0.01")
    line = [str(installed / "pace"), "play", "--video", "film.webp", *small]
    done = subprocess.run(line, cwd=empty, capture_output=True, text=True, check=False, env=outside())
    assert (empty / "film.webp").is_file() or "apt install libegl1" in done.stderr, done.stderr


def test_the_source_archive_has_what_the_documentation_and_the_tests_need(tmp_path: Path) -> None:
    tools = tmp_path / "tools"
    run(sys.executable, "-m", "pip", "install", "--quiet", "--target", tools, "hatchling>=1.27", folder=tmp_path)
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from hatchling.build import build_sdist; build_sdist(sys.argv[2])"
    )
    run(sys.executable, "-c", code, tools, tmp_path, folder=ROOT)
    (file,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(file) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    wanted = {"NOTICE", "mkdocs.yml", "docs/index.md", "docs/hooks/reference.py", "notebooks/00_quickstart.ipynb"}
    assert wanted | {"tests/test_wheel.py", "configs/train.yaml", "pretrained/campaign/weights.safetensors"} <= names
