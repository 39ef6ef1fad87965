"""The process group that trains one policy: its ranks and its collective operations.

Each process simulates separate worlds and holds the same networks. Gradients are averaged over the group, so the
weights stay equal, bit for bit. Processes are started by :func:`process_group` on this machine, or by ``torchrun`` on
one machine or several. Communication is torch.distributed: gloo between CPUs, nccl between GPUs; sums of processes that
:func:`process_group` starts go through memory that they share (:mod:`pace.exchange`).
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

from pace.config.automatic import SHARE_OF_MEMORY, memory_needed
from pace.cores import threads_of, usable_cores
from pace.exchange import MOST, Exchange, Shared
from pace.memory import available_memory

T = TypeVar("T")

WORLDS_PER_PROCESS = 256  # with fewer, the fixed cost of each operation outweighs what another process gains
LOCAL_ADDRESS = "127.0.0.1"
MEMBERSHIP = "PACE_PROCESS_GROUP"  # environment variable of a worker: its rank, the group's size, rank 0's port
SHARED = "PACE_SHARED"  # likewise: the files of Shared that it inherits
SECONDS_TO_END = 10.0  # for a worker after rank 0 is done
RANK_0_IS_GONE = 3  # exit status of a worker
SECONDS_TO_FAIL = 3.0  # between a lost connection and the end of the process behind it
POLL_SECONDS = 0.05
TAIL_LINES = 15  # of the output of a failed worker


class ProcessGroupError(RuntimeError):
    """A process of the group failed or cannot be reached; the message holds the end of its output."""


class ProcessGroup:
    """This process's rank among ``size`` processes. In a group of one, each collective method is free and does nothing.

    All processes of the group must call the collective methods in the same order.
    """

    def __init__(self, rank: int = 0, size: int = 1, exchange: Exchange | None = None) -> None:
        self.rank, self.size = rank, size
        self._exchange = exchange

    @property
    def is_rank_0(self) -> bool:
        """Whether this is rank 0, which decides, prints and writes the files."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """A separate seed for each process: rank 0 keeps ``seed``, the others derive theirs from ``seed`` and rank."""
        if self.is_rank_0:
            return seed
        return int(np.random.SeedSequence([seed, self.rank]).generate_state(1)[0])

    def all_reduce_mean_(self, tensors: Sequence[Tensor]) -> None:
        """Replace each float32 tensor by its mean over the group, all in one message."""
        self.all_reduce_mean_later(tensors)()

    def all_reduce_mean_later(self, tensors: Sequence[Tensor]) -> Callable[[], None]:
        """Send ``tensors``; calling the returned function replaces each by its mean over the group.

        A single tensor, which must be contiguous, is sent from where it lies, and must not change meanwhile.
        """
        if self.size == 1:
            return lambda: None
        alone = len(tensors) == 1
        flat = tensors[0].view(-1) if alone else torch.cat([tensor.reshape(-1) for tensor in tensors])
        receive = self._sum_later(flat)

        def finish() -> None:
            receive()
            parts = flat.div_(self.size).split([tensor.numel() for tensor in tensors])
            for tensor, part in () if alone else zip(tensors, parts, strict=True):
                tensor.copy_(part.view_as(tensor))

        return finish

    def all_reduce_sum_(self, tensor: Tensor) -> Tensor:
        """Replace ``tensor`` by its sum over the group, and return it."""
        if self.size > 1:
            self._sum_later(tensor)()
        return tensor

    def _sum_later(self, tensor: Tensor) -> Callable[[], object]:
        """Send a tensor; calling the returned function replaces it by its sum over the group."""
        if self._exchange is not None and self._exchange.takes(tensor):
            return self._exchange.send(tensor)
        work = dist.all_reduce(tensor, async_op=True)
        assert work is not None  # None is for processes outside the group
        return work.wait

    def broadcast_(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by that of rank 0."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)

    def broadcast_object(self, value: T) -> T:
        """The ``value`` of rank 0, on every process."""
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
    """Processes to share ``num_worlds`` on this machine: one a core, with at least 256 worlds each, that fit into its
    memory; one for a GPU."""
    if device.type != "cpu":
        return 1
    most = min(usable_cores(), num_worlds // WORLDS_PER_PROCESS)
    memory = SHARE_OF_MEMORY * available_memory()
    sizes = (size for size in range(1, most + 1) if memory_needed(num_worlds, size) <= memory)
    return max((size for size in sizes if num_worlds % size == 0), default=1)


@contextmanager
def process_group(size: int, device: torch.device, command: Sequence[str] | None = None) -> Iterator[ProcessGroup]:
    """The process group while the block runs: the one that this process was started in, or a new one of ``size``.

    A new group runs the same command, or ``command`` (arguments of Python), in ``size - 1`` worker processes, each on
    its share of the cores. Errors: :class:`ProcessGroupError` when one of them fails, or if ``size`` > 1 on a GPU.
    """
    membership = os.environ.get(MEMBERSHIP)
    if size > 1 and device.type == "cuda" and not under_torchrun():
        raise ProcessGroupError(
            f"{size} processes cannot share a GPU: torchrun --nproc-per-node={size} starts one for each GPU"
        )
    if membership:
        Thread(target=_end_with_rank_0, daemon=True).start()
        rank, size, port = (int(part) for part in membership.split())
        store = dist.TCPStore(LOCAL_ADDRESS, port, is_master=False)
        store.set(f"here/{rank}", "")
        shared = Shared.inherited(os.environ[SHARED]) if SHARED in os.environ else None
        with _connected(device, store=store, rank=rank, world_size=size):
            yield ProcessGroup(rank, size, Exchange(rank, shared) if shared else None)
    elif under_torchrun():
        with _connected(device):
            yield ProcessGroup(dist.get_rank(), dist.get_world_size())
    elif size == 1:
        yield ProcessGroup()
    else:
        threads = threads_of(size)
        torch.set_num_threads(threads)
        store = dist.TCPStore(LOCAL_ADDRESS, 0, is_master=True, wait_for_workers=False)
        shared = Shared.open(size) if size <= MOST else None
        with _Workers(size, store.port, threads, command or this_command(), shared) as workers:
            workers.wait_for(store)
            with _connected(device, store=store, rank=0, world_size=size), workers.explaining():
                yield ProcessGroup(0, size, Exchange(0, shared, workers.require_none_failed) if shared else None)


def under_torchrun() -> bool:
    """Whether ``torchrun`` started this process; it then sets the size of the group."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def launched_size() -> int:
    """Processes that ``torchrun`` has started, on all machines; 1 without it."""
    return int(os.environ["WORLD_SIZE"]) if under_torchrun() else 1


