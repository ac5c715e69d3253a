"""Guards checker/program/bound: lower bounds by weak duality, against values that are known otherwise, and refusals of
multipliers that prove less."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb, ctx

from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.program import bound
from sparserob_core.checker.program.bound import Lagrangian, row_of_term
from sparserob_core.sip.stated.statement import StatedProgram
from tests.support.stated import certify, judge, state

UP = (None, 0.0)  # a single entry that is not negative


def bound_of(
    program: StatedProgram, multipliers: list[float], tangent: list[float] | None = None, is_priced: bool = True
) -> arb:
    """Return the bound that multipliers prove, of the rows without an index and of the definitions of residuals."""
    n = program.decisions.n
    terms = [*program.finite_terms, *((term, True) for term in program.definitions)]
    rows = [row_of_term(term, y, n, equal) for (term, equal), y in zip(terms, multipliers, strict=True)]
    point = None if tangent is None else np.array(tangent)
    with ctx.workprec(96):
        return Lagrangian(program, rows, point, is_priced).bound()


def assert_bound(found: arb, value: float) -> None:
    """Compare a bound with the least value that the multipliers prove."""
    assert found.is_finite() and abs(float(found.mid()) - value) <= 1e-12 * (1.0 + abs(value))
    assert float(found.rad()) <= 1e-12 * (1.0 + abs(value))


def test_a_slope_that_a_correction_turns_is_looked_at_again() -> None:
    """``x + y / 2`` falls for ever along ``(-1, 1)``: the multiplier that gives ``x`` a slope of 0 gives ``y`` one
    below 0, and ``y`` has no upper bound."""
    program = state({"x": None, "y": UP}, "x + 0.5*y", finite=["x + y >= 1"])
    with pytest.raises(Unchecked, match="without a slope that is 0"):
        bound_of(program, [0.4])


def test_no_multipliers_prove_that_nothing_is_feasible_where_something_is() -> None:
    """``x + y >= 1``, ``x <= y - 1`` and ``2 x + y <= 1`` hold at ``(0, 1)``."""
    rng = np.random.default_rng(1)
    program = state({"x": None, "y": UP}, "x", finite=["x + y >= 1", "x - y <= -1", "2*x + y <= 1"])
    answers = 0
    for _ in range(60):
        try:
            found = bound_of(program, list(rng.uniform(0, 1, 3) * rng.integers(0, 2, 3)), is_priced=False)
        except Unchecked:
            continue
        answers += 1
        assert not found > 0
    assert answers >= 10


def test_an_entry_at_its_bound_takes_the_slope_that_is_left() -> None:
    """``min x + 2 y, x + y >= 1, y >= 0`` is 1; the multiplier 1 leaves ``y`` a slope of 1."""
    program = state({"x": None, "y": UP}, "x + 2*y", finite=["x + y >= 1"])
    for guess in (1.0, 1.0 + 1e-9, 1.0 - 1e-9, 1.5):
        assert_bound(bound_of(program, [guess]), 1.0)


def test_an_entry_without_bounds_needs_a_multiplier_that_can_be_moved() -> None:
    program = state({"x": None, "y": None}, "x", finite=["x + y >= 1", "y <= 5"])
    assert_bound(bound_of(program, [1.0, 1.0]), -4.0)
    with pytest.raises(Unchecked):
        bound_of(program, [1.0, 0.0])
    with pytest.raises(Unchecked, match="would be negative"):
        bound_of(state({"x": None}, "x", finite=["x <= 1"]), [1.0])


def test_bounded_entries_take_their_least_value() -> None:
    program = state({"x": (None, -2.0, 3.0), "y": (None, 1.0, 4.0)}, "2*x - 3*y + 7")
    assert_bound(bound_of(program, []), -4.0 - 12.0 + 7.0)


@pytest.mark.parametrize(("lower", "upper"), [(-1.0, 2.0), (0.5, 2.0), (-3.0, -0.25), (-0.5, 0.5)])
@pytest.mark.parametrize("slope", [-3.0, -0.7, 0.0, 0.4, 2.5])
@pytest.mark.parametrize("terms", ["0.75*abs(x)", "1.5*x**2", "0.3*x**2 + 0.4*abs(x)"])
def test_the_least_value_of_one_entry_is_that_of_a_dense_grid(
    lower: float, upper: float, slope: float, terms: str
) -> None:
    program = state({"x": (None, lower, upper)}, f"{slope}*x + {terms}")
    grid = np.union1d(np.linspace(lower, upper, 20001), [0.0] if lower <= 0.0 <= upper else [])
    values = slope * grid + eval(terms, {"x": grid, "abs": np.abs})
    found = bound_of(program, [])
    assert float(found.mid()) - float(found.rad()) <= values.min() + 1e-12  # never above
    assert float(found.mid()) >= values.min() - 1e-7 * (1.0 + abs(values.min()))  # nor far below


@pytest.mark.parametrize("slope", [-3.0, 0.0, 0.9, 1.1])
def test_an_absolute_value_without_bounds_has_the_least_value_0_or_none(slope: float) -> None:
    program = state({"x": None}, f"{slope}*x + abs(x)")
    if abs(slope) <= 1.0:
        assert_bound(bound_of(program, []), 0.0)
    else:
        with pytest.raises(Unchecked):
            bound_of(program, [])


def test_a_weight_that_is_no_double_is_not_exceeded_by_a_slope() -> None:
    """``0.1 |0.3 x|`` has a weight of 106 bits; the slope may be it at most, to the last bit."""
    program = state({"x": None}, "0.1*abs(0.3*x)", finite=["x >= 1"])
    with ctx.workprec(400):
        weight = arb(0.1) * arb(0.3)
    found = bound_of(program, [1.0])
    with ctx.workprec(400):
        assert found.lower() <= weight and found.lower() >= weight * 0.9999999


def test_squares_have_their_least_value_in_closed_form() -> None:
    """``min x^2 + 2 y^2, x + y >= 3`` is 6, with the multiplier 4."""
    program = state({"x": None, "y": None}, "x**2 + 2*y**2", finite=["x + y >= 3"])
    assert_bound(bound_of(program, [4.0]), 6.0)
    assert_bound(bound_of(program, [3.0]), 3.0 * 3.0 - 9.0 / 4.0 - 9.0 / 8.0)


def test_residuals_have_multipliers_of_their_own() -> None:
    """``min (x - 3)^2 + |x - 1|`` is 1.75 at 2.5; the residuals are free, and so are their multipliers."""
    program = state({"x": None}, "(x - 3)**2 + abs(x - 1)")
    assert len(program.definitions) == 2
    assert_bound(bound_of(program, [-1.0, 1.0]), 1.75)
    assert_bound(bound_of(program, [0.0, 0.0]), 0.0)


def test_products_are_replaced_by_their_tangent() -> None:
    """``min x^2 + x y + y^2, x + y >= 2`` is 3 at ``(1, 1)``, with the multiplier 3."""
    program = state({"x": None, "y": None}, "x*x + x*y + y*y", finite=["x + y >= 2"])
    assert_bound(bound_of(program, [3.0], [1.0, 1.0]), 3.0)
    for point in ([1.0 + 1e-6, 1.0], [0.9, 1.2], [2.0, 0.5]):  # another tangent proves less, and never more
        assert bound_of(program, [3.0], point).lower() <= 3.0


def test_an_objective_that_is_not_convex_proves_nothing() -> None:
    for objective in ("-x**2", "x*y", "x**2 + 3*x*y + y**2", "-abs(x)"):
        program = state({"x": (None, -1.0, 1.0), "y": (None, -1.0, 1.0)}, objective)
        with pytest.raises((Broken, Unchecked), match="convex"):
            bound_of(program, [])


def test_equalities_have_multipliers_of_both_signs() -> None:
    """``min x, x + y == 1, y <= 4`` is -3."""
    program = state({"x": None, "y": (None, -np.inf, 4.0)}, "x", finite=["x + y == 1"])
    assert_bound(bound_of(program, [-1.0]), -3.0)
    assert_bound(bound_of(program, [-1.0 + 1e-9]), -3.0)


def test_what_cannot_hold_together_is_violated_by_a_weighted_sum() -> None:
    program = state({"x": None}, "x", finite=["x >= 2", "x <= 1"])
    assert_bound(bound_of(program, [1.0, 1.0], is_priced=False), 1.0)
    feasible = state({"x": None}, "x", finite=["x >= 1", "x <= 2"])
    assert float(bound_of(feasible, [1.0, 1.0], is_priced=False).mid()) == -1.0


def test_no_multipliers_of_random_programs_prove_more_than_a_feasible_decision_costs() -> None:
    """Of programs with squares, absolute values, bounds and rows."""
    rng = np.random.default_rng(0)
    answers = 0
    for _ in range(50):
        kinds = [None, UP, (None, -1.0, 2.0), (None, -1.0, 2.0)]
        decision, point = {name: kinds[rng.integers(4)] for name in "xyz"}, rng.uniform(0.0, 1.0, 3)
        rows = [(row.tolist(), float(row @ point + rng.uniform(0, 1))) for row in rng.integers(-2, 3, (4, 3))]
        weights = rng.integers([[-2] * 3, [0] * 3, [0] * 3], [[3] * 3, [2] * 3, [2] * 3]).T.tolist()
        costs = [f"{c}*{v} + {a}*{v}**2 + {w}*abs({v})" for v, (c, a, w) in zip("xyz", weights, strict=True)]
        finite = [f"{a}*x + {b}*y + {c}*z <= {right}" for (a, b, c), right in rows]
        program = state(decision, " + ".join(costs), finite=finite)
        value = eval(" + ".join(costs), dict(zip("xyz", point.tolist(), strict=True)))
        for scale in (0.1, 1.0):
            try:
                found = bound_of(program, list(np.abs(rng.normal(size=4)) * scale * rng.integers(0, 2, 4)))
            except Unchecked:
                continue
            answers += found.is_finite()
            assert not found.is_finite() or found.lower() <= value + 1e-12
    assert answers >= 8


SEMIDEFINITE = {  # with a line along which the sum is 0, so that balls decide nothing
    "(x + y)*(x + y + 2)": True,
    "(x - 3*y)*(2*x - 6*y)": True,
    "x*x - 2*x*y + y*y": True,
    "x*x - 2*x*y + y*y - 1e-300*y*y": False,
    "x*x - 2.0000000000000004*x*y + y*y": False,
    "x*y": False,
}


@pytest.mark.parametrize("text", SEMIDEFINITE)
def test_sums_of_products_that_vanish_along_a_line_are_judged_in_fractions(text: str) -> None:
    program = state({"x": None, "y": None}, text, "x + y >= t")
    lagrangian = Lagrangian(program, [], None, is_priced=True)
    if SEMIDEFINITE[text]:
        lagrangian.require_convex()
    else:
        with pytest.raises(Broken, match="not convex"):
            lagrangian.require_convex()


def test_large_sums_that_may_vanish_are_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    lagrangian = Lagrangian(state({"x": None, "y": None}, "x*x - 2*x*y + y*y", "x >= t"), [], None, is_priced=True)
    monkeypatch.setattr(bound, "MAX_EXACT", 1)
    with pytest.raises(Unchecked, match="more than 1 entries"):
        lagrangian.require_convex()


def test_corrections_after_corrections_lose_no_digits() -> None:
    """Least absolute deviations of a rising polynomial: at the optimum many residuals have a slope that is exactly
    their weight. A correction moves another one beyond it by rounding, and so on."""
    program = state(
        {"a": 6},
        "sum(abs(sum(a[k]*t[i]^k for k in range(6)) - y[i]) for i in range(11))",
        "sum(k*a[k]*x^(k - 1) for k in range(1, 6)) >= 0",
        index={"x": (0.0, 1.0)},
        tables={
            "t": [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1],
            "y": [0.02, 0.25, 0.21, 0.18, 0.24, 0.21, 0.46, 0.83, 0.79, 0.75, 0.93],
        },
    )
    findings = judge(program, certify(program))
    assert [found.name for found in findings.values() if found.verdict != "holds"] == []
