"""Guards checker/problem/superposition: seen at the deviations of any parameters, the larger system is the problem's at
these parameters, corners hold the box exactly, and what is not affine is refused."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.problem.superposition import ParameterExpansion, parted
from sparserob_core.control.problem.cost import Quadratic
from sparserob_core.control.sets.sets import Box, NormBall
from sparserob_core.sip.expressions.expression import parse_matrix

BOX, NAMES = Box([-0.1, 0.3, 2.0], [0.7, 0.8, 2.0]), ("p", "q", "r")
A = [["-t", "0", "0"], ["p * (1 - t) + q / 2", "0", "0"], ["1 + 2*t - (3*t + q)", "3", "cos(t) ^ 2"]]
B = [["0"], ["2 - p / exp(t) + q"], ["t * (1 + 3 * p)"]]
E = [["0", "0"], ["q * t", "+p"], ["-(p + q)", "1"]]
C = ["0", "q - p", "sqrt(1 + t) * q"]


def problem_of(system: sr.VaryingSystem, **more: Any) -> sr.OptimalControlProblem:
    return sr.OptimalControlProblem(
        **{
            "system": system,
            "horizon": 2.0,
            "initial_state": [1.0, -1.0, 0.5],
            "control": Box([-1.0], [1.0]),
            "disturbance": Box([-0.1, -0.1], [0.1, 0.1]),
            **more,
        }
    )


def plant() -> tuple[sr.VaryingSystem, ParameterExpansion]:
    system = sr.VaryingSystem.of(A, B, 2.0, E, C, parameters=BOX, names=NAMES)
    return system, ParameterExpansion(system, tuple(BOX.interior_point().tolist()))


def matrix(law: Any, name: str, p: list[float]) -> np.ndarray:
    entry = law.entry(name)
    return np.asarray(entry(np.array(p)) if callable(entry) else entry, dtype=float)


def test_seen_at_any_parameters_the_larger_system_is_the_one_at_these() -> None:
    rng, (system, parts) = np.random.default_rng(2), plant()
    larger = parted(problem_of(system)).system
    assert larger.varies
    (law,), (big,) = system.phases, larger.phases
    assert parts.sensitive_states == [[1, 2], [1, 2], []]
    assert parts.scales == pytest.approx([0.4, 0.25, 0.0], rel=1e-15)
    for _ in range(5):
        p, t, z = rng.uniform(BOX.lower, BOX.upper), float(rng.uniform(0.0, 2.0)), rng.normal(size=parts.size)
        shares = [(v - m) / s if s else 0.0 for v, m, s in zip(p.tolist(), parts.middle, parts.scales, strict=True)]
        seen, here = parts.compute_projection(tuple(shares)), [t, *p.tolist()]
        np.testing.assert_allclose(
            seen @ matrix(big, "A", [t]) @ z, matrix(law, "A", here) @ seen @ z, rtol=1e-13, atol=1e-13
        )
        for name in ("B", "E", "c"):
            np.testing.assert_allclose(seen @ matrix(big, name, [t]), matrix(law, name, here), rtol=1e-13, atol=1e-13)


def test_corners_hold_the_box_exactly_and_no_more_than_rounding() -> None:
    """What an end deviates by from the middle is no number most times; of what moves nothing one corner suffices."""
    assert {corner[2] for corner in plant()[1].corners()} == {0.0}
    rng = np.random.default_rng(3)
    for _ in range(20):
        low, high = -rng.uniform(size=2) * 10.0 ** rng.integers(-9, 1, 2), rng.uniform(1.0, 2.0, size=2)
        system = sr.VaryingSystem.of([["0"]], [["p + q"]], 2.0, parameters=Box(low, high), names=("p", "q"))
        parts = ParameterExpansion(system, tuple(rng.uniform(0.3, 0.9, size=2).tolist()))
        corners = list(parts.corners())
        assert len(corners) == 4 == len({*corners})
        for j, (least, most) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
            middle, unit = Fraction(parts.middle[j]), Fraction(parts.scales[j])
            far = max(Fraction(most) - middle, middle - Fraction(least))
            assert far <= unit <= far * (1 + Fraction(2) ** -52)
            assert {corner[j] for corner in corners} == {-1.0, 1.0}


def test_rows_are_those_of_every_corner_and_what_begins_is_certain_of_the_new_coordinates() -> None:
    system, parts = plant()
    H, G, h = np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]), np.array([[0.5], [0.25]]), np.array([3.0, 4.0])
    wide = Box([-9.0, -8.0, -np.inf], [9.0, 7.0, np.inf])
    made: Any = parted(
        problem_of(
            system,
            initial_set=Box([-0.1, 0.0, -0.2], [0.1, 0.0, 0.3]),
            path=[
                sr.PathConstraint(wide, relative_to=[[0, 1, 2, 3], [2, 0, 0, 0]]),
                sr.MixedConstraint(H, G, h),
            ],
            terminal=[Box([-1.0, -2.0, -3.0], [1.0, 2.5, 3.0])],
            integral=[sr.IntegralConstraint(H[:1], G[:1], upper=[5.0])],
            cost=sr.Cost(final=Quadratic(np.eye(3), np.array([0.0, 1.0, 0.0]))),
        )
    )
    seen = [parts.compute_projection(corner) for corner in parts.corners()]
    walls, mixed = made.path
    (end,), (total,) = made.terminal, made.integral

    def same(found: Any, blocks: list[np.ndarray]) -> None:
        wanted = {tuple(row) for block in blocks for row in block.tolist()}
        assert {tuple(row) for row in np.column_stack(found).tolist()} == wanted

    for shape, bound in ((walls.set, wide), (end, Box([-1.0, -2.0, -3.0], [1.0, 2.5, 3.0]))):
        flat = bound.halfspaces()
        assert flat is not None
        same(shape.halfspaces(), [np.column_stack([flat[0] @ one, flat[1]]) for one in seen])
    same((mixed.H, mixed.G, mixed.h), [np.column_stack([H @ one, G, h]) for one in seen])
    same(
        (total.H, total.G, total.lower, total.upper),
        [np.column_stack([H[:1] @ one, G[:1], [-np.inf], [5.0]]) for one in seen],
    )
    np.testing.assert_array_equal(walls.relative_to, [[0, 1, 2, 3, 0, 0, 0, 0], [2, 0, 0, 0, 0, 0, 0, 0]])
    np.testing.assert_array_equal(made.initial_state, [1.0, -1.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(made.initial_set.lower, [-0.1, 0.0, -0.2, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(made.initial_set.upper, [0.1, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(made.cost.final.Q, np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
    round_: Any = parted(problem_of(system, initial_set=NormBall(2.0, 0.1, dimension=3))).initial_set
    assert [part.dimension for part in round_.parts] == [3, 4]


@pytest.mark.parametrize(
    "entry",
    [
        "p * q",
        "p ^ 2",
        "1 / p",
        "t / (1 + q)",
        "sin(p)",
        "exp(p * t)",
        "2 ^ p",
        "p * p",
        "(p + t) * (q - t)",
        "t ^ p",
        "p * q * t",
        "p ^ 2 / 2",
        "-(p * q)",
        "1 + p * q",
        "p - sin(q)",
        "cos(p * q)",
        "p ^ t",
        "sqrt(t + p)",
        "0 * p * q",
        "(p - p) * q",
        "1 - t * (2 + t * sin(p))",
    ],
)
def test_entries_that_are_not_affine_are_refused(entry: str) -> None:
    system, _ = plant()
    with pytest.raises(Unchecked, match="affinely"):
        ParameterExpansion(system, tuple(BOX.interior_point().tolist())).tables(
            parse_matrix("B", [[entry]], ("t", *NAMES)), 1.5
        )


@pytest.mark.parametrize(
    ("place", "entry"), [((0, 1), "p"), ((2, 2), "q"), ((1, 2), "1 + p"), ((0, 2), "1"), ((1, 1), "q * t")]
)
def test_a_parameter_that_meets_a_state_that_depends_on_one_is_refused(place: tuple[int, int], entry: str) -> None:
    """Where the first state depends on the third, its own parameters meet what depends on them."""
    system, _ = plant()
    rows = [list(row) for row in A]
    rows[place[0]][place[1]] = entry
    other = replace(system.phases[0], A=parse_matrix("A", rows, ("t", *NAMES)))
    made = object.__new__(sr.System)
    made.__dict__.update(system.__dict__ | {"phases": (other,)})
    with pytest.raises(Unchecked, match="affinely"):
        assert ParameterExpansion(made, tuple(BOX.interior_point().tolist())).sensitive_states


@pytest.mark.parametrize("name", ["A", "B", "E", "c"])
def test_all_that_is_downstream_of_an_entry_with_a_parameter_depends_on_it(name: str) -> None:
    """A chain of five states; the parameter stands where the second one is driven, in one of the matrices."""
    chain: dict[str, list[Any]] = {
        "A": [["t" if i == j + 1 else "0" for j in range(5)] for i in range(5)],
        "B": [["1"], *[["0"]] * 4],
        "E": [["t"], *[["0"]] * 4],
        "c": ["1", *["0"] * 4],
    }
    for other in chain:
        entries = {key: [list(row) if isinstance(row, list) else row for row in rows] for key, rows in chain.items()}
        if name == "c":
            entries["c"][1] = "p"
        else:
            entries[name][1][0] = "p + t"
        if other != name:  # the other parameter, elsewhere
            entries[other][2] = "q" if other == "c" else ["q", *entries[other][2][1:]]
        system = sr.VaryingSystem.of(
            entries["A"],
            entries["B"],
            2.0,
            entries["E"],
            entries["c"],
            parameters=Box([-1.0, -1.0], [1.0, 1.0]),
            names=("p", "q"),
        )
        assert ParameterExpansion(system, (0.0, 0.0)).sensitive_states == [
            [1, 2, 3, 4],
            [2, 3, 4] if other != name else [],
        ]


@pytest.mark.parametrize(
    ("entry", "steady", "slope"),
    [
        ("sin(t) + p * cos(t)", np.sin(1.5), np.cos(1.5)),
        ("tan(t) - exp(t) * p", np.tan(1.5), -np.exp(1.5)),
        ("log(t) * (2 - p)", 2 * np.log(1.5), -np.log(1.5)),
        ("(p + 3) / tanh(t)", 3 / np.tanh(1.5), 1 / np.tanh(1.5)),
        ("sqrt(t) + 2 ^ t * p", np.sqrt(1.5), 2**1.5),
        ("t ^ 3 - (1 - p)", 1.5**3 - 1, 1.0),
        ("+kepler(t, 0)", 1.5, 0.0),
        ("p ^ 1 * 3 - p ^ 0", -1.0, 3.0),
        ("(p + r) / t + r ^ 3 * t ^ 2 - exp(r)", 2.0 / 1.5 + 8.0 * 2.25 - np.exp(2.0), 1 / 1.5),
    ],
)
def test_entries_are_split_into_what_is_steady_and_what_a_parameter_multiplies(
    entry: str, steady: float, slope: float
) -> None:
    system, _ = plant()
    parts = ParameterExpansion(system, (0.25, 0.5, 2.0))
    first, by_p, *rest = (float(one[0, 0]) for one in parts.tables(parse_matrix("B", [[entry]], ("t", *NAMES)), 1.5))
    assert first == pytest.approx(steady + 0.25 * slope, rel=1e-14)
    assert by_p == pytest.approx(0.45 * slope, rel=1e-14)  # from 0.25 to 0.7, the farther end
    assert rest == [0.0, 0.0]
