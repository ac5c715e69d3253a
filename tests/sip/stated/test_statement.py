"""Guards sip/stated: what a text states is the program that is solved, its faults are told with their keys, and
residuals do not square a condition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flint import arb_mat, ctx

import sparserob_core as sr
from sparserob_core.errors import InputError
from sparserob_core.sip.stated import statement
from sparserob_core.sip.stated.statement import StatedDecision, StatedFamily, StatedProgram
from tests.support.stated import state

UNIT = {"t": (0.0, 1.0)}


def cost_of(program: StatedProgram, named: np.ndarray) -> float:
    """Return the cost that the built program gives to the named entries of a decision, with their residuals."""
    built = program.build()
    x = np.append(named, np.zeros(built.n - named.size))
    for k, term in enumerate(program.residuals):
        x[named.size + k] = term.constant + term.coefficients @ x[term.positions]
    finite = built.finite
    if finite.A.size:
        assert np.abs(finite.A @ x - finite.b)[len(finite.b) - len(program.residuals) :] == pytest.approx(
            0.0, abs=1e-12
        )
    quadratic = 0.0 if finite.P is None else 0.5 * float(x @ (finite.P @ x))
    return float(finite.q @ x + finite.weights @ np.abs(x) + quadratic + built.constant)


OBJECTIVES = {
    "x + 2": lambda a, x: x + 2,
    "x**2 + 3*x": lambda a, x: x**2 + 3 * x,
    "(x - 3)**2/2": lambda a, x: (x - 3) ** 2 / 2,
    "(2*x)**2 + a[1]": lambda a, x: 4 * x**2 + a[1],
    "x*x + x*a[0] + a[0]**2": lambda a, x: x * x + x * a[0] + a[0] ** 2,
    "(x + a[0])*(a[0] + x)": lambda a, x: (x + a[0]) ** 2,
    "3*abs(2*x) + abs(a[0] - 1)": lambda a, x: 6 * abs(x) + abs(a[0] - 1),
    "sum((a[k] - k)**2 for k in range(3)) + sum(abs(a[k]) for k in range(3))": lambda a, x: (
        sum((a[k] - k) ** 2 for k in range(3)) + np.abs(a).sum()
    ),
    "sum(abs(sum(a[k]*j**k for k in range(3)) - j) for j in range(4))": lambda a, x: sum(
        abs(sum(a[k] * j**k for k in range(3)) - j) for j in range(4)
    ),
    "5": lambda a, x: 5.0,
    "abs(3) + (2)**2": lambda a, x: 7.0,
}


@pytest.mark.parametrize("text", OBJECTIVES)
def test_the_program_costs_what_the_text_says(text: str) -> None:
    program = state({"a": 3, "x": None}, text, "x >= t")
    for point in np.random.default_rng(0).normal(size=(4, 4)):
        assert cost_of(program, point) == pytest.approx(OBJECTIVES[text](point[:3], point[3]), rel=1e-12, abs=1e-12)


def test_rows_bounds_and_families_are_those_of_the_text() -> None:
    program = StatedProgram(
        {"a": StatedDecision(2, [0.0, -1.0], 5.0), "x": StatedDecision()},
        "x + (a[0] - a[1])**2",
        [StatedFamily("first", UNIT, ["x >= t*a[0]"]), StatedFamily("second", {"u": (2.0, 3.0)}, ["a[1] <= u"])],
        ["a[0] + a[1] == 1", "1 <= x + a[1] <= 4"],
    ).build()
    assert program.n == 4
    assert program.finite.lower.tolist() == [0.0, -1.0, -np.inf, -np.inf]
    assert program.finite.upper.tolist() == [5.0, 5.0, np.inf, np.inf]
    assert program.finite.G.tolist() == [[0.0, -1.0, -1.0, 0.0], [0.0, 1.0, 1.0, 0.0]]
    assert program.finite.h.tolist() == [-1.0, 4.0]
    assert program.finite.A.tolist() == [[1.0, 1.0, 0.0, 0.0], [1.0, -1.0, 0.0, -1.0]]
    assert program.finite.b.tolist() == [1.0, 0.0]
    assert [family.name for family in program.families] == ["first", "second"]
    G, h = program.families[0].rows(np.array([[0.5]]))
    assert G.tolist() == [[[0.5, 0.0, -1.0, 0.0]]] and h.tolist() == [[0.0]]


def test_an_entry_alone_needs_no_residual() -> None:
    assert len(state({"a": 2}, "a[0]**2 + 3*abs(2*a[1]) + a[0]*a[1]").residuals) == 0
    assert len(state({"a": 2}, "(a[0] + a[1])**2").residuals) == 1  # both factors are the same text
    assert len(state({"a": 2}, "abs(a[0] - 1)").residuals) == 1


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "an objective with an index": ({"minimise": "t"}, "minimise: expression 't': unknown name 't'"),
    "a cube": ({"minimise": "x**3"}, "minimise: objective 'x**3': a power of a decision"),
    "a negative modulus": ({"minimise": "-abs(x)"}, "minimise: expected absolute values with weights of at least 0"),
    "a row": ({"rows": ["x <= 1", "x < 1"]}, "rows.1: row 'x < 1'"),
    "a row with an index": ({"rows": ["x <= t"]}, "rows.0: expression 'x <= t': unknown name 't'"),
    "a family": ({"families": [StatedFamily("f", UNIT, ["x*x <= t"])]}, "families.0: row 'x*x <= t'"),
    "the second family": (
        {"families": [StatedFamily("f", UNIT, ["x <= t"]), StatedFamily("g", UNIT, ["x <= u"])]},
        "families.1: expression 'x <= u': unknown name 'u'",
    ),
    "no rows": ({"families": [StatedFamily("f", UNIT, [])]}, "families.0.rows: expected at least one row"),
    "an interval": ({"families": [StatedFamily("f", {"t": (1.0, 0.0)}, ["x <= t"])]}, "families.0.index.t: expected"),
    "an index that is a decision": (
        {"families": [StatedFamily("f", {"x": (0.0, 1.0)}, ["x <= 1"])]}, "families.0.index.x: expected a name"
    ),
    "a table": ({"tables": {"c": ["a"]}}, "tables.c: expected a list of finite numbers"),
    "a size": ({"decision": {"x": StatedDecision(0)}}, "decision.x: expected a number of entries"),
    "a bound": ({"decision": {"x": StatedDecision(None, "low")}}, "decision.x.lower"),
    "bounds of another length": ({"decision": {"x": StatedDecision(2, [1.0, 2.0, 3.0])}, "minimise": "x[0]",
                                  "families": []}, "decision.x.lower"),
    "a bound above the other": (
        {"decision": {"x": StatedDecision(2, [0.0, 2.0], 1.0)}, "minimise": "x[0]", "families": []},
        "decision.x.lower: expected numbers that are not above those of upper",
    ),
    "a name": ({"decision": {"sum": StatedDecision()}}, "decision.sum: expected a name"),
    "no decision": ({"decision": {}}, "decision: expected at least one name"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_with_its_key(fault: str) -> None:
    parts = {"decision": {"x": StatedDecision()}, "minimise": "x", "families": [StatedFamily("f", UNIT, ["x >= t"])]}
    changes, message = FAULTS[fault]
    with pytest.raises(InputError) as caught:
        StatedProgram(**{**parts, **changes}).build()
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("objective", ["-x**2", "x*y", "x**2 + 3*x*y + y**2", "(x + y)**2 - 3*(x - y)**2"])
def test_an_objective_that_is_not_convex_is_refused(objective: str) -> None:
    with pytest.raises(InputError, match="minimise: expected a positive semidefinite matrix"):
        state({"x": (None, -1.0, 1.0), "y": (None, -1.0, 1.0)}, objective, "x >= -t").build()


def least_squares(F: np.ndarray, y: np.ndarray) -> float:
    """Return the least value of ``|F a - y|^2``, by the normal equations in 600 bits."""
    with ctx.workprec(600):
        A, b = arb_mat(F.tolist()), arb_mat([[value] for value in y.tolist()])
        residual = A * (A.transpose() * A).solve(A.transpose() * b) - b
        return float((residual.transpose() * residual)[0, 0].mid())


@pytest.mark.parametrize(("condition", "noise", "accuracy"), [(1e6, 1.0, 1e-7), (1e10, 1e-10, 0.6)])
def test_least_squares_do_not_square_a_condition(condition: float, noise: float, accuracy: float) -> None:
    """A squared one of 1e20 would leave no digit of a value of 1e-20."""
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.normal(size=(rows, 3)))[0] for rows in (8, 3))
    F = left @ np.diag([1.0, condition**-0.5, 1.0 / condition]) @ right
    y = F @ np.array([1.0, -2.0, 0.5]) + noise * rng.normal(size=8)
    value = least_squares(F, y)
    text = "sum((sum(F[i, k]*a[k] for k in range(3)) - y[i])**2 for i in range(8))"
    program = state({"a": 3}, text, tables={"F": F, "y": y})
    assert len(program.residuals) == 8
    result = sr.solve(program.build(), seconds=20)
    assert value * (1.0 - 1e-12) <= result.cost <= value * (1.0 + accuracy)
    assert value * (1.0 - accuracy) <= result.lower_bound <= value * (1.0 + 1e-12)


def test_a_decision_of_too_many_terms_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statement, "MAX_STATED_ENTRIES", 20)
    with pytest.raises(InputError, match="minimise: expected at most 20 terms, got 30"):
        state({"a": 2}, "sum((a[0] - k - 1)**2 for k in range(30))", "a[0] >= t").build()


TOGETHER = {  # with the same polynomial, multiplied out by hand
    "(x + y)*(x - y) + 2*y^2": "x^2 + y^2",
    "(x + y)^2 + (x - y)^2 - x^2": "x^2 + 2*y^2",
    "(x - y)^2 + x*y": "x^2 - x*y + y^2",
    "(x + y - 1)*(x - y + 2) + 3*y^2": "x^2 + x + 2*y^2 + 3*y - 2",
    "2*(3 - x)*(x - 3*y)*(-1) + 6*(x - 3)*y + abs(x - y - 1)": "2*x^2 - 6*x + abs(x - y - 1)",
    "(x + y)*(x + y + 2) + y*(y - x) + x*y": "(x + y)^2 + 2*x + 2*y + y^2",
}


@pytest.mark.slow
@pytest.mark.parametrize("text", TOGETHER)
def test_products_are_convex_together(text: str) -> None:
    """The least value is that of the polynomial, which is a sum of squares; no product is judged by itself."""
    programs = [state({"x": None, "y": None}, minimise, "x + y >= 1 + t") for minimise in (text, TOGETHER[text])]
    first, second = (sr.solve(program.build()) for program in programs)
    assert first.status == second.status == "certified"
    assert first.cost == pytest.approx(second.cost, abs=1e-7)
    rng = np.random.default_rng(0)
    for x in rng.normal(size=(5, 2)):
        polynomial, objective = programs[0].polynomial, programs[0].objective
        hidden = [float(term.constant + term.coefficients @ x[term.positions]) for term in programs[0].residuals]
        every = [*x, *hidden]
        value = float(polynomial.constant) + sum(float(c) * every[i] for i, c in polynomial.slopes.items())
        value += sum(float(c) * every[i] * every[j] for (i, j), c in polynomial.products.items())
        value += sum(weight * abs(every[i] * factor) for weight, (i, factor) in programs[0].absolutes)
        names = {"x": x[0], "y": x[1], "abs": abs}
        assert value == pytest.approx(eval(text.replace("^", "**"), names), abs=1e-12)
        assert objective.count_pairs() > 0


@pytest.mark.parametrize("text", ["(x + y)*(x - y)", "x*y", "(x + y)^2 - (x - y)^2", "(x - y)^2 - 0.01*x^2 - 0.01*y^2"])
def test_products_that_are_not_convex_together_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="minimise: expected a positive semidefinite matrix"):
        state({"x": None, "y": None}, text, "x + y >= 1 + t").build()


def test_squares_alone_are_never_multiplied_out() -> None:
    """So that least squares keep the condition of their matrix."""
    text = "sum((sum(a[k]*c[i]^k for k in range(3)) - c[i])^2 for i in range(5))"
    program = state({"a": 3}, text, "a[0] >= t", tables={"c": [0.1, 0.2, 0.4, 0.7, 1.0]})
    assert len(program.residuals) == 5
    assert sorted(program.polynomial.products) == [(i, i) for i in range(3, 8)]
