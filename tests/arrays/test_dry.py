"""A dry run does what the calls do, and names each thing that a CUDA graph could not hold."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor, nn

from pace.arrays.dry import Recording
from pace.arrays.gradients import Gradients
from pace.arrays.graph import CapturedCall, Graphs
from pace.arrays.launch import Bound, Launch
from pace.arrays.watch import DryRunError
from pace.runs.optimiser import adam, learning_rate

CPU = torch.device("cpu")
HERE = re.escape(__file__)


def captured(function: Callable[..., None]) -> CapturedCall:
    return CapturedCall(function, CPU, Graphs.DRY)


@wp.kernel
def _scale(values: wp.array[float], factor: float, scaled: wp.array[float]):
    scaled[wp.tid()] = factor * values[wp.tid()]


@wp.kernel(module="unique")
def _late(values: wp.array[float]):
    values[wp.tid()] = 1.0


class Fit:
    """A network that is fitted to random samples, on the way that the learners take."""

    def __init__(self) -> None:
        torch.manual_seed(1)
        self.network = nn.Sequential(nn.Linear(4, 8), nn.ELU(inplace=True), nn.Linear(8, 1))
        parameters = list(self.network.parameters())
        self.gradients, self.optimiser = Gradients(parameters), adam(parameters, 0.1)
        self.gradients.hold()
        self.generator = torch.Generator().manual_seed(2)
        self.loss = torch.zeros(())

    def step(self) -> None:
        x = torch.rand(16, 4, generator=self.generator)
        loss = (self.network(x) - x.sum(1, keepdim=True)).square().mean()
        self.gradients.zero_()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        learning_rate(self.optimiser).mul_(0.99)
        self.loss.copy_(loss.detach())


@pytest.mark.parametrize("autocast", [False, True])
def test_a_replayed_fit_is_the_fit(autocast: bool) -> None:
    plain, replayed = Fit(), Fit()
    call = captured(replayed.step)
    for _ in range(9):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
            plain.step()
            call()
        for mine, theirs in zip(replayed.network.parameters(), plain.network.parameters(), strict=True):
            assert torch.equal(mine, theirs)
        assert replayed.loss == plain.loss
    assert plain.loss < 1.0  # 4 to begin with


def test_launches_copies_and_memory_of_warp_are_replayed() -> None:
    values, total = torch.arange(3.0), torch.zeros(3)
    found = torch.zeros(3)

    def function() -> None:
        scratch = wp.zeros(3, dtype=float, device="cpu")
        wp.launch(_scale, 3, [wp.from_torch(values), 2.0, scratch], device="cpu")
        wp.copy(wp.from_torch(found), scratch)
        values.add_(1.0)
        total.add_(found)

    call, expected = captured(function), torch.zeros(3)
    for k in range(7):
        call()
        expected += 2.0 * (torch.arange(3.0) + k)
        assert torch.equal(total, expected)


def test_python_runs_in_every_second_call_only() -> None:
    calls: list[None] = []
    call = captured(lambda: calls.append(None))
    counts = []
    for _ in range(8):
        call()
        counts.append(len(calls))
    assert counts == [1, 2, 3, 3, 4, 4, 5, 5]  # as it is, recorded, compared, not at all, compared, ...


class Planted:
    """Calls of ``work`` with a counter, which the fault may depend on."""

    def __init__(self) -> None:
        self.values, self.other = torch.arange(1.0, 4.0), torch.ones(3)
        self.out = torch.zeros(3)
        self.generator = torch.Generator()
        self.launch = Bound(self._bind, factor=None)
        self.count = 0

    def _bind(self, factor: float) -> Launch:
        return Launch(_scale, 3, CPU, values=self.values, factor=factor, scaled=self.out)

    def changing(self) -> Tensor:
        """Another tensor from the third call on."""
        return self.values if self.count < 3 else self.other

    def scale(self, values: Tensor, threads: int = 3) -> None:
        arrays = [wp.from_torch(values), 1.0, wp.from_torch(self.out)]
        wp.launch(_scale, threads, arrays, device="cpu")

    def run(self, work: Callable[[Planted], Any]) -> None:
        def function() -> None:
            self.count += 1
            work(self)

        call = captured(function)
        for _ in range(6):
            call()


def _another_order(p: Planted) -> None:
    for work in (p.values.neg_, p.values.abs_)[:: 1 if p.count < 3 else -1]:
        work()


FAULTS: dict[str, tuple[Callable[[Planted], Any], str]] = {
    "item": (lambda p: p.values.sum().item(), "the host reads a tensor"),
    "bool": (lambda p: bool(p.values.any()), "the host reads a tensor"),
    "nonzero": (lambda p: p.values.nonzero(), "the host reads a tensor"),
    "boolean index": (lambda p: p.values[p.values > 1.0], "the host reads a tensor"),
    "masked select": (lambda p: p.values.masked_select(p.values > 1.0), "the host reads a tensor"),
    "written index": (lambda p: p.values.index_put_((p.values > 1.0,), torch.ones(())), "the host reads a tensor"),
    "numpy": (lambda p: p.values.numpy(), r"reads or waits \(Tensor\.numpy\)"),
    "tolist": (lambda p: p.values.tolist(), r"reads or waits \(Tensor\.tolist\)"),
    "cpu": (lambda p: p.values.cpu(), r"reads or waits \(Tensor\.cpu\)"),
    "warp's numpy": (lambda p: wp.from_torch(p.values).numpy(), r"reads or waits \(array\.numpy\)"),
    "wait": (lambda _: wp.synchronize(), r"reads or waits \(warp\.synchronize\)"),
    "tensor of Python": (lambda p: p.out.copy_(torch.tensor([1.0, 2.0, 3.0])), "a value of the host becomes"),
    "number": (lambda p: p.values.add_(float(p.count)), r"add_\.Tensor is given 3\.0 in place of 2\.0"),
    "filled number": (lambda p: p.values.fill_(p.count), r"fill_\.Scalar is given 3 in place of 2"),
    "moved tensor": (lambda p: p.changing().add_(1.0), r"add_\.Tensor is given another tensor of shape \(3,\)"),
    "moved source": (lambda p: p.out.copy_(p.changing()), r"copy_\.default is given another"),
    "shape": (lambda p: p.values[: p.count].clone(), r"slice\.Tensor is given 3 in place of 2"),
    "order": (_another_order, r"abs_\.default comes where aten\.neg_\.default of .* was recorded"),
    "one more": (lambda p: [p.values.neg_() for _ in range(p.count)], "comes after the last step"),
    "one less": (lambda p: [p.values.neg_() for _ in range(9 - p.count)], "was recorded, and does not come"),
    "generator": (lambda p: p.out.normal_(generator=torch.Generator()), "is given another Generator"),
    "number of a launch": (lambda p: p.launch(float(p.count))(), r"kernel _scale is given 3\.0 .* as 'factor'"),
    "array of a launch": (lambda p: p.scale(p.changing()), "_scale is given other memory .* as 'values'"),
    "threads": (lambda p: p.scale(p.values, min(p.count, 3)), "_scale is given other .* as 'the number of threads'"),
    "copy": (
        lambda p: wp.copy(wp.from_torch(p.out), wp.from_torch(p.changing())),
        r"warp\.copy is given another tensor",
    ),
    "more memory": (lambda p: wp.zeros(p.count, dtype=float, device="cpu"), "Warp allocates 12 bytes"),
    "late kernel": (
        lambda p: wp.launch(_late, 3, [wp.from_torch(p.values)], device="cpu") if p.count > 1 else None,
        "is loaded in a call that a graph would hold",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named_with_its_line(fault: str) -> None:
    work, words = FAULTS[fault]
    where = r"pace/arrays/launch\.py" if fault == "number of a launch" else HERE
    with pytest.raises(DryRunError, match=rf"{where}:\d+: .*{words}"):
        Planted().run(work)


def test_what_is_the_same_each_time_is_no_fault() -> None:
    Planted().run(lambda p: p.launch(2.0)())
    Planted().run(lambda p: p.out.copy_(p.values.sum(0, keepdim=True).expand(3)))
    Planted().run(lambda p: torch.cat([p.values[:1], p.other.split(2)[0]], out=p.out))
    Planted().run(lambda p: p.out.normal_(generator=p.generator))
    Planted().run(lambda p: p.out.fill_(float("nan")))


def test_memory_stays_where_it_was_recorded() -> None:
    """Without that, tensors that came later would lie where the recording writes."""
    values, made = torch.zeros(1000), []

    def function() -> None:
        doubled = 2.0 * values
        made.append(doubled.data_ptr())
        values.copy_(doubled + 1.0)

    call = captured(function)
    for _ in range(3):
        call()
    others = [torch.full((1000,), 7.0) for _ in range(20)]
    assert made[1] == made[2]  # recorded and compared: the same
    for _ in range(3):
        call()
    assert all(bool((other == 7.0).all()) for other in others)
    assert values[0] == 2.0**6 - 1.0


@pytest.fixture
def blocks() -> Iterator[list[int]]:
    """Addresses that Warp's memory is freed at."""
    from pace.arrays.dry_warp import _Memory

    freed: list[int] = []
    source = wp.get_device("cpu").default_allocator
    deallocate = source.deallocate

    def noted(address: int, size: int) -> None:
        freed.append(address)
        deallocate(address, size)

    source.deallocate = noted
    assert _Memory.deallocate_requires_context_guard is False
    yield freed
    del source.deallocate


def test_warps_memory_is_freed_with_the_recording(blocks: list[int]) -> None:
    recording = Recording(lambda: wp.zeros(3, dtype=float, device="cpu"), ())
    recording.replay()
    recording.replay()
    assert not blocks
    del recording
    assert len(blocks) == 1
