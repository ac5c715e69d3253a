"""Guards coordinates in which programs are easier: they are the same programs, answers and multipliers go both ways."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_array

import sparserob_core as sr
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.change_of_variables import DIRECTIONS, LARGE, change_variables
from sparserob_core.sip.inner.duality import dual_bound, measure
from sparserob_core.sip.inner.solve import solve_finite

SOLVER = sr.load_registry().build("solver", "piqp")
RATE, PIECES = 6.0, 40


def growing(horizon: float, *, fixed: bool = False, near: float = 1e-3) -> FiniteProgram:
    """The least ``int |u|`` that keeps ``x'' = 36 x + u`` within 1 and ends it near 0, or there; ``x(0) = 0.1``."""
    ends = np.linspace(0.0, horizon, PIECES + 1)

    def row(t: float) -> tuple[np.ndarray, np.ndarray]:
        since = np.maximum(t - ends, 0.0)
        place, speed = np.cosh(RATE * since) / RATE**2, np.sinh(RATE * since) / RATE
        return -np.diff(place), -np.diff(speed)

    places = np.array([row(t)[0] for t in ends[1:]])
    free = 0.1 * np.cosh(RATE * ends[1:])
    last, speed = row(horizon)
    final, offset = np.array([last, speed]), np.array([free[-1], 0.1 * RATE * np.sinh(RATE * horizon)])
    G, h = np.vstack([places, -places]), np.concatenate([1.0 - free, 1.0 + free])
    if not fixed:
        G, h = np.vstack([G, final, -final]), np.concatenate([h, near - offset, near + offset])
    A, b = (final, -offset) if fixed else (np.zeros((0, PIECES)), np.zeros(0))
    one = np.full(PIECES, 10.0)
    return FiniteProgram(np.zeros(PIECES), np.full(PIECES, horizon / PIECES), -one, one, G, h, A, b)


@pytest.mark.parametrize("fixed", [False, True])
def test_rows_that_grow_are_divided_into_ordinary_numbers(fixed: bool) -> None:
    program = growing(2.5, fixed=fixed)
    easier = change_variables(program)
    assert easier is not None and easier.divided is not None
    assert np.linalg.norm(program.G, axis=1).max() > 1e4
    assert np.linalg.norm(easier.program.G, axis=1).max() < LARGE
    if fixed:
        assert np.linalg.cond(program.A) > 1e5 and np.linalg.cond(easier.program.A) < 2.0


@pytest.mark.parametrize("fixed", [False, True])
def test_the_divided_program_says_the_same_of_decisions_and_multipliers(fixed: bool) -> None:
    program, rng = growing(2.0, fixed=fixed), np.random.default_rng(0)
    easier = change_variables(program)
    assert easier is not None
    x, y = rng.uniform(-1.0, 1.0, program.n), rng.uniform(0.0, 1.0, program.h.size)
    if fixed:  # along equalities rows are the same where these hold
        x = x - np.linalg.lstsq(program.A, program.A @ x - program.b, rcond=None)[0]
    new = easier.to(x)
    size = np.abs(program.G) @ np.abs(x) + np.abs(program.h)
    assert np.abs((easier.program.G @ new - easier.program.h) - (program.G @ x - program.h)).max() < 1e-13 * size.max()
    lost = np.linalg.cond(program.A) if fixed else 1.0  # by the change to orthonormal rows
    assert np.abs(easier.program.A @ new - easier.program.b).max() < 1e-15 * lost * np.abs(x).max()
    assert easier.back(new) == pytest.approx(x, abs=0)
    mu = rng.uniform(-1.0, 1.0, program.b.size)
    solution = measure(program, x, y, mu)
    there = easier.translate(solution)
    assert easier.equality_prices(there) == pytest.approx(mu, rel=1e-9, abs=1e-9)
    slope = easier.program.q + y @ easier.program.G + there.mu @ easier.program.A
    wanted = program.q + y @ program.G + mu @ program.A
    assert slope[: program.n] == pytest.approx(wanted, abs=1e-12 * np.abs(program.G).max() * y.sum())
    assert np.abs(slope[program.n :]).max(initial=0.0) < 1e-12  # what a free variable asks for


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("horizon", [1.0, 2.0, 2.5, 3.0])
def test_values_agree_with_those_of_states_at_nodes(fixed: bool, horizon: float) -> None:
    """Between nodes nothing grows by much: the same linear program in other variables, by HiGHS."""
    program = growing(horizon, fixed=fixed)
    found = solve_finite(program, SOLVER)
    assert found.status == "optimal"
    assert found.value == pytest.approx(_at_nodes(horizon, fixed), rel=1e-6)
    assert dual_bound(program, found.y, found.mu) <= found.value * (1.0 + 1e-9)


def test_what_is_impossible_is_proven_impossible_in_the_variables_of_the_program() -> None:
    program = growing(2.5)
    weak = FiniteProgram(
        program.q, program.weights, program.lower / 10, program.upper / 10, program.G, program.h, program.A, program.b
    )
    found = solve_finite(weak, SOLVER)
    assert found.status == "infeasible" and found.infeasibility > 0.0


def test_more_equalities_than_entries_are_no_directions() -> None:
    A, b = np.array([[1.0, 0.0], [0.0, 1e-5], [2.0, 1.0]]), np.array([0.5, 2e-5, 3.0])
    five = np.full(2, 5.0)
    program = FiniteProgram(np.array([1.0, 0.0]), np.zeros(2), -five, five, np.zeros((0, 2)), np.zeros(0), A, b)
    assert change_variables(program) is None
    assert solve_finite(program, SOLVER).value == pytest.approx(0.5)


def test_ordinary_rows_are_left_as_they_are() -> None:
    assert change_variables(growing(0.5)) is None


def test_a_variable_with_a_wide_bound_is_no_direction() -> None:
    program = growing(0.5)
    wide = np.append(program.upper, 1e6)
    G = np.hstack([program.G, -np.ones((program.h.size, 1))])
    with_slack = FiniteProgram(
        np.append(program.q, 1.0),
        np.append(program.weights, 0.0),
        -wide,
        wide,
        G,
        program.h,
        np.zeros((0, 41)),
        program.b,
    )
    easier = change_variables(with_slack)
    assert easier is None or easier.divided is None


def test_a_variable_with_large_coefficients_is_no_direction() -> None:
    rng, n = np.random.default_rng(4), 40
    G = rng.standard_normal((20, n))
    G[:, -1] = -1e4 * LARGE
    one = np.ones(n)
    program = FiniteProgram(one, 0.0 * one, -one, one, G, np.ones(20), np.zeros((0, n)), np.zeros(0))
    assert change_variables(program) is None


@pytest.mark.parametrize(("n", "count"), [(60, DIRECTIONS + 12), (8, 3)])
def test_many_directions_are_no_few(n: int, count: int) -> None:
    rng = np.random.default_rng(1)
    G = LARGE * rng.standard_normal((count, n))
    one, h = np.ones(n), np.ones(len(G))
    assert change_variables(FiniteProgram(one, 0.0 * one, -one, one, G, h, np.zeros((0, n)), np.zeros(0))) is None


def test_curvatures_that_differ_by_much_are_made_even() -> None:
    rng, n = np.random.default_rng(2), 6
    axes = np.linalg.qr(rng.standard_normal((n, n)))[0]
    P = (axes * np.logspace(0, -10, n)) @ axes.T
    free, G, h = np.full(n, np.inf), rng.standard_normal((3, n)), np.ones(3)
    program = FiniteProgram(
        rng.standard_normal(n),
        np.zeros(n),
        -free,
        free,
        G,
        h,
        np.zeros((0, n)),
        np.zeros(0),
        P=csc_array((P + P.T) / 2),
    )
    easier = change_variables(program)
    assert easier is not None
    x, z = rng.standard_normal(n), rng.standard_normal(n)
    new = easier.to(x)
    assert easier.back(new) == pytest.approx(x, rel=1e-6)
    assert easier.program.objective(new) == pytest.approx(program.objective(x), rel=1e-9)
    assert easier.program.G @ new == pytest.approx(G @ x, rel=1e-6, abs=1e-6)
    assert easier.dual(z) @ x == pytest.approx(z @ new, rel=1e-6)  # multipliers are of the same numbers
    found = solve_finite(program, SOLVER)
    assert found.status == "optimal" and found.gap <= 1e-8 * abs(found.value)


def _at_nodes(horizon: float, fixed: bool) -> float:
    """The value by HiGHS with the state at the end of every piece as variables (multiple shooting)."""
    from scipy.optimize import linprog

    h = horizon / PIECES
    c, s = np.cosh(RATE * h), np.sinh(RATE * h)
    flow, push = np.array([[c, s / RATE], [RATE * s, c]]), np.array([(c - 1.0) / RATE**2, s / RATE])
    n = 2 * PIECES + 2 * PIECES  # parts of u, then states at nodes 1 to K
    equal, right = np.zeros((2 * PIECES, n)), np.zeros(2 * PIECES)
    for k in range(PIECES):
        rows, after = slice(2 * k, 2 * k + 2), 2 * PIECES + 2 * k
        equal[rows, after : after + 2] = np.eye(2)
        equal[rows, k], equal[rows, PIECES + k] = -push, push
        if k:
            equal[rows, after - 2 : after] = -flow
        else:
            right[rows] = flow @ [0.1, 0.0]
    bounds = [(0.0, 10.0)] * (2 * PIECES) + [(-1.0, 1.0), (None, None)] * PIECES
    end = 0.0 if fixed else 1e-3
    bounds[-2:] = [(-end, end)] * 2
    cost = np.concatenate([np.full(2 * PIECES, h), np.zeros(2 * PIECES)])
    return float(linprog(cost, A_eq=equal, b_eq=right, bounds=bounds, method="highs").fun)
