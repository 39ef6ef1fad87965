"""A training run from its configuration: new, resumed, or started from other weights; alone or in several processes.

This is what ``python -m pace.rl.train`` does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from pace.arrays.graph import Graphs, graphs_of
from pace.config import automatic
from pace.config.base import ConfigError, parse, to_dict
from pace.config.judge import JudgeConfig
from pace.config.predictor import PredictorPriors
from pace.config.schedules import START, position_of
from pace.config.training import RESUME_KEYS, TrainConfig
from pace.cores import threads_of
from pace.devices import has_bf16, machine_of, resolve_device
from pace.distributed import (
    ProcessGroup,
    is_first_here,
    is_rank_0,
    launched_size,
    own_device,
    process_group,
    suitable_size,
)
from pace.memory import available_memory
from pace.predictor.network import BallPredictor, make_predictor
from pace.predictor.priors import resolve_priors
from pace.rl.closing import Export, Film, close, report
from pace.rl.curriculum import Curriculum
from pace.rl.judge import Judge
from pace.rl.kernels import warm
from pace.rl.plan import in_millions
from pace.rl.policies import locate
from pace.rl.start import other_choices
from pace.rl.trainer import Summary, Trainer, device_type_of, restarts_worlds
from pace.runs.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from pace.runs.checkpoint_folders import FOLDER, NAME
from pace.runs.exported import CONTRACT_FILE, POLICY_FILE
from pace.runs.files import tell
from pace.runs.interrupt import terminable
from pace.runs.learning_curve import CURVE
from pace.runs.run_folder import EVALUATION, FILM, RunFolder, is_run

if TYPE_CHECKING:
    from pace.task.env import TableTennisEnv

#: Makes the judge of a run.
MakeJudge = Callable[[JudgeConfig], Judge]
COMMAND = "pace.rl.train"
OWN = (FILM, EVALUATION, POLICY_FILE, CONTRACT_FILE)  # files of a run besides those of every run
UPLOADED = (FILM, CURVE, POLICY_FILE, CONTRACT_FILE)  # to a logger, at the end of a run
SEEDS_APART = 1_000_003  # between the stages of a curriculum: further than seeds of runs lie apart


def train_from_config(
    composed: DictConfig, make_judge: MakeJudge | None = None, film: Film | None = None, export: Export | None = None
) -> None:
    """Train as the composed configuration says, and print what was written.

    A run that comes to its end is judged by what ``make_judge`` makes, and filmed; with a ``logger`` it is also
    exported, and all of this uploaded. Its folder is claimed before
    the work begins; a new folder is removed if the run cannot start.

    Errors: :class:`Terminated` for a SIGTERM or SIGHUP, whatever the run is doing; what is saved can be resumed.
    """
    with terminable():
        _train(composed, make_judge, film, export)


def _train(composed: DictConfig, make_judge: MakeJudge | None, film: Film | None, export: Export | None) -> None:
    config = parse(composed, TrainConfig)
    overrides = list(HydraConfig.get().overrides.task)
    if config.resume:
        saved = load_checkpoint(locate(config.resume))
        config = resumed_config(saved, config.resume, overrides)
    else:
        saved = None
    device = resolve_device(own_device(config.device))
    if saved is None:
        composed, chosen = automatic.choose(composed, machine_for(config, device))
        config = parse(composed, TrainConfig)
    else:
        chosen = adapt(config, saved, device, overrides)
    config.processes = config.processes or suitable_size(config.num_worlds, device)
    run = open_run(config, int(saved.counters["updates"]) if saved else 0) if is_rank_0() else None
    try:
        summary, trainer = train_run(config, saved, device, run, make_judge, chosen)
    except BaseException:
        if run is not None:
            run.abandon()
        raise
    if summary is None:
        return
    assert run is not None  # only rank 0 has a summary
    try:
        report(summary)
        trainer.stop.require_not_terminated()
        if trainer.judge is not None and trainer.stop.name is None:
            close(trainer.judge, film, summary, config.judge, export if run.is_tracked else None)
    finally:
        run.finish([run.path / name for name in UPLOADED])


def train_run(
    config: TrainConfig,
    saved: Checkpoint | None,
    device: torch.device,
    run: RunFolder | None,
    make_judge: MakeJudge | None,
    chosen: dict[str, Any],
) -> tuple[Summary | None, Trainer]:
    """Compile, start the process group and train in it. The summary and the ``run`` folder are those of rank 0."""
    if is_first_here():
        if device.type == "cpu" and launched_size() == 1:
            automatic.require_memory(config.num_worlds, config.processes, available_memory())
        warm(config, device)  # before any clock runs, and once for all processes of this machine
    # a job of a sweep, which a launcher may have started by another program; the command's arguments are of all jobs
    hydra = HydraConfig.get()
    command = ["-m", COMMAND, *hydra.overrides.task] if hydra.mode == RunMode.MULTIRUN else None
    with process_group(config.processes, device, command) as group:
        trainer = build_trainer(config, saved, device, group, run)
        if run is not None:
            announce(trainer, run, saved, chosen)
            trainer.judge = make_judge(config.judge) if make_judge else None
        return trainer.train(), trainer


def machine_for(config: TrainConfig, device: torch.device) -> automatic.Machine:
    """What ``auto`` depends on; a dry run takes the values of a GPU."""
    if graphs_of(config.engine, device) is Graphs.DRY:
        return automatic.Machine("cuda", bf16=True)
    return machine_of(device, launched_size())


def adapt(config: TrainConfig, saved: Checkpoint, device: torch.device, overrides: list[str]) -> dict[str, Any]:
    """Fit a resumed run to another kind of device than it was saved on; returns the values that have changed."""
    given = {override.split("=")[0] for override in overrides}
    if device.type == device_type_of(saved):
        return _keep_engine(config, saved)
    changed: dict[str, Any] = {}
    if "processes" not in given:
        config.processes = 0  # as many as suit this kind of device
    if "engine.graph" not in given and config.engine.graph == {"cpu": "always", "cuda": "dry"}[device.type]:
        config.engine.graph = changed["engine.graph"] = "auto"  # what was saved is for the other kind of device
    if config.algo.autocast == "mixed" and not has_bf16(device):
        config.algo.autocast = changed["algo.autocast"] = "fp32"
    return changed


def _keep_engine(config: TrainConfig, saved: Checkpoint) -> dict[str, Any]:
    """The worlds go on in the engine that they are saved in: on a CPU ``engine.graph=dry`` has another one for auto."""
    was_dry, dry = saved.config["engine"]["graph"] == "dry", config.engine.graph == "dry"
    if config.engine.name != "auto" or was_dry == dry:
        return {}
    config.engine.name = "mjwarp" if was_dry else "native"
    return {"engine.name": config.engine.name}


def resumed_config(saved: Checkpoint, path: str, overrides: list[str]) -> TrainConfig:
    """The saved configuration with the limits of the command line.

    A checkpoint that lies in a run resumes that run. One from anywhere else, or with ``out=``, begins a new run folder.

    Errors: :class:`ConfigError` for an override of anything that a resumed run may not change.
    """
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if key not in RESUME_KEYS:
            raise ConfigError(f"'{key}' cannot change in a resumed run ({', '.join(RESUME_KEYS)} can): use init_from")
    changed = OmegaConf.merge(OmegaConf.create(saved.config), OmegaConf.from_dotlist(overrides))
    config = parse(OmegaConf.to_container(changed), TrainConfig)  # type: ignore[arg-type]
    config.resume, config.init_from, config.predictor_from = path, None, None
    if saved.counters["samples"] >= config.samples:
        raise ConfigError(f"{path} has {saved.counters['samples']} samples: give samples= above that to continue")
    if not any(override.split("=")[0] == "out" for override in overrides):
        run = run_of(saved.path)  # where the run lies now; it may have been moved or copied since it was saved
        config.out = str(run) if run else None
    return config


def run_of(checkpoint: Path | None) -> Path | None:
    """The run folder in which a checkpoint lies as the run has written it, or None."""
    if checkpoint is None or checkpoint.parent.name != FOLDER or not NAME.fullmatch(checkpoint.name):
        return None
    folder = checkpoint.parent.parent
    return folder if is_run(folder) else None


def build_trainer(
    config: TrainConfig, saved: Checkpoint | None, device: torch.device, group: ProcessGroup, run: RunFolder | None
) -> Trainer:
    """Networks and this process's worlds, with the ``run`` folder (of rank 0); state from ``saved`` or
    :func:`first_weights`.

    Errors: :class:`ConfigError` if the process group cannot share the worlds equally.
    """
    if config.num_worlds % group.size:
        raise ConfigError(f"num_worlds {config.num_worlds} cannot be shared equally by {group.size} processes")
    start = first_weights(config)
    config.predictor = resolve_priors(config, learned_priors(start) if start else None)
    if run is not None:
        run.configure(to_dict(config))
    torch.manual_seed(config.seed)
    predictor = make_predictor(config.predictor).to(device)
    new_worlds = saved is not None and restarts_worlds(saved, group, device)
    offset = int(saved.counters["updates"]) if saved and new_worlds else 0  # else the samples of update 0 would repeat
    make = partial(make_worlds, device=device, group=group, predictor=predictor, seed_offset=offset)
    curriculum = Curriculum(config, make, position_of(saved.counters) if saved else START)
    trainer = Trainer(config, curriculum.worlds, predictor, run, group, curriculum)
    torch.manual_seed(group.seed(config.seed + offset))  # the networks are equal on all ranks, the rollouts are not
    if saved:
        trainer.resume(saved)
    elif start:
        try:
            trainer.start_from(start)
        except CheckpointError as error:
            raise CheckpointError(f"{error}{other_choices(config, start.config)}") from error
    return trainer


def make_worlds(
    task: TrainConfig,
    stage: int,
    device: torch.device,
    group: ProcessGroup,
    predictor: BallPredictor,
    seed_offset: int = 0,
) -> TableTennisEnv:
    """This process's worlds of one stage of the curriculum; each stage has a separate seed.

    ``seed_offset`` is added to the seed, for worlds that are made from scratch within a run.
    """
    from pace.task.env import TableTennisEnv

    threads = task.engine.threads or threads_of(group.size)
    task = replace(task, engine=replace(task.engine, threads=threads))
    seed = group.seed(task.seed + SEEDS_APART * stage + seed_offset)
    return TableTennisEnv(task, task.num_worlds // group.size, device, seed, predictor)


def first_weights(config: TrainConfig) -> Checkpoint | None:
    """A new run's first weights: ``config.init_from`` with the predictor of ``config.predictor_from``, or one of them.

    Errors: :class:`CheckpointError` for one that cannot be read.
    """
    start = load_checkpoint(locate(config.init_from), weights_only=True) if config.init_from else None
    if not config.predictor_from:
        return start
    given = load_checkpoint(locate(config.predictor_from), weights_only=True)
    if "predictor" not in given.weights:
        raise CheckpointError(f"{given.path} has no predictor: give predictor_from a run of pace predictor")
    if start is None:
        return replace(given, weights={"predictor": given.weights["predictor"]})
    task = start.config | {"predictor": given.config["predictor"]}
    return replace(start, config=task, weights=start.weights | {"predictor": given.weights["predictor"]})


def learned_priors(start: Checkpoint) -> PredictorPriors:
    """The priors that belong to the predictor's weights in ``start``."""
    return parse(start.config["predictor"]["priors"], PredictorPriors)


def open_run(config: TrainConfig, first_update: int) -> RunFolder:
    """The run folder that ``config`` names, or a new one, whose path ``config`` then holds."""
    run = RunFolder(config.out, to_dict(config), config.tensorboard, first_update, OWN, config.logger)
    config.out = str(run.path)
    return run


def announce(trainer: Trainer, run: RunFolder, saved: Checkpoint | None, chosen: dict[str, Any]) -> None:
    """Print the run's task, device, starting point and folder, and the values that were ``chosen`` for the device."""
    if chosen:
        print(f"for this device: {automatic.in_words(chosen)}")
    if saved is not None:
        new_worlds = ", with new worlds" if restarts_worlds(saved, trainer.group, trainer.device) else ""
        tell(f"resuming from {saved.path}{new_worlds}")
    if trainer.plan.samples is not None:
        tell(f"planned: {in_millions(trainer.plan.samples)}")
    shared = f" in {trainer.group.size} processes" if trainer.group.size > 1 else ""
    tell(
        f"training {trainer.config.name}: {trainer.config.num_worlds} worlds on {trainer.device}{shared}, "
        f"{trainer.algorithm.describe()}, run folder {run.path}"
    )
