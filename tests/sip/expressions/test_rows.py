"""Guards sip/expressions/rows: bounds of rows over cells are above every value, close on short cells, and infinite
where there is none."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.index_sets import read_intervals
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import Decisions

NAMES = ("p", "q", "r", "s", "t")
POSITIVE = ("1.5 + {}*{}/9", "exp({}/4)", "2 + sin({})", "sqrt(3 + {})", "1 + ({})**2", "(3 + {})**1.3")
OTHERS = (
    "sin({})", "cos(2*{})", "tan({}/3)", "tanh(2*{})", "{}*{}", "{} - {}/3", "({})**3", "chebyshev(4, {}/2)", "abs({})",
    "exp(-{})", "sum(({})**k/(k + 1) for k in range(3))", "-{}*pi",
)  # fmt: skip
QUOTIENTS = ("log({})", "1/({})", "({})**-2", "({})**0.5", "({})**({}/7)", "2**({}/5)")


def random_text(rng: np.random.Generator, nu: int, depth: int = 2) -> str:
    """Return a random expression in the first coordinates, whose values are of moderate size on ``[-1, 1]``."""
    if depth == 0:
        return str(rng.choice(NAMES[:nu]))
    kind = rng.integers(3)
    shape = str(rng.choice((POSITIVE, OTHERS, QUOTIENTS)[kind]))
    parts = [random_text(rng, nu, depth - 1) for _ in range(shape.count("{}"))]
    if kind == 2:  # of an argument that stays positive
        parts[0] = f"2.5 + {rng.choice(NAMES[:nu])}*{rng.choice(NAMES[:nu])}"
    return shape.format(*(f"({part})" if len(part) > 1 else part for part in parts))


@pytest.mark.parametrize("nu", [1, 2, 3, 5])
def test_every_value_is_below_the_bound_of_its_cell(nu: int) -> None:
    """Of random expressions with every function of the language, at many places of cells of three widths."""
    rng = np.random.default_rng(nu)
    decision, finite = Decisions({"x": 2}), 0
    for width in (0.5, 0.1, 1e-3):
        for _ in range(9):
            texts = [f"x[0]*({random_text(rng, nu)}) <= {random_text(rng, nu)}", f"x[1] >= {random_text(rng, nu)}"]
            rows = ExpressionRows.parse(dict.fromkeys(NAMES[:nu], (-1.0, 1.0)), texts, decision, {})
            lower = rng.uniform(-1.0, 1.0 - width, (3, nu))
            upper, x = lower + width, rng.normal(size=2)
            bounds, axes = rows.enclose(x, lower, upper)
            assert bounds.shape == (3,) and ((axes >= 0) & (axes < nu)).all()
            for bound, low, high in zip(bounds, lower, upper, strict=True):
                places = np.concatenate(
                    [rng.uniform(low, high, (60, nu)), rng.choice([0.0, 1.0], (20, nu)) * (high - low) + low]
                )
                values = rows.violations(x, places).max(axis=1)
                assert np.isfinite(values).all()
                assert values.max() <= bound + 1e-14 * (1.0 + np.abs(values).max())
                finite += bool(np.isfinite(bound))
                if np.isfinite(bound) and width == 1e-3 and bound > 0.0:
                    assert bound - values.max() <= 0.2 * (1.0 + np.abs(values).max())
    assert finite >= 60  # of 81


@pytest.mark.parametrize("nu", [1, 2, 3])
def test_bounds_tighten_as_cells_shrink(nu: int) -> None:
    """As fast as the width, at least; the values themselves change by as much."""
    names = NAMES[:nu]
    text = " + ".join(f"sin(3*{name})*exp({name})" for name in names) + f" + tanh({'*'.join(names)}) >= x"
    rows = ExpressionRows.parse(dict.fromkeys(names, (0.0, 1.0)), text, Decisions({"x": None}), {})
    middle, x, gaps = np.full((1, nu), 0.4), np.array([9.0]), []
    for half in (0.1, 0.01, 0.001):
        lower, upper = middle - half, middle + half
        places = np.random.default_rng(0).uniform(lower, upper, (2000, nu))
        corners = np.concatenate([places, lower, upper])
        gaps.append(rows.enclose(x, lower, upper)[0][0] - rows.violations(x, corners).max())
    assert gaps[2] + 1e-12 >= 0.0 and gaps[1] <= 0.3 * gaps[0] + 1e-9 and gaps[2] <= 0.3 * gaps[1] + 1e-9


def test_a_violation_of_a_single_point_is_above_every_bound_of_its_cell() -> None:
    rows = ExpressionRows.parse({"t": (0.0, 1.0)}, "-(t - 0.3)**2 <= d", Decisions({"d": None}), {})
    for d, is_kept in ((1e-12, True), (0.0, False), (-1e-10, False)):
        bound = rows.enclose(np.array([d]), np.array([[0.0]]), np.array([[1.0]]))[0][0]
        assert bound >= -d and (bound <= 0.0) == is_kept


@pytest.mark.parametrize(
    "text",
    [
        "log(t)",
        "sqrt(t - 0.4)",
        "1/t",
        "t**-1",
        "t**-0.5",
        "t**t",
        "log(t - 0.4)",
        "1/(t - 0.3)",
        "tan(2*t)",
        "log(0.9 - t)",
    ],
)
def test_a_row_without_an_enclosure_has_an_infinite_bound_and_no_other_row_has(text: str) -> None:
    for row in (f"x*({text}) <= 1", f"{text} <= x", f"x + {text} >= 0"):
        rows = ExpressionRows.parse({"t": (0.0, 1.0)}, row, Decisions({"x": None}), {})
        for x in (1.0, -1e9, 1e9):
            assert rows.enclose(np.array([x]), np.array([[0.0]]), np.array([[1.0]]))[0][0] == np.inf


def test_arithmetic_on_the_decision_alone_is_rounded_outwards() -> None:
    rows = ExpressionRows.parse({"t": (0.0, 1.0)}, "1e10*(a[0] + a[1]) - 1e10 + t*0 <= 0", Decisions({"a": 2}), {})
    bound = rows.enclose(np.array([1.0, 1e-16]), np.array([[0.0]]), np.array([[1.0]]))[0][0]
    assert 1e-6 <= bound <= 1e-4


@pytest.mark.parametrize(
    ("index", "row", "decision"),
    [
        ({"t": 5}, "x <= t", {"x": None}),
        ({"t": ("a", "b")}, "x <= t", {"x": None}),
        ({1: (0, 1)}, "x <= 1", {"x": None}),
        ([("t", (0, 1))], "x <= 1", {"x": None}),
        ({"t": (0, 1)}, 5, {"x": None}),
        ({"t": (0, 1)}, [5], {"x": None}),
        ({"t": (0, 1)}, None, {"x": None}),
        ({"t": (0, 1)}, "x <= 1", {1: 3}),
        ({"t": (0, 1)}, "x <= 1", ["x"]),
        ({"t": (0, 1)}, "sum(x for k in range(1e19)) <= 1", {"x": None}),
    ],
)
def test_arguments_of_other_kinds_are_refused(index: Any, row: Any, decision: Any) -> None:
    with pytest.raises(InputError):
        sr.ConstraintFamily.from_expressions("f", index=index, rows=row, decision=decision)


def test_tables_of_other_kinds_are_refused() -> None:
    for tables in (None, [1.0], {3: [1.0]}, {"c": [[1.0], [1.0, 2.0]]}, {"c": "a"}):
        with pytest.raises(InputError):
            sr.ConstraintFamily.from_expressions(
                "f", index={"t": (0, 1)}, rows="x <= t", decision={"x": None}, tables=tables
            )


def test_cells_of_no_width_and_rows_without_an_index_have_bounds() -> None:
    index = {"p": (0.5, 0.5), "q": (0.0, 1.0)}
    rows = ExpressionRows.parse(index, ["p*q <= x", "1 <= x"], Decisions({"x": None}), {})
    bounds, axes = rows.enclose(np.array([1.25]), np.array([[0.5, 0.0]]), np.array([[0.5, 1.0]]))
    assert -0.25 <= bounds[0] <= -0.25 + 1e-12 and axes.tolist() == [1]


def test_many_cells_have_the_bounds_of_each() -> None:
    rows = ExpressionRows.parse({"t": (0.0, 1.0)}, ["sin(9*t) <= x", "cos(9*t) <= x"], Decisions({"x": None}), {})
    edges = np.linspace(0.0, 1.0, 2001)[:, None]
    x = np.array([0.5])
    together, _ = rows.enclose(x, edges[:-1], edges[1:])
    for cell in (0, 777, 1999):
        alone, _ = rows.enclose(x, edges[[cell]], edges[[cell + 1]])
        assert together[cell] == pytest.approx(alone[0], abs=1e-13)


@pytest.mark.parametrize("interval", [[1.0, 0.0], [0.0], [0.0, 1.0, 2.0], [0.0, np.inf], [np.nan, 1.0], []])
def test_an_interval_has_two_ends_in_order(interval: list[float]) -> None:
    with pytest.raises(InputError, match=r"index\.t: expected an interval \[lower, upper\]"):
        read_intervals({"t": interval})
    with pytest.raises(InputError, match="index: expected at least one coordinate"):
        read_intervals({})


def test_a_family_of_python_names_its_text() -> None:
    index, decision = {"t": (0.0, 1.0)}, {"a": 2}
    with pytest.raises(InputError, match=r"a\[2\]: expected a number from 0 to 1, got 2"):
        sr.ConstraintFamily.from_expressions("f", index=index, rows="a[2]*t <= 1", decision=decision)
    with pytest.raises(InputError, match="rows: expected at least one row"):
        sr.ConstraintFamily.from_expressions("f", index=index, rows=[], decision=decision)
    family = sr.ConstraintFamily.from_expressions(
        "f", index=index, rows="a[0] + c[1]*a[1]*t >= t", decision=decision, tables={"c": [0, 2]}
    )
    G, h = family.rows(np.array([[0.5]]))
    assert G.tolist() == [[[-1.0, -1.0]]] and h.tolist() == [[-0.5]]


def test_rounding_errors_of_rows_are_bounded_where_their_terms_cancel() -> None:
    """Against fractions, of polynomials whose terms are up to a million times as large as their sums."""
    rng, decision = np.random.default_rng(8), Decisions({"x": 2})
    texts = ["x[0]*((1 + t)**6 - 1) <= x[1] - t^2", "x[1]*t <= (t + 3)**5 - t**5 - 243"]
    rows = ExpressionRows.parse({"t": (-1.0, 1.0)}, texts, decision, {})
    indices, x = 10.0 ** rng.uniform(-9.0, 0.0, (200, 1)), rng.normal(size=2)
    G, h = rows.evaluate(indices)
    bounds, largest = rows.roundings(np.abs(x), indices), 0.0
    assert bounds.shape == (200, 2)
    for k, index in enumerate(indices[:, 0].tolist()):
        t, (a, b) = Fraction(index), (Fraction(number) for number in x.tolist())
        exact = a * ((1 + t) ** 6 - 1) - b + t**2, b * t - (t + 3) ** 5 + t**5 + 243
        for row in range(2):
            value = sum(Fraction(float(c)) * n for c, n in zip(G[k, row], (a, b), strict=True)) - Fraction(h[k, row])
            error = float(abs(value - exact[row]))
            assert error <= bounds[k, row]
            largest = max(largest, error / bounds[k, row])
    assert largest > 1e-3


def test_rounding_errors_of_rows_are_those_of_the_largest_decision() -> None:
    rows = ExpressionRows.parse({"t": (0.0, 2.0)}, ["x[0] + x[1]*((1e16 + t) - 1e16) <= t"], Decisions({"x": 2}), {})
    bounds = [
        rows.roundings(np.array(reach), np.array([[1.0]]))[0, 0] for reach in ([1.0, 0.0], [1.0, 1.0], [1.0, 3.0])
    ]
    assert bounds[0] < 1e-14 and 1.0 <= bounds[1] <= 4.0 and bounds[2] == pytest.approx(3.0 * bounds[1])
