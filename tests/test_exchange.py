"""The memory that processes of one machine share: sums of real processes, in order, and one that is gone."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

import pytest
import torch

from pace.exchange import CAPACITY, MOST, OUTSTANDING, Exchange, Shared

#: A process that sends made-up vectors, often two before it receives the first, and prints the sum of what it received.
MEMBER = textwrap.dedent(
    """
    import sys, time, torch
    from pace.exchange import Exchange, Shared
    rank, rounds = (int(text) for text in sys.argv[1:3])
    shared = Shared.inherited(sys.argv[3])
    exchange = Exchange(rank, shared)
    generator = torch.Generator().manual_seed(rank)
    for index in range(rounds):
        if (index + rank) % 7 == 0:
            time.sleep(0.001)
        first = torch.randn(1 + 37 * index, generator=generator)
        second = torch.randn(5, 3, generator=generator, dtype=torch.float64)
        receive_first, receive_second = exchange.send(first), exchange.send(second)
        receive_first()
        receive_second()
        print(first.double().sum().item().hex(), second.sum().item().hex())
    """
)


def expected(size: int, rounds: int) -> list[str]:
    generators = [torch.Generator().manual_seed(rank) for rank in range(size)]
    lines = []
    for index in range(rounds):
        first, second = torch.zeros(1 + 37 * index), torch.zeros(5, 3, dtype=torch.float64)
        for generator in generators:  # x + 0 is x: the sum begins with the first process
            first += torch.randn(first.shape, generator=generator)
            second += torch.randn(second.shape, generator=generator, dtype=torch.float64)
        lines.append(" ".join(float(part.double().sum()).hex() for part in (first, second)))
    return lines


@pytest.mark.parametrize("size", [2, 3])
def test_every_process_receives_the_same_sums_bit_for_bit(size: int) -> None:
    rounds, shared = 60, Shared.open(size)
    command = [sys.executable, "-c", MEMBER]
    members = [
        subprocess.Popen(
            [*command, str(rank), str(rounds), shared.describe()],
            pass_fds=shared.numbers(),
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank in range(size)
    ]
    shared.close()
    outputs = [member.communicate(timeout=60)[0].splitlines() for member in members]
    assert [member.returncode for member in members] == [0] * size
    assert outputs == [expected(size, rounds)] * size


def alone(shared: Shared, **kwargs: object) -> Exchange:
    return Exchange(0, shared, **kwargs)  # type: ignore[arg-type]


def test_who_waits_for_a_process_that_is_gone_is_told() -> None:
    class GoneError(Exception):
        pass

    def somebody_failed() -> None:
        raise GoneError

    receive = alone(Shared.open(2), require_all=somebody_failed).send(torch.ones(3))
    with pytest.raises(GoneError):
        receive()


def test_a_sum_is_that_of_its_own_message_although_later_ones_are_sent() -> None:
    shared = Shared.open(2)
    mine, theirs = alone(shared), Exchange(1, shared)
    for start in range(0, 40, OUTSTANDING):
        sent = [
            [torch.full((4,), float(index + shift)) for index in range(start, start + OUTSTANDING)]
            for shift in (0, 100)
        ]
        receives = [
            [side.send(tensor) for tensor in tensors] for side, tensors in zip((mine, theirs), sent, strict=True)
        ]
        for receive in receives[1] + receives[0]:
            receive()
        for index, (left, right) in enumerate(zip(*sent, strict=True)):
            assert left.tolist() == right.tolist() == [2.0 * (start + index) + 100.0] * 4


def test_what_does_not_fit_is_not_taken() -> None:
    exchange = alone(Shared.open(2))
    assert exchange.takes(torch.zeros(CAPACITY // 4))
    assert not exchange.takes(torch.zeros(CAPACITY // 4 + 1))
    assert not exchange.takes(torch.zeros(4, 4).t())
    for _ in range(OUTSTANDING):
        exchange.send(torch.zeros(1))
    assert not exchange.takes(torch.zeros(1))


def test_files_close() -> None:
    before = set(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else set()
    Shared.open(MOST // 64).close()
    after = set(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else set()
    assert after == before
