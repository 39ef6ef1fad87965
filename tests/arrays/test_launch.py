"""Launches by name: any order, shared memory, and one clear error for whatever does not fit the kernel."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Annotated, Any

import pytest
import torch
import warp as wp

from pace.arrays.launch import Bound, Launch, LaunchError, MaskedLaunch, table
from pace.arrays.tensors import Bool, Vec3, struct_of

CPU = torch.device("cpu")


@dataclass
class Inner:
    on: Bool


@dataclass
class Outer:
    inner: Inner
    points: Annotated[Vec3, "feet"]


@struct_of(Outer)
class OuterArrays:
    """As the kernel sees it."""


@wp.kernel
def _scale(mask: wp.array[wp.bool], factor: float, shift: wp.vec2, values: wp.array[wp.vec3], total: wp.array[float]):
    world = wp.tid()
    if mask[world]:
        values[world] = factor * values[world]
        total[world] = values[world][0] + values[world][1] + values[world][2] + shift[0] + shift[1]


@wp.kernel
def _nested(outer: OuterArrays, foot: int):
    world = wp.tid()
    outer.inner.on[world] = outer.points[world, foot][2] > 0.0


@wp.struct
class Row:
    values: wp.array[float]
    gain: float


@wp.kernel
def _add_rows(rows: wp.array[Row], out: wp.array[float]):
    world = wp.tid()
    for i in range(rows.shape[0]):
        out[world] += rows[i].gain * rows[i].values[world]


def arguments(**others: Any) -> dict[str, Any]:
    """Of :func:`_scale`, for two worlds."""
    given = {"total": torch.zeros(2), "values": torch.ones(2, 3), "factor": 2.0, "shift": (0.5, 0.25)}
    return given | {"mask": torch.tensor([True, False])} | others


def launch(**others: Any) -> Launch:
    return Launch(_scale, 2, CPU, **arguments(**others))


def test_names_may_come_in_any_order_and_a_replay_reads_the_memory_again() -> None:
    for order in (reversed, sorted):
        given = arguments()
        scale = Launch(_scale, 2, CPU, **{name: given[name] for name in order(list(given))})
        assert given["total"].tolist() == [0.0, 0.0]  # recorded, not run
        scale()
        assert given["values"].tolist() == [[2.0] * 3, [1.0] * 3]
        given["mask"].fill_(True)
        scale()
        assert given["total"].tolist() == [12.75, 6.75]


def test_tensors_are_kept_alive() -> None:
    values = torch.ones(2, 3)
    scale = launch(values=values.view(2, 3), mask=torch.tensor([True, True]))
    for _ in range(20):
        scale()
        torch.zeros(2, dtype=torch.bool)  # would take the memory of a mask that is gone
    assert values[0, 0] == 2.0**20


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"vales": torch.ones(2, 3)}, r"kernel '_scale' has no argument 'vales' \(did you mean 'values'\?\); it takes"),
        ({"other": 1}, "kernel '_scale' has no argument 'other'; it takes mask, factor, shift, values, total"),
        ({"values": torch.ones(2, 4)}, r"kernel '_scale', argument 'values' must be .*float32 of shape \(\*, 3\), not"),
        ({"values": torch.ones(3)}, r"argument 'values' must be .* not torch.float32 \(3,\)"),
        ({"values": torch.ones(2, 3, 3)}, r"argument 'values' must be .* not torch.float32 \(2, 3, 3\)"),
        ({"values": torch.ones(2, 3).double()}, r"argument 'values' must be torch.float32 .* not torch.float64"),
        ({"values": torch.ones(3, 2).T}, "argument 'values' must hold the numbers of each vector contiguously"),
        ({"values": torch.ones(2, 3, device="meta")}, "argument 'values' must lie on cpu, not on meta"),
        ({"values": 1.0}, r"kernel '_scale', argument 'values' must be a tensor, not 1\.0"),
        ({"mask": torch.ones(2)}, r"argument 'mask' must be torch.bool of shape \(\*\), not torch.float32"),
        ({"factor": torch.ones(2)}, "kernel '_scale', argument 'factor' must be float32, not a tensor"),
        ({"factor": None}, "kernel '_scale', argument 'factor' must be float32, not None"),
        ({"shift": (1.0,)}, r"kernel '_scale', argument 'shift' must be vec2f, not \(1.0,\)"),
    ],
)
def test_what_does_not_fit_is_named(others: dict[str, Any], message: str) -> None:
    with pytest.raises(LaunchError, match=message):
        launch(**others)


def test_missing_and_misspelt_names_are_one_error() -> None:
    given = arguments()
    del given["total"]
    with pytest.raises(LaunchError, match="kernel '_scale' misses argument 'total'"):
        Launch(_scale, 2, CPU, **given)
    del given["factor"]
    with pytest.raises(LaunchError, match=r"no argument 'facto' \(did you mean 'factor'\?\), misses argument 'factor'"):
        Launch(_scale, 2, CPU, facto=2.0, **given)


@pytest.mark.parametrize("kind", ["dataclass", "attributes", "keys"])
def test_structs_are_made_of_what_has_their_fields(kind: str) -> None:
    on, points = torch.zeros(2, dtype=torch.bool), torch.zeros(2, 2, 3)
    points[1, 0, 2] = 1.0
    outer: Any = {
        "dataclass": Outer(Inner(on), points),
        "attributes": SimpleNamespace(points=points, inner=SimpleNamespace(on=on), unused=None),
        "keys": {"inner": {"on": on}, "points": points},
    }[kind]
    Launch(_nested, 2, CPU, foot=0, outer=outer)()
    assert on.tolist() == [False, True]


def test_a_fault_within_a_struct_is_named() -> None:
    on = torch.zeros(2, dtype=torch.bool)
    with pytest.raises(LaunchError, match="kernel '_nested', argument 'outer' misses 'points', which OuterArrays has"):
        Launch(_nested, 2, CPU, foot=0, outer={"inner": {"on": on}})
    points = torch.zeros(2, 2, 3)
    with pytest.raises(LaunchError, match=r"argument 'outer'.inner.on must be torch.bool of shape \(\*\)"):
        Launch(_nested, 2, CPU, foot=0, outer=Outer(Inner(on.float()), points))
    with pytest.raises(LaunchError, match=r"argument 'outer'.points must be torch.float32 of shape \(\*, \*, 3\)"):
        Launch(_nested, 2, CPU, foot=0, outer=Outer(Inner(on), points[0]))


def test_tables_are_made_of_rows() -> None:
    out, columns = torch.zeros(2), torch.tensor([[1.0, 10.0], [2.0, 20.0]])
    rows = [{"values": column, "gain": gain} for column, gain in zip(columns.unbind(1), (1.0, 0.5), strict=True)]
    Launch(_add_rows, 2, CPU, out=out, rows=table(Row, rows, CPU))()
    assert out.tolist() == [6.0, 12.0]
    with pytest.raises(LaunchError, match="misses 'gain', which Row has"):
        table(Row, [{"values": out}], CPU)


def test_masked_launches_take_a_mask_or_all() -> None:
    given = arguments()
    del given["mask"]
    scale = MaskedLaunch(_scale, 2, CPU, **given)
    scale(torch.tensor([False, True]))
    assert given["values"][:, 0].tolist() == [1.0, 2.0]
    scale(None)
    assert given["values"][:, 0].tolist() == [2.0, 4.0]
    with pytest.raises(LaunchError, match="misses argument 'total'"):
        MaskedLaunch(_scale, 2, CPU, **{name: value for name, value in given.items() if name != "total"})


def test_bound_makes_again_for_other_tensors_only() -> None:
    made = []
    bound = Bound(lambda a, b: made.append((a, b)) or len(made), a=(2, 3), b=None)
    a, b = torch.zeros(2, 3), object()
    assert [bound(a, b), bound(a, b)] == [1, 1]
    equal = a.clone()
    assert [bound(equal, b), bound(equal, b), bound(a, b), bound(a, object())] == [2, 2, 3, 4]
    with pytest.raises(ValueError, match=r"a must have shape \(2, 3\), not \(1, 3\)"):
        bound(torch.zeros(1, 3), b)
    assert len(made) == 4
    with pytest.raises(ValueError, match="zip"):
        bound(a)


def test_what_was_refused_is_refused_again() -> None:
    bound = Bound(lambda a: launch(values=a), a=None)
    wrong = torch.zeros(2, 4)
    for _ in range(2):
        with pytest.raises(LaunchError):
            bound(wrong)


def test_an_unknown_field_of_a_struct_is_named() -> None:
    values, out = torch.ones(2), torch.zeros(2)
    with pytest.raises(LaunchError, match=r"row has no field gian; .* has values, gain"):
        table(Row, [{"values": values, "gain": 1.0, "gian": 2.0}], CPU)
    rows = table(Row, [{"values": values, "gain": 2.0}], CPU)
    Launch(_add_rows, 2, CPU, rows=rows, out=out)()
    assert out.tolist() == [2.0, 2.0]


def test_a_mask_is_given_with_each_call() -> None:
    with pytest.raises(LaunchError, match=r"kernel '.*_scale.*': the argument 'mask' is given with each call"):
        MaskedLaunch(_scale, 2, CPU, mask=torch.ones(2, dtype=torch.bool), factor=1.0)
