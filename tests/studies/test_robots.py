"""The cost of a robot's parts: the cases are what they say, and each has a time on both engines."""

from __future__ import annotations

import pytest

from pace.studies import robots


def test_cases_leave_out_what_they_say() -> None:
    cases = robots.robots()
    assert len(cases) == 7
    for name in ("t1", "t1_29dof"):
        whole, bare = cases[name], cases[f"{name} without pairs and friction"]
        assert whole.self_collision
        assert any(group.friction for group in whole.joint_groups)
        assert cases[f"{name} without pairs"].joint_groups == whole.joint_groups
        assert not cases[f"{name} without pairs"].self_collision
        assert not bare.self_collision
        assert not any(group.friction for group in bare.joint_groups)


def test_each_case_has_a_cost_on_both_engines(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = {name: robots.robots()[name] for name in ("t1", "t1_paper")}
    monkeypatch.setattr(robots, "robots", lambda: cases)
    for size in ("NATIVE_WORLDS", "MJWARP_WORLDS", "MJWARP_STEPS"):
        monkeypatch.setattr(robots, size, 2)
    found = robots.costs(repeats=2)
    assert list(found) == list(cases)
    assert all(0.0 < native < mjwarp < 1.0 for native, mjwarp in found.values())
    assert robots.table(found).count("\n") == 1 + len(cases)
