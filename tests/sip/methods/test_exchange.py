"""Guards sip/methods/exchange: the exchange method: its bounds enclose the truth, it ends, and it claims only what was
proven."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

import sparserob_core as sr

STATUSES = {"certified", "verified", "undecided"}


@pytest.fixture(scope="module")
def options():
    from sparserob_direct import Direct
    from sparserob_piqp import Piqp

    return {"solver": Piqp(), "maximiser": Direct(), "budget": 200, "tolerance": 1e-7, "seed": 0}


def random_program(rng, n=6, families=2, equality=False, q=True):
    """Smooth rows on [0, 2], satisfied strictly by a known decision."""
    inside = rng.uniform(-0.5, 0.5, n)
    data = rng.uniform(0, 5, (families, 2, n))

    def rows(which):
        def of(t):
            G = np.cos(t * data[which, 0] + data[which, 1])[:, None, :]
            return G, G @ inside + 0.1 + 0.3 * np.sin(3 * t + which) ** 2

        return of

    made = [sr.ConstraintFamily(name=f"f{i}", index_set=sr.Box([0.0], [2.0]), rows=rows(i)) for i in range(families)]
    A = rng.normal(size=(2, n)) if equality else None
    return sr.SemiInfiniteProgram(
        n=n,
        q=rng.normal(size=n) if q else None,
        weights=rng.uniform(0.1, 1, n),
        lower=-1.0,
        upper=1.0,
        families=made,
        A=A,
        b=None if A is None else A @ inside,
    )


def gridded(program, count=2001, slack=0.0):
    """The program imposed on a fine grid of every family only: a lower bound of its value (``slack`` 0), by HiGHS."""
    n, base = program.n, program.finite
    rows, rhs = [np.zeros((0, n))], [np.zeros(0)]
    for family in program.families:
        box = family.index_set
        grid = np.linspace(box.lower, box.upper, count if (box.upper > box.lower).any() else 1)
        G, h = family.rows(grid)
        rows.append(G.reshape(-1, n))
        rhs.append(h.ravel() - slack)
    G, h, identity = np.concatenate(rows), np.concatenate(rhs), np.eye(n)
    table = np.vstack(
        [np.hstack([G, np.zeros_like(G)]), np.hstack([identity, -identity]), np.hstack([-identity, -identity])]
    )
    equal = np.hstack([base.A, np.zeros_like(base.A)]) if base.b.size else None
    answer = linprog(
        np.concatenate([base.q, base.weights]),
        table,
        np.concatenate([h, np.zeros(2 * n)]),
        equal,
        base.b if base.b.size else None,
        bounds=[*zip(base.lower, base.upper, strict=True), *[(0, None)] * n],
        method="highs",
    )
    return answer.fun if answer.status == 0 else np.inf


def assert_sound(result, program, truth, slack=1e-5):
    """``truth`` is a value on a grid: at most ``slack`` below the value of the program."""
    lowers = [event.lower_bound for event in result.history]
    assert (np.diff(lowers) >= 0).all()
    assert result.lower_bound <= truth + slack
    assert result.cost >= truth - 1e-6
    assert abs(result.cost - program.cost(result.decision)) <= 1e-12
    assert program.finite.residual(result.decision) <= 1e-8


def assert_enclosed(options, seed, equality):
    program = random_program(np.random.default_rng(seed), equality=equality)
    result = sr.solve(program, **options)
    assert result.status in STATUSES, result.message
    assert_sound(result, program, gridded(program))
    assert result.cost - result.lower_bound <= 1e-6 * max(1.0, abs(result.cost))


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 10**6), equality=st.booleans())
def test_the_bounds_enclose_the_value_of_random_programs(options, seed, equality):
    assert_enclosed(options, seed, equality)


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10**6), equality=st.booleans())
def test_the_bounds_enclose_the_value_of_more_random_programs(options, seed, equality):
    assert_enclosed(options, seed, equality)


def assert_the_same_in_another_order(options, seed, families):
    program = random_program(np.random.default_rng(seed), families=families)
    base = program.finite
    other = sr.SemiInfiniteProgram(
        n=program.n, q=base.q, weights=base.weights, lower=-1.0, upper=1.0, families=program.families[::-1]
    )
    first, second = sr.solve(program, **options), sr.solve(other, **options)
    assert first.status == second.status
    assert abs(first.cost - second.cost) <= 2e-7 * max(1.0, abs(first.cost))


@settings(max_examples=1, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_order_of_the_families_changes_nothing(options, seed):
    assert_the_same_in_another_order(options, seed, families=2)


@pytest.mark.slow
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_order_of_three_families_changes_nothing(options, seed):
    assert_the_same_in_another_order(options, seed, families=3)


def test_a_family_given_twice_changes_nothing(options):
    program = random_program(np.random.default_rng(3))
    base = program.finite
    twins = [
        sr.ConstraintFamily(name=f"{family.name} again", index_set=family.index_set, rows=family.rows)
        for family in program.families
    ]
    other = sr.SemiInfiniteProgram(
        n=program.n, q=base.q, weights=base.weights, lower=-1.0, upper=1.0, families=[*program.families, *twins]
    )
    first, second = sr.solve(program, **options), sr.solve(other, **options)
    assert second.status in STATUSES
    assert abs(first.cost - second.cost) <= 2e-7 * max(1.0, abs(first.cost))


def test_a_family_that_is_never_active_adds_no_index(options):
    program = random_program(np.random.default_rng(4))
    base = program.finite
    idle = sr.ConstraintFamily(
        name="idle",
        index_set=sr.Box([0.0], [1.0]),
        rows=lambda t: (np.ones((t.shape[0], 1, 6)), np.full((t.shape[0], 1), 100.0)),
    )
    other = sr.SemiInfiniteProgram(
        n=program.n, q=base.q, weights=base.weights, lower=-1.0, upper=1.0, families=[*program.families, idle]
    )
    first, second = sr.solve(program, **options), sr.solve(other, **options)
    assert abs(first.cost - second.cost) <= 2e-7 * max(1.0, abs(first.cost))
    assert all(cut.family != "idle" for cut in second.indices)


@pytest.mark.parametrize("equality", [False, True])
def test_without_families_the_finite_program_is_solved_and_certified(options, equality):
    program = random_program(np.random.default_rng(5), families=0, equality=equality)
    result = sr.solve(program, **options)
    assert result.status == "certified", result.message
    assert abs(result.cost - gridded(program)) <= 1e-6
    assert result.gap <= 1e-7


def test_without_a_regulariser_the_same_value_is_found(options):
    program = random_program(np.random.default_rng(6))
    with_one, without = sr.solve(program, **options), sr.solve(program, regulariser=None, **options)
    assert without.epsilon == 0.0
    assert abs(with_one.cost - without.cost) <= 2e-7 * max(1.0, abs(without.cost))


def shifted(program, amount):
    """The same program with every right-hand side lowered."""

    def lowered(family):
        def of(t):
            G, h = family.rows(t)
            return G, h - amount

        return sr.ConstraintFamily(name=family.name, index_set=family.index_set, rows=of)

    base = program.finite
    return sr.SemiInfiniteProgram(
        n=program.n,
        q=base.q,
        weights=base.weights,
        lower=-1.0,
        upper=1.0,
        families=[lowered(f) for f in program.families],
    )


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_an_infeasible_program_comes_back_infeasible_with_a_reason(options, seed):
    program = shifted(random_program(np.random.default_rng(seed)), 20.0)
    result = sr.solve(program, **options)
    assert gridded(program) == np.inf
    assert result.status == "infeasible"
    assert result.lower_bound == np.inf
    assert result.decision is None
    assert result.message


def assert_told_apart(options, seed, amount):
    program = shifted(random_program(np.random.default_rng(seed), n=3), amount)
    result = sr.solve(program, **options)
    if gridded(program) == np.inf:
        assert result.status == "infeasible"
    elif np.isfinite(gridded(program, slack=-1e-4)) and np.isfinite(gridded(program, slack=1e-4)):
        assert result.status in STATUSES
        assert_sound(result, program, gridded(program), 1e-4)


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10**6), amount=st.floats(0.0, 1.5))
def test_feasible_and_infeasible_programs_are_told_apart(options, seed, amount):
    assert_told_apart(options, seed, amount)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), amount=st.floats(0.0, 1.5))
def test_more_feasible_and_infeasible_programs_are_told_apart(options, seed, amount):
    assert_told_apart(options, seed, amount)


# Optimal control problems, where separation and proof are the package's own.

INTEGRATOR = {"A": [[0.0]], "B": [[1.0]]}


def control_problem(system, horizon, start, **sets):
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(**system), horizon=horizon, initial_state=start, control=sr.Box([-1.0], [1.0]), **sets
    )


def pieces(count):
    return {"name": "piecewise_constant", "pieces": count}


def solved(problem, count, options, **more):
    return sr.solve(
        problem, control=pieces(count), **{key: options[key] for key in ("solver", "tolerance", "seed")}, **more
    )


def test_a_corridor_of_an_integrator_is_certified_although_its_path_has_kinks(options):
    """From 0 up to at least 1 and back to 0.2, never above 1.2: the cheapest control is known."""
    problem = control_problem(
        INTEGRATOR,
        4.0,
        [0.0],
        path=[sr.PathConstraint(sr.Box([-0.1], [1.2])), sr.PathConstraint(sr.Box([1.0], [np.inf]), 1.9, 2.1)],
        terminal=[sr.Box([0.0], [0.2])],
    )
    for count in (7, 20):
        result = solved(problem, count, options)
        assert result.status == "certified", result.message
        assert abs(result.cost - 1.8) <= 1e-6
        assert result.counts["rounds"] <= 20


@pytest.mark.first(3)
@pytest.mark.parametrize(("start", "sigma"), [([1.0], 0.0), ([1.0], 0.3), ([-1.0], 0.3)])
@pytest.mark.parametrize("count", [5, 40])
def test_an_initial_state_on_the_boundary_of_its_path_set_ends_with_an_answer(options, start, sigma, count):
    """No Slater point: the constraint at t = 0 holds with equality, whatever the control."""
    problem = control_problem(
        INTEGRATOR,
        1.0,
        start,
        path=[sr.Box([-1.0], [1.0])],
        terminal=[sr.Box([-0.5], [0.5])],
        disturbance=sr.Box([-sigma], [sigma]) if sigma else None,
    )
    result = solved(problem, count, options)
    assert result.status in STATUSES, result.message
    assert result.message
    assert abs(result.cost - (0.5 + sigma)) <= 1e-5
    assert result.lower_bound <= 0.5 + sigma + 1e-9
    assert result.counts["rounds"] <= 60


def test_an_oscillator_that_starts_on_the_boundary_and_must_be_held_inside(options):
    """``x'' = -x + u`` from rest at the bound: free motion goes inside; from the velocity 0 at -1 too."""
    problem = control_problem(
        {"A": [[0, 1], [-1, 0]], "B": [[0.0], [1.0]]},
        3.0,
        [1.0, 0.0],
        path=[sr.Box([-1.0, -np.inf], [1.0, np.inf])],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )
    result = solved(problem, 30, options)
    assert result.status in STATUSES, result.message


@pytest.mark.parametrize(
    ("start", "status"), [(1.0 + 1e-6, "infeasible"), (1.0 - 1e-6, "certified"), (1.5, "infeasible")]
)
def test_an_initial_state_just_outside_is_infeasible_and_just_inside_is_not(options, start, status):
    problem = control_problem(INTEGRATOR, 1.0, [start], path=[sr.Box([-1.0], [1.0])], terminal=[sr.Box([-0.5], [0.5])])
    result = solved(problem, 10, options)
    assert result.status == status, result.message
    if status == "infeasible":
        assert "x1(0)" in result.message


def test_a_start_that_must_leave_at_once_is_infeasible(options):
    """At the bound with an outward velocity: no constraint is violated at t = 0, every one just after is."""
    problem = control_problem(
        {"A": [[0, 1], [0, 0]], "B": [[0.0], [1.0]]}, 1.0, [1.0, 0.1], path=[sr.Box([-1.0, -1.0], [1.0, 1.0])]
    )
    result = solved(problem, 10, options)
    assert result.status in {"infeasible", "failed"}, result.message
    assert result.status == "infeasible"


@pytest.mark.first(1)
@pytest.mark.parametrize("width", [1e-3, 1e-6, 1e-8])
def test_a_thin_terminal_set_is_reached_and_certified(options, width):
    """An almost-equality: the margin of the rows must shrink with the set."""
    problem = control_problem(
        {"A": [[0, 1], [0, 0]], "B": [[0.0], [1.0]]},
        5.0,
        [1.0, 1.0],
        terminal=[sr.Box([-width, -width], [width, width])],
    )
    result = solved(problem, 50, options)
    truth = sr.solve(
        control_problem(
            {"A": [[0, 1], [0, 0]], "B": [[0.0], [1.0]]}, 5.0, [1.0, 1.0], terminal=[sr.Equality([0.0, 0.0])]
        ),
        control=pieces(50),
        solver=options["solver"],
    )
    assert result.status in STATUSES, result.message
    assert result.status == "certified", f"{result.message} (gap {result.gap:.1e})"
    assert abs(result.cost - truth.cost) <= 3 * width + 1e-6


def test_a_terminal_point_without_interior_ends_with_an_answer(options):
    """A box of width zero instead of an equality: no Slater point at all."""
    problem = control_problem(INTEGRATOR, 1.0, [0.5], terminal=[sr.Box([0.0], [0.0])])
    result = solved(problem, 10, options)
    assert result.status in STATUSES, result.message
    assert abs(result.cost - 0.5) <= 1e-6


def test_a_run_of_one_round_claims_nothing_of_an_earlier_decision(options):
    problem = control_problem(
        {"A": [[0, 1], [-4, 0]], "B": [[0.0], [1.0]]},
        5.0,
        [1.0, 0.0],
        path=[sr.PathConstraint(sr.Box([-0.9, -9], [0.7, 9]), 2.0)],
        terminal=[sr.Box([-0.2, -0.2], [0.2, 0.2])],
    )
    for rounds in (1, 2, 3):
        result = solved(problem, 25, options, method={"name": "exchange", "rounds": rounds})
        assert result.counts["rounds"] == len(result.history) <= rounds
        if result.status == "refuted":
            program = sr.transcribe(problem, _dictionary(25, 5.0))
            worst = program.family(result.worst.constraint).violations(result.decision, result.worst.index[None])[
                0, result.worst.row
            ]
            assert abs(worst - result.worst.violation) <= 1e-9


def _dictionary(count, horizon):
    return sr.Dictionary(np.linspace(0, horizon, count + 1), np.eye(count))


def test_a_parameter_that_cannot_be_enclosed_ends_undecided(options):
    system = {
        "A": lambda p: np.array([[-1.0 if p[0] > 0.5 else -1.5]]),
        "B": [[1.0]],
        "parameters": sr.Box([0.0], [1.0]),
    }
    problem = control_problem(system, 1.0, [2.0], terminal=[sr.Box([-0.6], [0.6])])
    result = solved(problem, 10, options)
    assert result.status == "undecided", result.message
    assert "branch" in result.message


@pytest.mark.first(1)
@pytest.mark.parametrize("weight", [2.0, 4.0])
def test_the_regularised_problem_is_solved_where_the_exact_one_is_not_asked_for(options, weight):
    """``|x1| + 2 |x2| + weight/2 |x|^2`` with ``x1 + x2 >= t`` on [0, 1]: equal slopes ``1 + weight x1`` and
    ``2 + weight x2``."""
    above = sr.ConstraintFamily(
        name="above", index_set=sr.Box([0.0], [1.0]), rows=lambda t: (-np.ones((len(t), 1, 2)), -t)
    )
    program = sr.SemiInfiniteProgram(n=2, weights=[1.0, 2.0], lower=-3.0, upper=3.0, families=[above])
    fixed = {"continuation": {"start": weight, "stop": weight}, "regulariser": "ridge", "solver": options["solver"]}
    result = sr.solve(program, method={"name": "exchange", "exact": False}, **fixed)
    x = np.array([(1 + 1 / weight) / 2, (1 - 1 / weight) / 2])
    assert result.decision == pytest.approx(x, abs=1e-5)
    assert result.epsilon == weight
    assert result.cost == pytest.approx(x @ [1, 2], abs=1e-5)
    assert result.value == pytest.approx(x @ [1, 2] + weight / 2 * x @ x, abs=1e-5)
    assert result.lower_bound == pytest.approx(1.0, abs=1e-6), "of the unregularised problem"
    exact = sr.solve(program, method="exchange", **fixed)
    assert exact.cost == pytest.approx(1.0, abs=1e-6)


def test_a_regularised_problem_without_a_regulariser_is_refused(options):
    program = sr.SemiInfiniteProgram(n=1, weights=1.0, lower=-3.0, upper=3.0)
    with pytest.raises(sr.InputError, match="exact: expected true"):
        sr.solve(program, method={"name": "exchange", "exact": False}, solver=options["solver"])


@pytest.mark.parametrize("continuation", [{"start": 1e-8, "stop": 1.0}, {"stop": 2.0}])
def test_a_continuation_that_would_rise_is_refused(continuation):
    with pytest.raises(sr.InputError, match="stop: expected at most start"):
        sr.solve(sr.SemiInfiniteProgram(n=1, lower=0.0, upper=1.0), continuation=continuation)
