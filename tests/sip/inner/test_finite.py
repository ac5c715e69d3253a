"""Guards sip/inner: the checks behind every finite program: weak duality, Farkas, standard forms, Newton's method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csc_array, diags_array

import sparserob_core as sr
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.dual_newton import newton_solve, polish
from sparserob_core.sip.inner.duality import dual_bound, farkas_bound
from sparserob_core.sip.inner.solve import elastic_program, interpret_elastic_answer, solve_finite
from sparserob_core.sip.inner.standard_form import standard_form
from sparserob_core.testing.solvers import (
    by_linear_programming,
    double_integrator,
    finite_program,
    infeasible_instances,
    linear_instances,
    one_row,
    regularised,
    robust_terminal,
    to_origin,
)

PIQP = sr.load_registry().build("solver", "piqp")
SEEDS = st.integers(0, 10**6)
LINEAR = {instance.name: instance for instance in linear_instances()}


def random_program(rng: np.random.Generator, image: bool = False) -> FiniteProgram:
    n, r, e = int(rng.integers(1, 9)), int(rng.integers(0, 6)), int(rng.integers(0, 2))
    k = n + 3 if image else n
    S = csc_array(np.vstack([np.eye(n), rng.standard_normal((3, n))])) if image else None
    point = rng.uniform(-0.5, 0.5, n)
    G, A = rng.standard_normal((r, n)), rng.standard_normal((e, n))
    reach = 5.0 if image else 1.0
    return FiniteProgram(
        rng.standard_normal(n) * 0.1,
        rng.random(k),
        np.full(k, -reach),
        np.full(k, reach * rng.uniform(0.5, 1.5)),
        G,
        G @ point + 0.2 * rng.random(r),
        A,
        A @ point,
        None,
        S,
    )


@given(SEEDS, st.booleans())
@settings(max_examples=40, deadline=None)
def test_weak_duality_holds_for_any_multipliers(seed, image):
    rng = np.random.default_rng(seed)
    program = random_program(rng, image)
    value = by_linear_programming("", program).highest
    bent = replace(program, P=csc_array(diags_array(rng.random(program.n))))
    above = bent.objective(solve_finite(program, PIQP).x) + 1e-7
    for size in (1e-3, 1.0, 1e3):
        y, mu, z = (size * rng.standard_normal(m) for m in (program.h.size, program.b.size, program.weights.size))
        assert dual_bound(program, y, mu, z) <= value
        assert dual_bound(bent, y, mu, z, at=rng.standard_normal(program.n)) <= above


@given(SEEDS, st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_checked_optimum_closes_the_gap_between_its_own_bounds(seed, image):
    program = random_program(np.random.default_rng(seed), image)
    instance = by_linear_programming("", program)
    solution = solve_finite(program, PIQP)
    assert solution.status == "optimal"
    assert solution.lower_bound <= instance.highest
    assert instance.lowest <= solution.value <= instance.highest
    assert solution.gap == solution.value - solution.lower_bound
    assert solution.value == program.objective(solution.x)
    assert (solution.y >= 0).all()


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_no_multipliers_prove_a_feasible_program_infeasible(seed):
    rng = np.random.default_rng(seed)
    program = random_program(rng, image=bool(seed % 2))
    for _ in range(5):
        assert not farkas_bound(program, rng.standard_normal(program.h.size), rng.standard_normal(program.b.size)) > 0


def test_the_dual_bound_is_tight_at_optimal_multipliers():
    instance = one_row(1e-2)
    solution = solve_finite(instance.program, PIQP)
    assert dual_bound(instance.program, solution.y, solution.mu) == pytest.approx(instance.highest, abs=2e-9)


def test_multipliers_of_an_unbounded_program_are_scaled_until_they_prove_something():
    program = finite_program(np.ones(3), -np.ones((1, 3)), np.array([-2.0]), bound=np.inf)
    assert dual_bound(program, np.array([7.0]), np.zeros(0)) == pytest.approx(2.0, abs=1e-9)


def test_multipliers_of_free_variables_are_repaired_to_the_last_digit():
    powers = np.linspace(0, 1, 12)[:, None] ** np.arange(3)
    program = replace(
        finite_program(np.zeros(3), -powers, -np.exp(powers[:, 1]), bound=np.inf), q=1 / np.arange(1.0, 4.0)
    )
    solution = solve_finite(program, PIQP)
    disturbed = solution.y * (1 + 1e-9 * np.random.default_rng(0).standard_normal(12))
    assert np.abs(program.q + disturbed @ program.G).max() > 1e-12
    assert dual_bound(program, disturbed, np.zeros(0)) == pytest.approx(solution.value, abs=1e-8)


def test_a_free_variable_that_nothing_holds_has_no_lower_bound():
    program = replace(finite_program(np.zeros(2), np.zeros((0, 2)), np.zeros(0), bound=np.inf), q=np.array([1.0, 0.0]))
    assert dual_bound(program, np.zeros(0), np.zeros(0)) == -np.inf
    assert solve_finite(program, PIQP).status == "failed"


def test_a_non_negative_multiplier_of_a_row_without_right_hand_side_counts_as_none():
    program = robust_terminal()
    loose = replace(program, h=np.where(np.arange(4) == 2, np.inf, program.h))
    assert np.isfinite(dual_bound(loose, np.ones(4), np.zeros(0)))


@pytest.mark.parametrize("name", LINEAR)
def test_both_forms_have_the_value_of_the_program(name):
    program = LINEAR[name].program
    for form in ("split", "epigraph"):
        qp, recover = standard_form(program, form)
        x, y, mu, z = recover(PIQP.solve(qp, 1e-10))
        assert program.objective(x) == pytest.approx(LINEAR[name].highest, abs=1e-6)
        assert dual_bound(program, y, mu, z, at=x) == pytest.approx(LINEAR[name].highest, abs=1e-6)


def test_a_standard_form_has_unit_rows_and_a_unit_cost():
    program = robust_terminal()
    crooked = replace(
        program, G=program.G * np.array([[1e5], [1e-5], [1], [3]]), h=program.h * np.array([1e5, 1e-5, 1, 3])
    )
    for form in ("split", "epigraph"):
        qp, _ = standard_form(crooked, form)
        assert np.sqrt(qp.G.power(2).sum(axis=1)) == pytest.approx(1.0)
        assert np.abs(qp.q).max() == pytest.approx(1.0)


def test_images_without_weight_are_not_split():
    program = replace(robust_terminal(), weights=np.where(np.arange(50) < 20, 0.0, 0.1))
    assert standard_form(program, "split")[0].q.size == 20 + 2 * 30


def test_an_orthogonal_image_changes_nothing_but_the_coordinates():
    program = regularised(robust_terminal(), 1e-2)
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((50, 50)))[0]
    turned = replace(program, S=csc_array(turn), G=program.G @ turn, P=csc_array(turn.T @ (program.P @ turn)))
    plain, rotated = solve_finite(program, PIQP), solve_finite(turned, PIQP)
    assert rotated.value == pytest.approx(plain.value, abs=1e-8)
    assert turn @ rotated.x == pytest.approx(plain.x, abs=1e-3)


def test_the_elastic_value_is_the_relaxation_that_makes_the_program_feasible():
    program = robust_terminal(spread=2.0)
    solution = solve_finite(program, PIQP)
    assert solution.status == "infeasible"
    norms = np.linalg.norm(program.G, axis=1)
    more, less = ((1 + s) * solution.infeasibility * norms for s in (1e-6, -1e-6))
    assert solve_finite(replace(program, h=program.h + more), PIQP).status == "optimal"
    assert solve_finite(replace(program, h=program.h + less), PIQP).status == "infeasible"


def test_what_a_solver_gives_up_is_proven_infeasible_before_it_is_asked_for_more_digits():
    """A program that is infeasible by little keeps an interior-point method busy; a vertex of the elastic program has
    the proof, and nobody asks the solver again."""
    asked = []

    class Lost(sr.Solver):
        def solve(self, program, accuracy):
            asked.append(accuracy)
            return replace(PIQP.solve(program, accuracy), status="failed", message="lost")

    program = regularised(robust_terminal(spread=2.0), 1e-2)
    value = solve_finite(program, PIQP).infeasibility
    solution = solve_finite(program, Lost())
    assert (solution.status, solution.by, len(asked)) == ("infeasible", "highs", 1)
    assert solution.infeasibility == pytest.approx(value, rel=1e-6)


def test_infeasibility_is_proven_by_the_multipliers_that_come_with_it():
    for instance in infeasible_instances():
        solution = solve_finite(instance.program, PIQP)
        assert solution.status == "infeasible"
        if np.isfinite(solution.infeasibility) and (instance.program.lower <= instance.program.upper).all():
            bound = farkas_bound(instance.program, solution.y, solution.mu, solution.z)
            assert bound == pytest.approx(solution.infeasibility, rel=1e-9)


def test_the_elastic_program_of_a_feasible_one_has_the_value_zero():
    program = to_origin(1, 1)
    relaxed = elastic_program(program)
    assert solve_finite(relaxed, PIQP).value == pytest.approx(0.0, abs=1e-9)
    x, y, mu, _ = interpret_elastic_answer(program, (np.zeros(51), np.arange(4.0), np.zeros(0), None))
    assert (x.size, y.size, mu.tolist()) == (50, 0, [-2.0, -2.0])


@pytest.mark.parametrize("epsilon", [1.0, 1e-1, 1e-2, 1e-3])
def test_newton_converges_from_nothing_when_the_curvature_is_ample(epsilon):
    program = regularised(robust_terminal(), epsilon)
    solution = newton_solve(program, np.zeros(4))
    assert solution is not None
    assert solution.residual <= 1e-11
    assert solution.gap <= 1e-11
    assert solution.value == pytest.approx(solve_finite(program, PIQP).value, abs=1e-10)


def test_newton_declines_programs_of_another_structure():
    assert newton_solve(robust_terminal(), np.zeros(4)) is None
    assert newton_solve(regularised(robust_terminal(), 1.0), np.zeros(3)) is None
    assert newton_solve(LINEAR["rotated"].program, np.zeros(4)) is None


def test_polishing_recovers_a_disturbed_solution_of_a_linear_program():
    program, rng = to_origin(1, 1), np.random.default_rng(0)
    solution = solve_finite(program, PIQP)
    rough = polish(
        program,
        solution.x + 1e-4 * rng.standard_normal(50),
        solution.y,
        solution.mu * (1 + 1e-4 * rng.standard_normal(2)),
    )
    assert rough is not None
    assert rough.gap <= 1e-10
    assert rough.value == pytest.approx(solution.value, abs=1e-10)


def test_the_regularised_control_is_the_one_of_least_norm_among_many_optimisers():
    weights, _ = double_integrator()
    middle = np.cumsum(weights) - weights / 2
    least = np.clip((middle - (2 - np.sqrt(3))) / (2 * np.sqrt(3)), 0, 1)
    for epsilon in (1.0, 1e-2, 1e-4):
        assert solve_finite(regularised(to_origin(10, -3), epsilon), PIQP).x == pytest.approx(least, abs=1e-3)


def test_a_guess_saves_the_solver():
    class Idle(sr.Solver):
        def solve(self, program, accuracy):
            raise AssertionError("a solver was asked")

    program = regularised(robust_terminal(), 1e-2)
    guess = solve_finite(program, PIQP)
    nearby = replace(program, h=program.h + 1e-3)
    assert solve_finite(nearby, Idle(), guess=guess).value == pytest.approx(solve_finite(nearby, PIQP).value, abs=1e-10)


def test_a_guess_of_another_program_does_no_harm():
    guess = solve_finite(regularised(to_origin(1, 1), 1e-2), PIQP)
    for program in (robust_terminal(), regularised(robust_terminal(), 1e-2), LINEAR["rotated"].program):
        assert solve_finite(program, PIQP, guess=guess).value == pytest.approx(
            solve_finite(program, PIQP).value, abs=1e-8
        )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"h": np.zeros(3)}, "G has shape"),
        ({"weights": -np.ones(50)}, "weights >= 0"),
        ({"q": np.full(50, np.nan)}, "q has an entry"),
        ({"upper": np.full(50, np.nan)}, "NaN"),
        ({"h": np.full(4, -np.inf)}, "above -inf"),
    ],
)
def test_a_program_at_fault_is_refused_by_the_name_of_what_is_wrong(change, words):
    with pytest.raises(sr.InputError, match=words):
        solve_finite(replace(robust_terminal(), **change), PIQP)


@given(SEEDS, st.booleans())
@settings(max_examples=15, deadline=None)
def test_a_program_under_more_rows_is_the_one_that_is_written_down_with_them(seed, bent):
    rng = np.random.default_rng(seed)
    base = random_program(rng)
    if bent:
        base = base.curved(diags_array(rng.uniform(0.1, 1.0, base.n)).tocsc(), base.q)
    more, allowed = rng.standard_normal((2, base.n)), rng.random(2)
    under = base.under(more, allowed)
    whole = replace(base, G=np.vstack([base.G, more]), h=np.append(base.h, allowed))
    found, expected = solve_finite(under, PIQP), solve_finite(whole, PIQP)
    assert (found.status, found.value, found.lower_bound) == (expected.status, expected.value, expected.lower_bound)
    assert np.array_equal(found.x, expected.x)
    for rows, right, words in (
        (more, [0.0, np.nan], "NaN"),
        (more, [0.0, -np.inf], "above"),
        (np.inf * more, allowed, "G"),
    ):
        with pytest.raises(sr.InputError, match=words):
            solve_finite(base.under(rows, np.array(right)), PIQP)


def test_no_program_is_both_optimal_and_infeasible_at_the_edge():
    rows = np.vstack([np.ones(50), -np.ones(50)])
    for shift in (1e-3, 1e-6, 1e-8, 1e-9, 1e-10, 1e-12, 0.0):
        program = finite_program(np.full(50, 0.1), rows, np.array([1.0, -1.0 - shift]))
        status = solve_finite(program, PIQP).status
        assert status in (
            {"infeasible"} if shift >= 1e-7 else {"infeasible", "optimal", "failed"} if shift > 0 else {"optimal"}
        )


def two_prices(cheap: float) -> FiniteProgram:
    """Two channels of 10 variables each push one sum; those of the first cost ``cheap``, those of the other 1."""
    weights = np.repeat([cheap, 1.0], 10)
    row = -np.concatenate([np.linspace(1.0, 0.5, 10), np.full(10, 1e-3)])[None]
    box = np.ones(20)
    return FiniteProgram(np.zeros(20), weights, -box, box, row, np.array([-3.25]), np.zeros((0, 20)), np.zeros(0))


@pytest.mark.parametrize("cheap", [1e-5, 1e-7, 1e-9])
def test_a_cheap_variable_is_chosen_as_exactly_as_if_nothing_else_had_a_price(cheap):
    program = two_prices(cheap)
    solution = solve_finite(program, PIQP, small=cheap)
    best = 3.5 * cheap  # the most effective first: 1 + 17/18 + 16/18 + 0.5 * 15/18 = 3.25
    assert solution.status == "optimal" and solution.value == pytest.approx(best, rel=1e-8)
    assert solution.gap <= 1e-8 * cheap


def seen_late(seed: int, apart: float) -> FiniteProgram:
    """Rows as an unstable system has them at its end: combinations of two, but for the share ``apart``; all but the
    last, which is opposite to the first, nearly tight at one point."""
    rng = np.random.default_rng(seed)
    n, count = 21, 5
    G = rng.standard_normal((count, 2)) @ rng.standard_normal((2, n)) + apart * rng.standard_normal((count, n))
    G /= np.linalg.norm(G, axis=1)[:, None]
    h = G @ (rng.uniform(-1, 1, n) * (rng.random(n) < 0.4)) - 0.01 * apart * rng.random(count)
    box = np.ones(n)
    G, h = np.vstack([G, -G[:1]]), np.append(h, 1.0 - h[0])
    return FiniteProgram(np.zeros(n), box, -box, box, G, h, np.zeros((0, n)), np.zeros(0))


@pytest.mark.parametrize(("seed", "apart"), [(1, 1e-6), (2, 1e-6), (8, 1e-7)])
def test_rows_that_are_nearly_parallel_are_met_exactly(seed, apart):
    program = seen_late(seed, apart)
    solution = solve_finite(program, PIQP)
    assert solution.status == "optimal" and (program.G @ solution.x <= program.h + 1e-14).all()
