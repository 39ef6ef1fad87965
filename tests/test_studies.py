"""The studies: what they measure is what they say, and their commands run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pace.studies import reaction
from pace.studies.__main__ import main


def test_a_limp_arm_takes_the_impulse_as_a_free_mass_would() -> None:
    """Without gains the struck point gives way at impulse over effective mass, both from MuJoCo's own matrices."""
    strikes = reaction.strike_all(2, gains=0.0)
    expected = strikes.impulse / strikes.effective_mass
    assert 0.02 < expected.min() < expected.max() < 0.4
    share = strikes.give / expected
    assert np.median(share) == pytest.approx(1.0, abs=0.1)
    assert share.max() < 1.05  # an arm that comes to the end of a joint gives way less
    blow = (1.878 - 0.02 * strikes.speed) * strikes.speed  # 1 + e of the preset, in mid-swing
    np.testing.assert_allclose(strikes.impulse, 0.0027 * blow, rtol=0.2)
    assert np.all(strikes.ball_change < 0.03 * blow)


def test_the_reaction_study_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["reaction", "--worlds", "1", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert printed.count("\n| ") >= 2 + len(reaction.SPEEDS)
    assert (tmp_path / "paddle_reaction.png").stat().st_size > 10_000
