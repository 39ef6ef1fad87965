"""A robot's log through the exported file: where the recorded targets part from those that the file gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig

from pace.config.base import parse
from pace.config.commands import RetraceConfig
from pace.config.extras import cure
from pace.deploy.player import Controller, read_log
from pace.runs.exported import POLICY_FILE
from pace.runs.files import reason, write_figure
from pace.runs.own_files import started_out

FIGURE = "retrace.png"
JOINTS_TOLD = 5  # of those that differ most
SMALLEST = 1e-8  # rad; the figure's lower end

Array = NDArray[np.float64]


class RetraceError(RuntimeError):
    """A policy or a log that cannot be used."""


@dataclass(frozen=True)
class Trace:
    """M steps of a log.

    Attributes: ``time`` (M,) s; ``logged`` and ``given`` (M, J) rad: recorded targets, and those of the file (NaN where
    it refused the readings); ``restart`` (M,) bool; ``refused`` row -> why.
    """

    time: Array
    logged: Array
    given: Array
    restart: NDArray[np.bool_]
    refused: Mapping[int, str]

    @property
    def difference(self) -> Array:
        """(M, J) rad; infinite where a recorded target is no number, and 0 where the file refused the readings."""
        apart = np.nan_to_num(np.abs(self.logged - self.given), nan=np.inf)
        apart[list(self.refused)] = 0.0
        return apart


def retrace(controller: Controller, log: Mapping[str, Array]) -> Trace:
    """Feed the rows of ``log`` (:func:`pace.deploy.player.read_log`) to the controller, one after another."""
    given, refused = np.full(log["joint_target"].shape, np.nan), {}
    controller.restart()
    for row, restart in enumerate(log["restart"]):
        if restart:
            controller.restart()
        try:
            given[row] = controller({name: log[name][row] for name in controller.sizes})
        except ValueError as error:
            refused[row] = str(error)
    return Trace(log["time"], log["joint_target"], given, log["restart"].astype(bool), refused)


def report(trace: Trace, controller: Controller, log: Mapping[str, Array], config: RetraceConfig) -> list[str]:
    """What there is to say, line by line: whether the targets agree, where they part, and what was unusual before."""
    apart, names = trace.difference, controller.contract["joint_names"]
    seconds = float(trace.time[-1] - trace.time[0])
    lines = [f"{len(trace.time)} steps in {seconds:.2f} s, {int(trace.restart.sum())} restarts"]
    beyond = np.flatnonzero(apart.max(1) > config.tolerance)
    if len(beyond):
        row = int(beyond[0])
        joint = int(apart[row].argmax())
        values = f"recorded {trace.logged[row, joint]:+.4f} rad, the file gives {trace.given[row, joint]:+.4f} rad"
        lines.append(f"targets part at {trace.time[row]:.3f} s (step {row}): {names[joint]}, {values}")
        lines.append(f"{len(beyond)} steps differ by more than {config.tolerance:g} rad; by joint, rad:")
        worst = np.argsort(-apart.max(0), kind="stable")[:JOINTS_TOLD]
        lines += [f"  {names[i]:<24}{apart[:, i].max():.2g} at {trace.time[apart[:, i].argmax()]:.3f} s" for i in worst]
    else:
        lines.append(f"targets agree: largest difference {apart.max():.2g} rad")
    return lines + unusual(trace, controller, log, config.late)


def unusual(trace: Trace, controller: Controller, log: Mapping[str, Array], late: float) -> list[str]:
    """Steps at other times than the policy expects, readings that it refuses, frames older than in its training."""
    lines = []
    apart = np.diff(trace.time)
    off = np.flatnonzero(np.abs(apart - controller.control_dt) > late * controller.control_dt)
    off = off[~trace.restart[off + 1]]
    if len(off):
        worst = off[np.abs(apart[off] - controller.control_dt).argmax()]
        lines.append(
            f"{len(off)} steps are not {1e3 * controller.control_dt:g} ms after the one before: "
            f"{1e3 * apart[worst]:.1f} ms at {trace.time[worst + 1]:.3f} s"
        )
    if trace.refused:
        row, why = next(iter(trace.refused.items()))
        lines.append(f"{len(trace.refused)} steps are refused, the first at {trace.time[row]:.3f} s: {why}")
    longest = controller.contract["sensing"]["mocap_delay"][1] + controller.control_dt
    for name in ("base", "ball"):
        ages, new = log[f"{name}_age"][:, 0], log[f"{name}_new"][:, 0] > 0.5
        old = new & (ages > longest)
        if old.any():
            lines.append(
                f"{int(old.sum())} of {int(new.sum())} frames with the {name} are older than in training: "
                f"{1e3 * ages[old].max():.0f} ms, not {1e3 * longest:.0f} ms at most"
            )
    return lines


def draw(trace: Trace, tolerance: float) -> Figure:
    """The largest difference of a target over the time of the log."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes = figure.subplots()
    apart = trace.difference.max(1)
    axes.semilogy(trace.time, np.clip(apart, SMALLEST, 1e3), lw=1.0, label="largest difference of a joint's target")
    axes.axhline(tolerance, color="tab:red", lw=0.8, label="tolerance")
    for time in trace.time[trace.restart]:
        axes.axvline(time, color="0.8", lw=0.8)
    refused = trace.time[list(trace.refused)]
    axes.plot(refused, np.full(len(refused), tolerance), "kx", ms=4, label="refused" if len(refused) else None)
    axes.set(xlabel="time (s)", ylabel="rad")
    axes.legend(loc="upper left")
    return figure


def retrace_from_config(composed: DictConfig) -> None:
    """Feed a log to a policy as the configuration says, print where they part, and write the figure.

    Errors: :class:`RetraceError` for a policy or a log that cannot be used.
    """
    config = parse(composed, RetraceConfig)
    assert config.policy is not None  # guaranteed by RetraceConfig, as is the log
    assert config.log is not None
    file = Path(config.policy)
    file = file / POLICY_FILE if file.is_dir() else file
    try:
        controller = Controller(file)
    except ValueError as error:
        raise RetraceError(f"{file} cannot be used: {error}") from error
    except ModuleNotFoundError as error:
        raise RetraceError(f"{error}: {cure('export')}") from error
    try:
        log = read_log(config.log, {**controller.sizes, "joint_target": len(controller.contract["joint_names"])})
    except ValueError as error:
        raise RetraceError(str(error)) from error
    except OSError as error:
        raise RetraceError(f"{config.log} cannot be read: {reason(error)}") from error
    with started_out(config.out, "retrace", [FIGURE]) as folder:
        trace = retrace(controller, log)
        print("\n".join(report(trace, controller, log, config)))
        write_figure(folder / FIGURE, draw(trace, config.tolerance), dpi=120)
    print(f"wrote {folder / FIGURE}")