def is_first_here() -> bool:
    """Whether this is the first process of a run on its machine, which prepares what all of them use."""
    return MEMBERSHIP not in os.environ and (not under_torchrun() or os.environ["LOCAL_RANK"] == "0")


def is_rank_0() -> bool:
    """Whether this process will be rank 0 of its run's process group."""
    return MEMBERSHIP not in os.environ and (not under_torchrun() or os.environ["RANK"] == "0")


def own_device(device: str) -> str:
    """``device``; under ``torchrun``, for ``cuda`` and ``auto``, the GPU of this process's local rank."""
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


class _Workers:
    """The other ranks, started by rank 0. They end with the block; their output goes to a file."""

    def __init__(self, size: int, port: int, threads: int, command: Sequence[str], shared: Shared | None) -> None:
        self._open = ExitStack()
        if shared is not None:
            self._open.callback(shared.close)
        files = shared.numbers() if shared else []
        of_shared = {SHARED: shared.describe()} if shared else {}
        self._logs: dict[int, IO[str]] = {}
        self._started: dict[int, subprocess.Popen[str]] = {}
        for rank in range(1, size):
            unnamed = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115  # the stack closes it
            log = self._open.enter_context(unnamed)
            self._logs[rank] = log
            environment = {MEMBERSHIP: f"{rank} {size} {port}", "OMP_NUM_THREADS": str(threads)} | of_shared
            self._started[rank] = _start(command, log, environment, files)

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for rank, process in self._started.items():
            try:
                status = process.wait(SECONDS_TO_END if kind is None else 0)
            except subprocess.TimeoutExpired:
                process.kill()
                status = process.wait()
            if kind is None and status != 0:  # the work is done, and saved
                print(f"warning: {self._ended(rank, status)}", file=sys.stderr)
        self._open.close()

    def _ended(self, rank: int, status: int) -> str:
        """How a worker has ended, and the end of its output."""
        self._logs[rank].seek(0)
        tail = "\n".join(self._logs[rank].read().splitlines()[-TAIL_LINES:])
        return f"process {rank} of {len(self._started) + 1} ended with status {status}:\n{tail}"

    def wait_for(self, store: dist.Store) -> None:
        """Return when all have connected to ``store``."""
        for rank in self._started:
            while not store.check([f"here/{rank}"]):
                self.require_none_failed()
                time.sleep(POLL_SECONDS)

    @contextmanager
    def explaining(self) -> Iterator[None]:
        """Turn an error of torch.distributed into a :class:`ProcessGroupError` if a failed worker caused it."""
        try:
            yield
        except RuntimeError as error:
            if type(error) in (RuntimeError, dist.DistBackendError, dist.DistNetworkError):  # not one of this project's
                self.require_none_failed(SECONDS_TO_FAIL, error)
            raise

    def require_none_failed(self, patience: float = 0.0, cause: Exception | None = None) -> None:
        """Errors: :class:`ProcessGroupError` when a worker has ended, or ends within ``patience`` seconds."""
        deadline = time.monotonic() + patience
        while True:
            for rank, process in self._started.items():
                status = process.poll()
                if status is not None:
                    raise ProcessGroupError(self._ended(rank, status)) from cause
            if time.monotonic() >= deadline:
                return
            time.sleep(POLL_SECONDS)


def _end_with_rank_0() -> None:
    """In a worker: wait until rank 0 ends, for whatever reason, and end too."""
    # rank 0 writes nothing; its end of the pipe closes when it ends. Not sys.stdin: at the end of a worker's own work
    # Python would find the lock of that file taken, and abort
    os.read(0, 1)
    os._exit(RANK_0_IS_GONE)


def this_command() -> list[str]:
    """The command that this process runs, as arguments of Python."""
    module = sys.modules["__main__"].__spec__
    return [*(["-m", module.name] if module else [sys.argv[0]]), *sys.argv[1:]]


def _start(
    command: Sequence[str], log: IO[str], environment: dict[str, str], files: Sequence[int]
) -> subprocess.Popen[str]:
    """Start Python with ``command``, which inherits ``files``, in its own process group: Ctrl-C then reaches only rank
    0, which ends the run."""
    return subprocess.Popen(
        [sys.executable, *command],
        env=os.environ | environment,
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        process_group=0,
        pass_fds=files,
        text=True,
    )
