"""The whole environment under random actions, in this process or split over several."""

from __future__ import annotations

import copy
import multiprocessing
from multiprocessing.connection import Connection
from types import TracebackType

import torch

from pace.bench.training import BenchError
from pace.config import plugins
from pace.config.commands import BenchConfig
from pace.cores import threads_of
from pace.distributed import ProcessGroup
from pace.predictor.network import make_predictor
from pace.predictor.priors import resolve_priors
from pace.task.env import TableTennisEnv

FAILED = "one of the environment's processes failed; its output stands above"


class EnvironmentLoop:
    """The whole environment on one engine, under random actions that are held for ``control_steps``."""

    def __init__(self, config: BenchConfig, engine: str, device: torch.device, control_steps: int) -> None:
        config = copy.deepcopy(config)
        config.engine.name = engine
        self.control_steps, self.action_std = control_steps, config.bench.action_std
        predictor = make_predictor(resolve_priors(config)).to(device)
        self.env = TableTennisEnv(config, config.num_worlds, device, config.seed, predictor)
        self.action = torch.zeros(config.num_worlds, self.env.action_spec.shape[-1], device=device)
        self.sample()

    def sample(self) -> None:
        """Sample new actions for every world."""
        self.action.normal_().mul_(self.action_std)

    def play(self, steps: int) -> None:
        """Step all worlds and reset those that are done, ``steps`` times."""
        for _ in range(steps):
            self.env.advance(self.action)
            self.env.reset_worlds(self.env.terminated | self.env.truncated)

    def run(self) -> None:
        """One measured repeat."""
        self.play(self.control_steps)


class EnvironmentProcesses:
    """The same loop, its worlds split over ``size`` processes as in a training run.

    All have settled when the constructor returns. Errors: :class:`BenchError` when one of them fails.
    """

    def __init__(self, config: BenchConfig, engine: str, size: int) -> None:
        context = multiprocessing.get_context("spawn")
        share = copy.deepcopy(config)
        share.num_worlds = config.num_worlds // size
        share.engine.threads = config.engine.threads or threads_of(size)
        self._lines: list[Connection] = []
        self._processes = []
        for rank in range(size):
            share.seed = ProcessGroup(rank, size).seed(config.seed)
            own, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, share, engine, share.engine.threads), daemon=True)
            process.start()
            theirs.close()
            self._lines.append(own)
            self._processes.append(process)
        self._wait()

    def run(self) -> None:
        """One measured repeat, of all processes at once."""
        try:
            for line in self._lines:
                line.send(True)
        except BrokenPipeError:
            raise BenchError(FAILED) from None
        self._wait()

    def _wait(self) -> None:
        try:
            for line in self._lines:
                line.recv()
        except EOFError:
            raise BenchError(FAILED) from None

    def __enter__(self) -> EnvironmentProcesses:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for line in self._lines:
            line.close()
        for process in self._processes:
            process.join()


def _serve(line: Connection, config: BenchConfig, engine: str, threads: int) -> None:
    """Settle, then run one repeat for each message, until the connection is closed."""
    torch.set_num_threads(threads)
    plugins.use(config.plugins)  # a spawned process does not inherit them
    loop = EnvironmentLoop(config, engine, torch.device("cpu"), config.bench.control_steps)
    loop.play(config.bench.settle_steps)
    try:
        while True:
            loop.sample()
            line.send(True)
            line.recv()
            loop.run()
    except (EOFError, BrokenPipeError):
        return
