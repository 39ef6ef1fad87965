"""Devices that are not there, or that torch or Warp cannot use: named at the start, with the cure."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch

from pace import devices
from pace.config.base import ConfigError
from pace.devices import (
    Card,
    SeenByTorch,
    SeenByWarp,
    full_memory_in_words,
    has_code_for,
    out_of_memory,
    resolve_device,
)

H200 = Card("NVIDIA H200", (9, 0), ("sm_80", "sm_90", "sm_120"))
WARP = SeenByWarp("1.19.0", (13, 4), (13, 0), 2, 75)  # a driver of the same generation is new enough


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Makes this machine one with GPUs: what torch, Warp and the driver's files say of them."""

    def of(count: int = 2, cuda: str | None = "13.0", card: Card = H200, warp: SeenByWarp = WARP, driver: bool = True):
        devices.require_usable.cache_clear()
        devices._say.cache_clear()
        monkeypatch.setattr(devices, "seen_by_torch", lambda: SeenByTorch("2.13.0", cuda, count))
        monkeypatch.setattr(devices, "card", lambda _: card)
        monkeypatch.setattr(devices, "seen_by_warp", lambda: warp)
        monkeypatch.setattr(devices, "has_driver", lambda: driver)

    monkeypatch.delenv(devices.VISIBLE, raising=False)
    yield of
    devices.require_usable.cache_clear()
    devices._say.cache_clear()


def test_a_gpu_that_can_be_used_is_taken(machine: Callable[..., None]) -> None:
    machine()
    assert resolve_device("auto") == torch.device("cuda", 0)
    assert resolve_device("cuda") == torch.device("cuda", 0)
    assert resolve_device("cuda:1") == torch.device("cuda", 1)
    assert resolve_device("cpu") == torch.device("cpu")


def test_a_gpu_that_is_not_there(machine: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    machine(count=1)
    with pytest.raises(ConfigError, match=r"device cuda:1 is not there: torch sees 1 GPU\(s\); use device=cpu"):
        resolve_device("cuda:1")
    monkeypatch.setenv(devices.VISIBLE, "1")
    with pytest.raises(ConfigError, match=r"torch sees 1 GPU\(s\) \(CUDA_VISIBLE_DEVICES=1\); use device=cpu"):
        resolve_device("cuda:1")
    machine(count=0)
    with pytest.raises(ConfigError, match=r"0 GPU\(s\): CUDA_VISIBLE_DEVICES=1 names none of its GPUs \(unset it\)"):
        resolve_device("cuda")


@pytest.mark.parametrize(
    ("cuda", "driver", "reason"),
    [
        (None, True, r"torch 2\.13\.0 is built without CUDA \(pip install torch --index-url"),
        ("13.0", False, "no NVIDIA driver is loaded"),
        ("13.0", True, r"its driver may be too old for CUDA 13\.0 of torch 2\.13\.0"),
    ],
)
def test_why_torch_sees_none(
    machine: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
    cuda: str | None,
    driver: bool,
    reason: str,
) -> None:
    machine(count=0, cuda=cuda, driver=driver)
    with pytest.raises(ConfigError, match=f"device cuda is not there: torch sees 0 GPU.*{reason}.*; use device=cpu"):
        resolve_device("cuda")
    for _ in range(2):  # the line comes once
        assert resolve_device("auto") == torch.device("cpu")
    said = capsys.readouterr().err.splitlines()
    assert len(said) == driver
    if driver:
        assert said[0].startswith("warning: device=auto is the CPU, though a GPU's driver is here: ")


def test_hidden_gpus_are_meant(
    machine: Callable[..., None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine(count=0)
    monkeypatch.setenv(devices.VISIBLE, "")
    assert resolve_device("auto") == torch.device("cpu")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("warp", "reason"),
    [
        (
            WARP._replace(driver=(12, 8), count=0),
            r"the driver \(CUDA 12\.8\) is older than Warp's toolkit \(CUDA 13\.4\): update the driver, or install",
        ),
        (WARP._replace(toolkit=None, driver=None, count=0), "it is built without CUDA"),
        (WARP._replace(count=1), r"it sees 1 GPU\(s\)"),
        (WARP._replace(oldest=100), r"its toolkit \(CUDA 13\.4\) begins at sm_100"),
    ],
)
def test_a_gpu_that_warp_cannot_use(machine: Callable[..., None], warp: SeenByWarp, reason: str) -> None:
    """Warp alone would go to the CPU in silence."""
    machine(warp=warp)
    text = rf"cuda:1 \(NVIDIA H200, sm_90\): torch can use it and Warp 1\.19\.0 cannot: {reason}.*; use device=cpu"
    with pytest.raises(ConfigError, match=text):
        resolve_device("cuda:1")


def test_a_card_for_which_torch_has_no_code(machine: Callable[..., None]) -> None:
    machine(card=Card("NVIDIA RTX 5090", (12, 0), ("sm_80", "sm_90")))
    text = r"cuda:0 \(NVIDIA RTX 5090, sm_120\): torch .* has no code for it \(sm_80, sm_90\): another torch has"
    with pytest.raises(ConfigError, match=text):
        resolve_device("auto")


@pytest.mark.parametrize(
    ("capability", "built_for", "runs"),
    [
        ((8, 9), ("sm_80",), True),  # the same generation
        ((8, 0), ("sm_86",), False),
        ((9, 0), ("sm_80",), False),
        ((9, 0), ("sm_80", "compute_80"), True),  # PTX, compiled by the driver
        ((9, 0), ("sm_90a",), True),
        ((12, 1), ("sm_120",), True),
        ((12, 1), ("sm_120a",), False),
        ((9, 0), ("gfx942",), True),  # AMD's: nothing is known
        ((9, 0), (), True),
    ],
)
def test_code_for_a_card(capability: tuple[int, int], built_for: tuple[str, ...], runs: bool) -> None:
    assert has_code_for(Card("card", capability, built_for)) is runs


def test_a_full_memory_is_told_from_other_errors() -> None:
    full = (
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        RuntimeError("Failed to allocate 4194304 bytes on device 'cuda:0'"),
    )
    other = (
        RuntimeError("Failed to allocate 64 bytes on device 'cuda:0':  Failed to allocate memory during graph capture "
                     "because memory pools are not enabled on device 'cuda:0'."),
        RuntimeError("Failed to allocate 4194304 bytes on device 'cpu'"),
        ValueError("CUDA error: out of memory"),
    )  # fmt: skip
    assert [out_of_memory(error) for error in (*full, *other)] == [True, True, False, False, False]


def test_the_memory_is_that_of_the_gpu_that_was_full(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {None: 8, "cuda:0": 24, "cuda:1": 80, "cuda:12": 12}
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda on: (2**29, sizes[on and str(on)] * 2**30))
    runs = torch.device("cuda:0")
    for error, size in (
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9.00 GiB. GPU 1 has a total capacity of"), 80),
        (RuntimeError("Failed to allocate 4194304 bytes on device 'cuda:12'"), 12),
        (RuntimeError("CUDA error: out of memory"), 24),
    ):
        assert out_of_memory(error)
        assert full_memory_in_words(error, runs).startswith(f"the GPU's memory is full ({size}.0 GiB, 0.5 free): by")
    assert "(8.0 GiB" in full_memory_in_words(RuntimeError("CUDA error: out of memory"))  # torch's current one
