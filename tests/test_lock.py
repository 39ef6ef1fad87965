"""The lock: every dependency pinned with hashes, a CPU build of torch on this disk included; installed as it says."""

from __future__ import annotations

import hashlib
import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

packaging = pytest.importorskip("packaging.requirements")

ROOT = Path(__file__).resolve().parent.parent
HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})\b")
#: Where this project's machines keep builds of torch without CUDA, which pip prefers to those of PyPI.
WHEELS = Path("/opt/wheels")


def entries(name: str) -> dict[str, tuple[str, set[str]]]:
    """Requirement and hashes of each package of a lock, by its normalised name."""
    text = (ROOT / name).read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    found = {}
    for line in lines:
        requirement = line.split("--hash")[0].strip()
        found[normal(packaging.Requirement(requirement).name)] = (requirement, set(HASH.findall(line)))
    assert len(found) == len(lines)
    return found


#: Extras that bring many packages which no run needs.
NOT_LOCKED = {"wandb"}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-cuda.lock"])
def test_every_package_has_one_version_and_its_hashes(name: str) -> None:
    for package, (requirement, hashes) in entries(name).items():
        (pin,) = packaging.Requirement(requirement).specifier
        assert (pin.operator, "*" in pin.version) == ("==", False), package
        assert hashes, package
    assert not re.search(r"https?://|file:", (ROOT / name).read_text())


def test_what_the_project_needs_is_locked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {name: needed for name, needed in project["optional-dependencies"].items() if name not in NOT_LOCKED}
    needed = [*project["dependencies"], *(one for extra in extras.values() for one in extra)]
    locked = entries("requirements.lock")
    for text in needed:
        wanted = packaging.Requirement(text)
        (pin,) = packaging.Requirement(locked[normal(wanted.name)][0]).specifier
        assert wanted.specifier.contains(pin.version), text
    assert {"imageio", "imageio-ffmpeg", "setuptools"} <= set(locked)


def test_torch_of_the_figures_of_a_gpu_is_admitted() -> None:
    """docs/results/gpu.md: 2.11; requirements.lock: 2.13."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (torch,) = (packaging.Requirement(text) for text in project["dependencies"] if text.startswith("torch>"))
    assert [torch.specifier.contains(version) for version in ("2.11.0", "2.13.0", "2.14.0")] == [True, True, False]


def test_a_gpus_libraries_are_apart() -> None:
    cuda = entries("requirements-cuda.lock")
    assert not set(cuda) & set(entries("requirements.lock"))
    assert all(package.startswith(("nvidia-", "cuda-", "triton")) for package in cuda)
    assert "nvidia-cublas" in cuda


def test_a_build_of_torch_on_this_disk_is_one_of_its_files() -> None:
    requirement, hashes = entries("requirements.lock")["torch"]
    builds = list(WHEELS.glob(f"torch-{requirement.split('==')[1]}+cpu-*.whl"))
    if not builds:
        pytest.skip(f"no CPU build of torch in {WHEELS}")
    for build in builds:
        with build.open("rb") as file:
            assert hashlib.file_digest(file, "sha256").hexdigest() in hashes
    assert len(hashes) > 10  # those of PyPI, for all versions of Python


def test_the_environment_is_the_locked_one() -> None:
    """Otherwise: ``make venv``."""
    wrong = {}
    for package, (requirement, _) in entries("requirements.lock").items():
        locked = packaging.Requirement(requirement)
        if locked.marker is not None and not locked.marker.evaluate():
            continue
        try:
            there = version(package).partition("+")[0]
        except PackageNotFoundError:
            there = "none"
        if not locked.specifier.contains(there):
            wrong[package] = there
    assert wrong == {}
