"""``python -m pace.studies``: engines against each other, step sizes, solver settings, paddle reaction, motors,
what a predictor can know, how a policy stands, whether it finds out its paddle, what it makes of its sensors, what
rounding to bf16 does to its learning, and the curves of the recipes that were tried (extra ``dev``).

Prints the tables of the pages in ``docs/results`` and writes their figures.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from pace.config.base import ConfigError
from pace.rl.policies import load_predictor
from pace.runs.checkpoint import CheckpointError
from pace.studies import (
    adaptation,
    learning_curves,
    motors,
    parity,
    posture,
    predictor,
    reaction,
    recipe,
    rounding,
    senses,
    steps,
)
from pace.studies.swings import Swings, policy_swings, random_swings

GENERALIST = Path("pretrained/campaign")
RESULTS = Path("docs/results")


def _save(out: Path, name: str, size: tuple[float, float], draw: Callable[[Figure], None]) -> None:
    with plt.rc_context({"axes.spines.top": False, "axes.spines.right": False, "font.size": 9}):
        figure = plt.figure(figsize=size, layout="constrained")
        draw(figure)
        figure.savefig(out / f"{name}.png", dpi=90)
        plt.close(figure)
    print(f"wrote {out / name}.png")


def study_reaction(options: argparse.Namespace) -> None:
    strikes = reaction.strike_all(options.worlds)
    print(reaction.table(strikes))
    print(f"cost: {1e3 * reaction.cost():.2f} ms a control step of 1,024 worlds")
    _save(options.out, "paddle_reaction", (9, 3.2), lambda figure: reaction.draw(strikes, figure))


def study_parity(options: argparse.Namespace) -> None:
    found = parity.compare(options.worlds)
    print(parity.table(found))
    print()
    print(parity.strike_table(found))
    _save(options.out, "engine_parity", (9.5, 3.2), lambda figure: parity.draw(found, figure))


def _swings(options: argparse.Namespace) -> Swings:
    swings = policy_swings(options.run, options.worlds, 150) if options.run else random_swings(options.worlds, 150)
    print(f"{swings.source}, {options.worlds} worlds for {0.02 * len(swings.targets):g} s")
    return swings


def study_steps(options: argparse.Namespace) -> None:
    cases = steps.step_cases(_swings(options).windows(steps.LENGTH))
    print(steps.table(cases))
    _save(options.out, "step_size", (9.5, 3.2), lambda figure: steps.draw_steps(cases, figure))


def study_solver(options: argparse.Namespace) -> None:
    print(steps.table(steps.solver_cases(_swings(options).windows(steps.LENGTH))))


def study_motors(options: argparse.Namespace) -> None:
    cost = motors.cost()
    print(", ".join(f"{case} the limit {1e6 * spent:.1f} us" for case, spent in cost.items()), "a step of a world")
    print(motors.table(motors.uses(_policies(options), options.worlds, options.serves)))


def study_posture(options: argparse.Namespace) -> None:
    print(posture.table(posture.postures(_policies(options), options.worlds, options.serves)))


def study_adaptation(options: argparse.Namespace) -> None:
    found = adaptation.adaptations(_policies(options), options.worlds)
    print(adaptation.table(found))
    _save(options.out, "adaptation", (11.5, 3.2), lambda figure: adaptation.draw(found, figure))


def study_senses(options: argparse.Namespace) -> None:
    print(senses.table(senses.sense(options.run or GENERALIST, options.worlds)))


def study_rounding(options: argparse.Namespace) -> None:
    print(rounding.table(rounding.measure(options.run or GENERALIST, options.worlds)))


def _policies(options: argparse.Namespace) -> list[Path]:
    kept = sorted(path.parent for path in Path("pretrained").glob("*/checkpoint.json"))
    return [options.run] if options.run else kept


def study_predictor(options: argparse.Namespace) -> None:
    for run in options.predictors:
        load_predictor(run)  # wrong ones are told before minutes of bounds
    found = []
    for case in options.cases or predictor.CASES:
        found.append(predictor.compare(case, options.serves, options.predictors))
        print(f"{case}: done", flush=True)
    print(predictor.table(found))
    _save(options.out, "predictor", (9.5, 3.6), lambda figure: predictor.draw(found, figure))


def study_recipe(options: argparse.Namespace) -> None:
    runs = recipe.listed(RESULTS / "recipe")
    if options.run:
        recipe.take_over(runs, options.run)
    curves = {tried: tried.curve() for tried in runs}
    print(recipe.table(curves))
    print(f"wrote {recipe.draw(curves, options.out / 'recipe.png')}")


def study_learning(options: argparse.Namespace) -> None:
    curves = learning_curves.read(RESULTS)
    print(learning_curves.table(curves))
    print(f"wrote {learning_curves.draw(curves, options.out / 'learning.png')}")


STUDIES = {
    "reaction": study_reaction,
    "parity": study_parity,
    "steps": study_steps,
    "solver": study_solver,
    "motors": study_motors,
    "predictor": study_predictor,
    "posture": study_posture,
    "adaptation": study_adaptation,
    "senses": study_senses,
    "rounding": study_rounding,
    "recipe": study_recipe,
    "learning": study_learning,
}


def main(arguments: list[str] | None = None) -> int:
    """Run the studies that are named, or all; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m pace.studies", description=__doc__)
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], help="which; none: all")
    parser.add_argument("--worlds", type=int, default=16, help="worlds of each case")
    which = "run folder or checkpoint to study; none: random swings, or pretrained/*; recipe: a folder of run folders"
    parser.add_argument("--run", type=Path, help=f"{which} whose metrics are taken over first")
    parser.add_argument("--serves", type=int, default=128, help="motors, posture, predictor: serves of each case")
    parser.add_argument("--cases", nargs="*", choices=list(predictor.CASES), help="predictor: which; none: all")
    beside = "predictor: runs or checkpoints to measure beside the bounds"
    parser.add_argument("--predictors", nargs="*", type=Path, default=[], help=beside)
    parser.add_argument("--out", type=Path, default=RESULTS / "figures", help="folder of the figures")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.studies or STUDIES:
        print(f"\n== {name}")
        try:
            STUDIES[name](options)
        except (CheckpointError, ConfigError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
