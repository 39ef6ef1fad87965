"""The study of unknown paddles: who is counted where, and a memory that is blanked."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import pytest
import torch

from pace.evaluation.records import wilson
from pace.studies import adaptation
from pace.studies.adaptation import SERVES, Adaptation, Forgetful
from pace.task.observations import POLICY, layout, width
from tests.helpers.fakes import config
from tests.helpers.saved import save_run


def made_up() -> Adaptation:
    """Four dead paddles whose robots succeed from the fourth serve on, two lively ones that always do."""
    late = torch.arange(SERVES) >= 3
    success = torch.cat((late.expand(4, SERVES), torch.ones(2, SERVES, dtype=torch.bool)))
    return Adaptation("made up", success, torch.tensor([0.4, 0.45, 0.5, 0.53, 0.8, 0.86]))


def test_worlds_are_grouped_by_their_paddle_and_counted_by_the_serve() -> None:
    rows = adaptation.table([made_up()]).splitlines()[2:]
    low, high = wilson(4, 4)
    dead, lively = rows[1].split(" | "), rows[3].split(" | ")
    assert dead[1:3] == ["dead (0.38 to 0.54)", "4"]
    assert [cell.split(" ± ")[0] for cell in dead[3:]] == ["0.0"] * 3 + ["100.0"] * 5
    assert dead[-1].startswith(f"100.0 ± {50 * (high - low):.1f}")
    assert lively[2] == "2"
    assert [cell.split(" ± ")[0] for cell in lively[3:]] == ["100.0"] * SERVES
    assert rows[0].split(" | ")[3].startswith("33.3")  # of all six


def test_a_blanked_memory_is_that_before_the_first_return_in_every_frame() -> None:
    task = config("observation=memory")
    seen: list[torch.Tensor] = []

    class Policy:
        config = task

        def __call__(self, observation: torch.Tensor) -> torch.Tensor:
            seen.append(observation)
            return observation

    frames = task.observation.policy_history
    size = sum(width(POLICY[name].size, 21) for name in task.observation.policy)
    observation = torch.rand(3, frames * size) + 1.0
    kept = observation.clone()
    Forgetful(Policy())(observation)  # type: ignore[arg-type]
    columns = layout(task.observation.policy, POLICY, 21)["last_return"]
    changed = (seen[0] != observation).view(3, frames, size)
    assert bool(changed[..., columns].all())
    assert int(changed.sum()) == 3 * frames * 5
    assert torch.equal(observation, kept)


def test_a_policy_is_played_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adaptation, "SERVES", 1)
    found = adaptation.adapt(save_run(tmp_path / "run"), 3)
    assert found.success.shape[1:] == (1,)
    assert found.success.shape[0] == found.restitution.shape[0] <= 3
    assert bool(((found.restitution > 0.37) & (found.restitution < 0.88)).all())
    monkeypatch.setattr(adaptation, "SERVES", SERVES)
    figure = plt.figure(figsize=(8, 3))
    adaptation.draw([made_up()], figure)
    assert len(figure.axes) == 4
    line = figure.axes[1].lines[0].get_ydata()
    assert list(line) == [0.0] * 3 + [100.0] * 5  # type: ignore[arg-type]
    plt.close(figure)
