"""``python -m pace.studies``: engines against each other, step sizes, solver settings, paddle reaction (extra ``dev``).

Prints the tables of ``docs/engines.md`` and ``docs/physics.md`` and writes their figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from pace.studies import reaction


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


STUDIES = {"reaction": study_reaction}


def main(arguments: list[str] | None = None) -> None:
    """Run the studies that are named, or all."""
    parser = argparse.ArgumentParser(prog="python -m pace.studies", description=__doc__)
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], help="which; none: all")
    parser.add_argument("--worlds", type=int, default=16, help="worlds of each case")
    parser.add_argument("--out", type=Path, default=Path("docs/figures"), help="folder of the figures")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.studies or STUDIES:
        print(f"\n== {name}")
        STUDIES[name](options)


if __name__ == "__main__":
    main()
