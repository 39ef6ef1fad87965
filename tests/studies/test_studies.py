"""The studies: what they measure, the tolerances that docs/results/engines.md states, and their command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pace.rl.policies import load_policy
from pace.runs.own_files import LIST
from pace.studies import motors, parity, reaction, steps
from pace.studies.__main__ import main
from pace.studies.swings import Swings, policy_swings, random_swings
from tests.helpers.saved import save_run

Found = dict[str, dict[str, parity.Difference]]


@pytest.fixture(scope="module")
def strikes() -> reaction.Strikes:
    return reaction.strike_all(2, gains=0.0)


@pytest.fixture(scope="module")
def found() -> Found:
    return parity.compare(4)


def test_a_limp_arm_takes_the_impulse_as_a_free_mass_would(strikes: reaction.Strikes) -> None:
    """Without gains the struck point gives way at impulse over effective mass, both from MuJoCo's own matrices."""
    expected = strikes.impulse / strikes.effective_mass
    assert 0.02 < expected.min() < expected.max() < 0.4
    share = strikes.give / expected
    assert np.median(share) == pytest.approx(1.0, abs=0.1)
    assert share.max() < 1.05  # an arm that comes to the end of a joint gives way less
    blow = (1.878 - 0.02 * strikes.speed) * strikes.speed  # 1 + e of the preset, in mid-swing
    hardness = strikes.impulse / (0.0027 * blow)
    assert np.median(hardness) == pytest.approx(1.0, abs=0.05)
    assert 0.7 < hardness.min() < hardness.max() < 1.3  # one arm is stopped by the leg in the step of the strike
    assert np.all(strikes.ball_change < 0.03 * blow)
    assert 0 < reaction.cost(num_worlds=4, repeats=3) < 0.1


@pytest.mark.slow
def test_engines_agree_for_a_second_within_the_stated_tolerances(found: Found) -> None:
    for scenario, others in found.items():
        d = others["mjwarp"]
        assert d.joints.shape == (parity.STEPS, 4)
        assert d.joints[:5].max() < 1e-4, scenario  # all worlds, 100 ms
        if scenario != "striking":  # there the paddle touches the leg in half of the worlds
            assert np.median(d.joints[-1]) < 1e-4, scenario
        if scenario == "falling, limbs only":  # steep capsules: parity.LIMBS_ELLIPTIC has what is left without them
            assert not d.convex.any()
            continue
        clean = d if scenario == parity.LIMBS_ELLIPTIC else d.worlds(~d.convex)
        struck = clean.ball[list(parity.THROWS)]
        pose = ((clean.joints, 1e-3), (clean.base, 1e-3), (clean.angle, 1e-3))
        for values, tolerance in (*pose, (clean.load, 0.1), (struck, 1e-3)):
            assert values.max(initial=0.0) < tolerance, scenario
    for scenario in ("standing", "striking"):
        assert not found[scenario]["mjwarp"].convex.all()


def test_a_play_falls_stands_and_strikes_as_it_says() -> None:
    plays = {}
    nominal = random_swings(1, 1).targets[0, 0]
    for name, scenario in parity.scenarios(2, nominal).items():
        balls: parity.Balls = []
        plays[name] = parity.play("native", 0.0, scenario, balls)
        assert len(balls) == (len(parity.THROWS) if name == "striking" else 0)
    assert (plays["standing"].base[-1, :, 2] > 0.5).all()
    for name in ("falling", "falling, limbs only", parity.LIMBS_ELLIPTIC):
        assert (plays[name].base[-1, :, 2] < 0.5).all()
    assert plays["falling"].touched.any()
    assert not plays["falling, limbs only"].touched.any()
    speeds = np.linalg.norm(plays["striking"].ball, axis=2)
    assert (speeds[parity.THROWS[0]] > 1.0).all()


