"""Several processes that train one policy together: who they are, and what they average, add up and gather.

Each process plays worlds of its own and holds the same networks. What they learn from is averaged over them, so their
weights stay equal, bit for bit. Processes are either started by :func:`team_of` on this machine, or by ``torchrun`` on
one machine or several. torch.distributed carries it: gloo between CPUs, nccl between GPUs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from threading import Thread
from typing import IO, Any, TypeVar

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from pace.devices import threads_of, usable_cores

T = TypeVar("T")

WORLDS_PER_PROCESS = 256  # with fewer, the fixed cost of each operation outweighs what another process gains
LOCAL_ADDRESS = "127.0.0.1"
MEMBERSHIP = "PACE_TEAM"  # environment variable of a helper process: its rank, the team's size, the leader's port
SECONDS_TO_END = 10.0  # for a helper whose leader is done
LEADER_IS_GONE = 3  # exit status of a helper
SECONDS_TO_FAIL = 3.0  # between a lost connection and the end of the process behind it
POLL_SECONDS = 0.05
TAIL_LINES = 15  # of what a failed helper printed


class TeamError(RuntimeError):
    """A process of the team failed or cannot be reached; the message holds the end of what it printed."""


class Team:
    """This process's place among ``size`` processes. A team of one does nothing, at no cost.

    Every collective method must be called by all processes of the team in the same order.
    """

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    @property
    def leads(self) -> bool:
        """This process decides, prints and writes the files."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """A seed of this process's own: ``seed`` itself for the leader, one drawn from both numbers for the others."""
        if self.leads:
            return seed
        return int(np.random.SeedSequence([seed, self.rank]).generate_state(1)[0])

    def mean_(self, tensors: Sequence[Tensor]) -> None:
        """Replace each float32 tensor by its mean over the team, all in one message."""
        self.mean_later(tensors)()

    def mean_later(self, tensors: Sequence[Tensor]) -> Callable[[], None]:
        """Send ``tensors``; calling what is returned replaces each by its mean over the team."""
        if self.size == 1:
            return lambda: None
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        work = dist.all_reduce(flat, async_op=True)
        assert work is not None  # None is for processes outside the group

        def finish() -> None:
            work.wait()
            parts = flat.div_(self.size).split([tensor.numel() for tensor in tensors])
            for tensor, part in zip(tensors, parts, strict=True):
                tensor.copy_(part.view_as(tensor))

        return finish

    def sum_(self, tensor: Tensor) -> Tensor:
        """Replace ``tensor`` by its sum over the team, and return it."""
        if self.size > 1:
            dist.all_reduce(tensor)
        return tensor

    def follow_(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by the leader's."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)

    def decided(self, value: T) -> T:
        """The leader's ``value``."""
        if self.size == 1:
            return value
        box = [value]
        dist.broadcast_object_list(box, 0)
        return box[0]

    def gather(self, value: T) -> list[T]:
        """Every process's ``value``, in the order of ranks, on every process."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        dist.all_gather_object(values, value)
        return values


def suitable_size(num_worlds: int, device: torch.device) -> int:
    """Processes to share ``num_worlds`` on this machine: one a core, with at least 256 worlds each; one for a GPU."""
    if device.type != "cpu":
        return 1
    most = min(usable_cores(), num_worlds // WORLDS_PER_PROCESS)
    return max((size for size in range(1, most + 1) if num_worlds % size == 0), default=1)


@contextmanager
def team_of(size: int, device: torch.device, arguments: Sequence[str] | None = None) -> Iterator[Team]:
    """The team of this process while the block runs: the one that it was started in, or a new one of ``size``.

    A new team runs this very command, with its own or other ``arguments``, in ``size - 1`` helper processes, each on
    its share of the cores. Errors: :class:`TeamError` when one of them fails, and for more than one on a GPU.
    """
    membership = os.environ.get(MEMBERSHIP)
    if size > 1 and device.type == "cuda" and not under_torchrun():
        raise TeamError(
            f"{size} processes cannot share a GPU: torchrun --nproc-per-node={size} starts one for each GPU"
        )
    if membership:
        Thread(target=_end_with_leader, daemon=True).start()
        rank, size, port = (int(part) for part in membership.split())
        store = dist.TCPStore(LOCAL_ADDRESS, port, is_master=False)
        store.set(f"here/{rank}", "")
        with _connected(device, store=store, rank=rank, world_size=size):
            yield Team(rank, size)
    elif under_torchrun():
        with _connected(device):
            yield Team(dist.get_rank(), dist.get_world_size())
    elif size == 1:
        yield Team()
    else:
        threads = threads_of(size)
        torch.set_num_threads(threads)
        store = dist.TCPStore(LOCAL_ADDRESS, 0, is_master=True, wait_for_workers=False)
        with _Helpers(size, store.port, threads, sys.argv[1:] if arguments is None else arguments) as helpers:
            helpers.wait_for(store)
            with _connected(device, store=store, rank=0, world_size=size), helpers.explaining():
                yield Team(0, size)


def under_torchrun() -> bool:
    """Whether ``torchrun`` started this process; it then says how many there are."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def own_device(device: str) -> str:
    """``device``; under ``torchrun``, for ``cuda`` and ``auto``, the GPU of this process's number on its machine."""
    if under_torchrun() and device in ("auto", "cuda") and torch.cuda.is_available():
        return f"cuda:{os.environ['LOCAL_RANK']}"
    return device


@contextmanager
def _connected(device: torch.device, **place: Any) -> Iterator[None]:
    """torch.distributed, ready for CPU tensors and those on ``device``."""
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group("gloo" if device.type == "cpu" else "cpu:gloo,cuda:nccl", **place)
    try:
        yield
    finally:
        dist.destroy_process_group()


class _Helpers:
    """The other processes of a team that this one leads. They end with the block; what they print goes to a file."""

    def __init__(self, size: int, port: int, threads: int, arguments: Sequence[str]) -> None:
        self._open = ExitStack()
        self._logs: dict[int, IO[str]] = {}
        self._started: dict[int, subprocess.Popen[str]] = {}
        for rank in range(1, size):
            log = self._open.enter_context(tempfile.TemporaryFile("w+"))  # noqa: SIM115  # the stack closes it
            self._logs[rank] = log
            environment = {MEMBERSHIP: f"{rank} {size} {port}", "OMP_NUM_THREADS": str(threads)}
            self._started[rank] = _start(arguments, log, environment)

    def __enter__(self) -> _Helpers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for process in self._started.values():
            try:
                process.wait(SECONDS_TO_END if kind is None else 0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._open.close()

    def wait_for(self, store: dist.Store) -> None:
        """Return when all have arrived at ``store``."""
        for rank in self._started:
            while not store.check([f"here/{rank}"]):
                self._require_none_failed(0.0)
                time.sleep(POLL_SECONDS)

    @contextmanager
    def explaining(self) -> Iterator[None]:
        """Turn an error of torch.distributed into a :class:`TeamError` where a helper that failed is its cause."""
        try:
            yield
        except RuntimeError as error:
            if type(error) in (RuntimeError, dist.DistBackendError, dist.DistNetworkError):  # not one of this project's
                self._require_none_failed(SECONDS_TO_FAIL, error)
            raise

    def _require_none_failed(self, patience: float, cause: Exception | None = None) -> None:
        """Errors: :class:`TeamError` when a helper has ended, or ends within ``patience`` seconds."""
        deadline = time.monotonic() + patience
        while True:
            for rank, process in self._started.items():
                if process.poll() is not None:
                    self._logs[rank].seek(0)
                    tail = "\n".join(self._logs[rank].read().splitlines()[-TAIL_LINES:])
                    status = f"process {rank} of {len(self._started) + 1} ended with status {process.returncode}"
                    raise TeamError(f"{status}:\n{tail}") from cause
            if time.monotonic() >= deadline:
                return
            time.sleep(POLL_SECONDS)


def _end_with_leader() -> None:
    """In a helper: wait for the end of the leader, however it comes, and end with it."""
    sys.stdin.buffer.read()  # it writes nothing; its end of the pipe closes with it
    os._exit(LEADER_IS_GONE)


def _start(arguments: Sequence[str], log: IO[str], environment: dict[str, str]) -> subprocess.Popen[str]:
    """This command once more. A group of its own keeps the terminal's Ctrl-C from it: the leader ends the run."""
    module = sys.modules["__main__"].__spec__
    program = ["-m", module.name] if module else [sys.argv[0]]
    return subprocess.Popen(
        [sys.executable, *program, *arguments],
        env=os.environ | environment,
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        process_group=0,
        text=True,
    )
