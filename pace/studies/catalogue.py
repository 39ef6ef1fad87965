"""The studies by name: engine parity, step sizes, solver settings, paddle reaction, motors, cost of the robots,
ankles, predictors and their error bounds, adaptation to the paddle, on-board estimates, bf16 rounding in
the update, the balls of a machine, the learning curves of the recipes that were tried, memory and serves of long runs,
and the rooms of the package.

They print the tables of the pages in ``docs/results`` and draw their figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from pace.config.base import meant, parse, require
from pace.config.commands import StudiesConfig
from pace.rl.policies import load_policy, load_predictor
from pace.runs.run_folder import make_out
from pace.studies import (
    adaptation,
    ankles,
    architecture,
    learning_curves,
    memory,
    motors,
    page_soak,
    parity,
    predictor,
    reaction,
    recipe,
    robots,
    rounding,
    senses,
    serves,
    soak,
    steps,
    watch,
)
from pace.studies.common import save_figure
from pace.studies.swings import Swings, policy_swings, random_swings

GENERALIST = Path("pretrained/campaign")
RESULTS = Path("docs/results")
#: File that a study writes, if it draws anything.
FIGURES = {
    "reaction": "paddle_reaction.png",
    "parity": "engine_parity.png",
    "steps": "step_size.png",
    "adaptation": "adaptation.png",
    "serves": "serve_machine.png",
    "predictor": "predictor.png",
    "recipe": "recipe.png",
    "learning": "learning.png",
    "memory": "memory.png",
    "soak": "soak.png",
    "page": "page_soak.png",
    "architecture": "architecture.png",
}


@dataclass(frozen=True)
class Options:
    """Subject and size of a study; see configs/studies.yaml."""

    worlds: int
    serves: int
    hours: float
    run: Path | None
    cases: list[str]
    predictors: list[Path]
    out: Path


def study_reaction(options: Options) -> None:
    strikes = reaction.strike_all(options.worlds)
    print(reaction.table(strikes))
    print(f"cost: {1e3 * reaction.cost():.2f} ms a control step of 1,024 worlds")
    save_figure(options.out / FIGURES["reaction"], (9, 3.2), lambda figure: reaction.draw(strikes, figure))


def study_parity(options: Options) -> None:
    found = parity.compare(options.worlds)
    print(parity.table(found))
    print()
    print(parity.strike_table(found))
    save_figure(options.out / FIGURES["parity"], (9.5, 3.2), lambda figure: parity.draw(found, figure))


def _swings(options: Options) -> Swings:
    swings = policy_swings(options.run, options.worlds, 150) if options.run else random_swings(options.worlds, 150)
    print(f"{swings.source}, {options.worlds} worlds for {0.02 * len(swings.targets):g} s")
    return swings


def study_steps(options: Options) -> None:
    cases = steps.step_cases(_swings(options).windows(steps.LENGTH))
    print(steps.table(cases))
    save_figure(options.out / FIGURES["steps"], (9.5, 3.2), lambda figure: steps.draw_steps(cases, figure))


def study_solver(options: Options) -> None:
    print(steps.table(steps.solver_cases(_swings(options).windows(steps.LENGTH))))


def study_motors(options: Options) -> None:
    cost = motors.cost()
    print(", ".join(f"{case} {1e6 * spent:.1f} us" for case, spent in cost.items()), "a step of a world")
    print(motors.table(motors.uses(_policies(options), options.worlds, options.serves)))


def study_robots(options: Options) -> None:
    print(robots.table(robots.costs()))


def study_ankles(options: Options) -> None:
    print(ankles.table(ankles.compare(load_policy(options.run or GENERALIST), options.worlds, options.serves)))


def study_adaptation(options: Options) -> None:
    found = adaptation.adaptations(_policies(options), options.worlds)
    print(adaptation.table(found))
    save_figure(options.out / FIGURES["adaptation"], (11.5, 3.2), lambda figure: adaptation.draw(found, figure))


def study_senses(options: Options) -> None:
    print(senses.table(senses.sense(options.run or GENERALIST, options.worlds)))


def study_rounding(options: Options) -> None:
    print(rounding.table(rounding.measure(options.run or GENERALIST, options.worlds)))


def study_serves(options: Options) -> None:
    found = serves.sample()
    print(f"{found.bad:.1e} of {serves.COUNT:,} balls are bad after all attempts")
    print(serves.table(found))
    save_figure(options.out / FIGURES["serves"], (13, 3.2), lambda figure: serves.draw(found, figure))


def _policies(options: Options) -> list[Path]:
    kept = sorted(path.parent for path in Path("pretrained").glob("*/checkpoint.json"))
    return [options.run] if options.run else kept


def study_predictor(options: Options) -> None:
    for run in options.predictors:
        load_predictor(run)  # wrong ones raise before minutes of computing bounds
    found = []
    for case in options.cases or predictor.CASES:
        found.append(predictor.compare(case, options.serves, options.predictors))
        print(f"{case}: done", flush=True)
    print(predictor.table(found))
    save_figure(options.out / FIGURES["predictor"], (9.5, 3.6), lambda figure: predictor.draw(found, figure))


def study_recipe(options: Options) -> None:
    runs = recipe.listed(RESULTS / "recipe")
    if options.run:
        recipe.take_over(runs, options.run)
    curves = {tried: tried.curve() for tried in runs}
    print(recipe.table(curves))
    print(f"wrote {recipe.draw(curves, options.out / FIGURES['recipe'])}")


def study_learning(options: Options) -> None:
    curves = learning_curves.read(RESULTS)
    print(learning_curves.table(curves))
    print(f"wrote {learning_curves.draw(curves, options.out / FIGURES['learning'])}")


def study_memory(options: Options) -> None:
    watched = memory.watch_training(options.out)
    print(watch.text(watched, "updates"))
    save_figure(options.out / FIGURES["memory"], (11, 3), lambda figure: watch.draw(watched, "updates", figure))


def study_soak(options: Options) -> None:
    found, watched = soak.soak(load_policy(options.run or GENERALIST), options.serves, options.worlds)
    print(soak.text(found))
    print(watch.text(watched, "serves"))
    save_figure(options.out / FIGURES["soak"], (7.5, 3), lambda figure: watch.draw(watched, "serves", figure))


def study_page(options: Options) -> None:
    watched, sent = page_soak.watch_page(load_policy(options.run or GENERALIST), options.hours)
    print(f"{watch.text(watched, 's of play')}\n{sent / 2**20:.0f} MiB sent to the browser")
    save_figure(options.out / FIGURES["page"], (7.5, 3), lambda figure: watch.draw(watched, "s of play", figure))


def study_architecture(options: Options) -> None:
    print(f"wrote {architecture.write(options.out)}")


STUDIES = {
    "reaction": study_reaction,
    "parity": study_parity,
    "steps": study_steps,
    "solver": study_solver,
    "motors": study_motors,
    "robots": study_robots,
    "ankles": study_ankles,
    "predictor": study_predictor,
    "adaptation": study_adaptation,
    "senses": study_senses,
    "rounding": study_rounding,
    "serves": study_serves,
    "recipe": study_recipe,
    "learning": study_learning,
    "memory": study_memory,
    "soak": study_soak,
    "page": study_page,
    "architecture": study_architecture,
}


def study_from_config(composed: DictConfig) -> None:
    """Run the configured studies.

    Errors: :class:`ConfigError` for an unknown name; :class:`pace.runs.checkpoint.CheckpointError`.
    """
    config = parse(composed, StudiesConfig)
    names = list(STUDIES) if config.studies == ["all"] else config.studies
    require(len(names) > 0, f"which study? {', '.join(STUDIES)}, or all")
    for kind, given, known in (("study", names, list(STUDIES)), ("case", config.cases, list(predictor.CASES))):
        for name in given:
            require(name in known, f"there is no {kind} '{name}'{meant(name, known)} ({', '.join(known)})")
    options = Options(
        worlds=config.worlds,
        serves=config.serves,
        hours=config.hours,
        run=Path(config.run) if config.run else None,
        cases=config.cases,
        predictors=[Path(path) for path in config.predictors],
        out=make_out(config.out, "studies", [FIGURES[name] for name in names if name in FIGURES]),
    )
    for name in names:
        print(f"\n== {name}")
        STUDIES[name](options)