def test_errors_fall_with_the_step_and_are_those_of_the_step_on_both_engines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "STEPS", (0.002, 0.01))
    monkeypatch.setattr(steps, "LENGTH", 8)
    swings = random_swings(2, 16)
    windows = swings.windows(steps.LENGTH)
    assert windows.targets.shape == (8, 4, 21)
    cases = {case.name: case.deviation for case in steps.step_cases(windows)}
    for engine in steps.ENGINES:
        fine, coarse = (np.median(cases[f"{engine}, {dt} ms"].paddle[-1]) for dt in (2, 10))
        assert fine < 0.4 * coarse
        assert 1e-5 < coarse < 0.05
    between = np.abs(cases["native, 10 ms"].paddle - cases["mjwarp, 10 ms"].paddle)
    assert np.median(between) < 1e-5


def test_the_default_solver_limits_converge() -> None:
    cases = {case.name: case.deviation for case in steps.solver_cases(random_swings(2, 15).windows(15), ("native",))}
    assert cases["native, 10 and 15 iterations"].paddle.max() < 1e-6
    assert cases["native, 2 and 4 iterations"].paddle.max() > 1e-4


def test_windows_leave_out_resets() -> None:
    ends = torch.zeros(6, 2, dtype=torch.bool)
    ends[1, 0] = ends[5, 1] = True  # inside the first window of world 0; behind the last step of world 1
    number = torch.arange(6.0).view(6, 1, 1)
    qpos, qvel, targets = (number.expand(6, 2, width).clone() for width in (28, 27, 21))
    swings = Swings(qpos, qvel, targets, ends, "numbers")
    windows = swings.windows(3)
    assert windows.qpos[:, 0].tolist() == [0.0, 3.0, 3.0]
    assert windows.targets[:, :, 0].T.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [3.0, 4.0, 5.0]]


def test_a_policys_swings_replay_as_recorded(tmp_path: Path) -> None:
    swings = policy_swings(save_run(tmp_path), 2, 4)
    assert swings.targets.shape == (4, 2, 21)
    assert not torch.equal(swings.targets[0], swings.targets[1])
    windows = swings.windows(3)
    again = steps.replay(windows, {"name": "native", "physics_dt": 0.002})
    np.testing.assert_allclose(again.joints[0], swings.qpos[1, :, 7:], atol=1e-5)
    np.testing.assert_allclose(again.joints[1], swings.qpos[2, :, 7:], atol=1e-4)


def test_with_the_limit_no_motor_drives_over_its_line(tmp_path: Path) -> None:
    policy = load_policy(save_run(tmp_path))
    found = [motors.use(policy, case, 2, 2) for case in motors.CASES]
    for use in found:
        assert (use.serves, len(use.fastest)) == (2, 21)
        assert (use.fast[use.fastest <= 1.0] == 0).all()
        assert (use.fast[use.fastest > 1.0] > 0).all()
        assert (use.over <= use.held).all()
        assert (use.excess[use.over > 0] > 0).all()
        assert ((use.ended >= 0) & (use.ended <= 1)).all()
        if use.case != motors.WITHOUT:
            assert (use.over == 0).all()
            assert use.excess.max() < 0.01
    assert [use.case for use in found] == [motors.PAPER, motors.WITHOUT, motors.WITH]
    assert motors.table(found).count("\n") == 2 + len(motors.GROUPS)


def test_the_commands_print_tables_and_write_figures(
    strikes: reaction.Strikes,
    found: Found,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reaction, "strike_all", lambda worlds: strikes)
    monkeypatch.setattr(reaction, "cost", lambda: 2e-4)
    monkeypatch.setattr(parity, "compare", lambda worlds: found)
    monkeypatch.setattr("sys.argv", ["studies", "reaction", "parity", f"out={tmp_path}"])
    assert main() == 0
    printed = capsys.readouterr().out
    assert printed.count("\n| ") >= 2 + len(reaction.SPEEDS) + 2 + 2 * len(found) + 4
    assert "0.20 ms a control step" in printed
    assert {path.name for path in tmp_path.iterdir()} == {"paddle_reaction.png", "engine_parity.png", LIST}
    assert all(path.stat().st_size > 10_000 for path in tmp_path.glob("*.png"))
