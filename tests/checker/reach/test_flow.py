"""Guards checker/reach/flow: growth, remainders and expansions in time are bounds of what they are said to bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from scipy.linalg import expm

from sparserob_core.checker.arithmetic.jets import Monomials
from sparserob_core.checker.arithmetic.series import Series
from sparserob_core.checker.reach.flow import (
    ORDER,
    Flow,
    OwnUnits,
    Remainder,
    balanced,
    beyond,
    column,
    flows,
    held,
    in_time,
    logarithmic_norm,
    middles,
    scaled,
    stacked,
    up_to,
)
from sparserob_core.control.problem.expression import parse_matrix
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box


def matrix(values):
    return arb_mat([[arb(float(v)) for v in row] for row in np.atleast_2d(values)])


def test_a_logarithmic_norm_is_above_the_growth_of_every_matrix_and_that_of_a_diagonal_one():
    rng = np.random.default_rng(0)
    for d in (1, 2, 3, 5):
        for _ in range(10):
            A = rng.normal(size=(d, d)) * 10.0 ** rng.uniform(-1, 1, size=(d, 1))
            mu = float(logarithmic_norm(matrix(A)).upper())
            symmetric = (A + A.T) / 2
            assert mu >= np.linalg.eigvalsh(symmetric)[-1] - 1e-12
            discs = np.diag(A) + np.abs(symmetric).sum(axis=1) - np.abs(np.diag(A))
            assert mu == pytest.approx(discs.max())
            for time in (0.1, 1.0):
                assert np.linalg.norm(expm(A * time), 2) <= np.exp(mu * time) * (1 + 1e-12)
    assert float(logarithmic_norm(matrix(np.diag([-3.0, 2.0, -1.0]))).mid()) == 2.0
    assert float(logarithmic_norm(matrix([[0.0, 1.0], [-1.0, 0.0]])).mid()) == 0.0


def test_the_growth_of_balls_is_that_of_their_worst_matrix():
    wide = arb_mat([[arb(0, 0.5), arb(1, 0.25)], [arb(0), arb(-1, 0.5)]])
    assert float(logarithmic_norm(wide).upper()) >= 0.5 + 0.625


def test_what_lies_beyond_a_degree_is_summed_from_the_last():
    sizes = [arb(v) for v in (1, 2, 4, 8)]
    assert [float(v.mid()) for v in beyond(sizes)] == [8.0, 12.0, 14.0]


def test_all_durations_up_to_a_length_are_in_its_ball_and_little_else():
    ball = up_to(arb(0.75))
    assert all(ball.contains(v) for v in (0.0, 0.1, 0.5, 0.75))
    assert float(ball.lower()) >= -1e-6 and float(ball.upper()) <= 0.75 + 1e-6


def test_powers_of_two_scale_a_matrix_exactly_and_columns_are_columns():
    A = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    rows, columns = np.array([0.5, 4.0]), np.array([1.0, 2.0, 0.25])
    assert (middles(scaled(matrix(A), rows, columns)) == rows[:, None] * A * columns).all()
    assert (middles(column(matrix(A), 1)) == A[:, 1:2]).all()
    Phi, Gamma = held(matrix(np.array([[0.0, 1.0], [0.0, 0.0]])), matrix([[0.0], [1.0]]), arb(3))
    assert middles(Phi) == pytest.approx(np.array([[1.0, 3.0], [0.0, 1.0]]))
    assert middles(Gamma) == pytest.approx(np.array([[4.5], [3.0]]))


@pytest.mark.parametrize("length", [0.05, 0.4, 1.5])
def test_an_expansion_in_time_holds_the_solution_at_every_time_in_between(length):
    """The last term is a ball that is right anywhere in the cell; it is the last power of the length that is left."""
    rng, known = np.random.default_rng(1), Monomials(0, 0)
    A, y = rng.normal(size=(3, 3)), rng.normal(size=(3, 1))
    with ctx.workprec(96):
        S, start = Series(known, [matrix(A)]), Series(known, [matrix(y)])
        inside = S.scaled(up_to(arb(length))).exp()
        terms = [start, *in_time(S, S * start, arb(length), inside)]
        assert len(terms) == ORDER + 1
        for share in (0.0, 0.1, 0.5, 0.9, 1.0):
            total = sum(
                (term.parts[0] * arb(share) ** order for order, term in enumerate(terms[1:], 1)), start.parts[0] * 1
            )
            truth = expm(A * length * share) @ y
            for ball, value in zip(total.entries(), truth.ravel(), strict=True):
                assert float(ball.lower()) - 1e-13 <= value <= float(ball.upper()) + 1e-13
        rest = max(float(x.rad()) for x in terms[-1].parts[0].entries())
        norm = np.linalg.norm(A, 2) * length
        assert rest <= 4.0 * norm**ORDER / math.factorial(ORDER) * (np.exp(norm) - 1.0) * np.linalg.norm(y) + 1e-20
        exact = [np.linalg.matrix_power(A * length, k) @ y / math.factorial(k) for k in range(ORDER)]
        for term, value in zip(terms[:-1], exact, strict=True):
            assert middles(term.parts[0]) == pytest.approx(value, abs=1e-13)


def pendulum(spread):
    A = parse_matrix("A", [["0", "1"], ["-2 + p1*cos(p1)", "-0.5 + p1**2"]], ("p1",))
    B = parse_matrix("B", [["0"], ["1 + sin(p1)"]], ("p1",))
    return LinearSystem(A, B, np.array([[0.3], [1.0]]), parameters=Box(np.array([-spread]), np.array([spread])))


@pytest.mark.parametrize("degree", [1, 2, 4])
@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_what_the_polynomial_leaves_out_is_bounded_by_the_comparison_system(degree, spread):
    """``|T^-1 (x - polynomial)|`` is at most ``n_{D+1}``, and ``n_j`` at least the norm of the coefficient of degree
    ``j``, for a constant control of either sign and any initial state."""
    rng, time = np.random.default_rng(2), 0.8
    system = pendulum(spread)
    flow = Flow(system, (0.0,), (spread,), degree)
    with ctx.workprec(96):
        rest = Remainder.of(flow, time, np.array([1.0, 1.0]))
        Phi, Gamma = flow.states.held(flow.inputs, arb(time))
        growth, driven = held(rest.growth, rest.control, arb(time))
        for _ in range(4):
            x0, u = rng.normal(size=(2, 1)), float(rng.normal())
            parts = [a * matrix(x0) + b * arb(u) for a, b in zip(Phi.parts, Gamma.parts, strict=True)]
            coefficients = np.array([middles(part)[:, 0] for part in parts])
            size = np.linalg.norm(np.linalg.solve(rest.transform, x0))
            bounds = growth * rest.start(arb(float(size)).upper()) + driven * arb(abs(u))
            n = [float(v.upper()) for v in bounds.entries()]
            assert len(n) == degree + 2
            left_out = 0.0
            for delta in np.linspace(-1.0, 1.0, 41):
                both = expm(
                    np.block(
                        [
                            [
                                system.A.evaluate(np.array([[spread * delta]]))[0],
                                system.B.evaluate(np.array([[spread * delta]]))[0],
                            ],
                            [np.zeros((1, 3))],
                        ]
                    )
                    * time
                )
                truth = (both[:2, :2] @ x0 + both[:2, 2:] * u).ravel()
                off = truth - delta ** np.arange(degree + 1) @ coefficients
                left_out = max(left_out, float(np.linalg.norm(np.linalg.solve(rest.transform, off))))
            assert left_out <= n[-1] + 1e-12
            for j in range(degree + 1):
                norm = np.linalg.norm(np.linalg.solve(rest.transform, coefficients[j]))
                assert norm <= n[j] + 1e-12
            if spread == 0.05:  # of the order of the first power that is left out
                assert n[-1] <= 60.0 * (3.0 * spread) ** (degree + 1) * (size + abs(u))
            closer = rest.closer(bounds, [rest.inverse * part for part in parts], flow.monomials.exponents)
            for j, (kept, plain) in enumerate(zip(closer.entries(), n, strict=True)):
                truth = n[-1] if j > degree else np.linalg.norm(np.linalg.solve(rest.transform, coefficients[j]))
                assert truth - 1e-12 <= float(kept.upper()) <= plain * (1 + 1e-12)
                assert float(kept.upper()) <= truth * (1 + 1e-9) + 1e-12


def test_norms_begin_with_the_state_alone():
    flow = Flow(pendulum(0.1), (0.0,), (0.1,), 2)
    with ctx.workprec(96):
        rest = Remainder.of(flow, 1.0, np.ones(2))
        assert [float(v.mid()) for v in rest.start(arb(3)).entries()] == [3.0, 0.0, 0.0, 0.0]
        assert middles(rest.inverse * matrix(rest.transform)) == pytest.approx(np.eye(2), abs=1e-12)


def test_units_that_balance_a_matrix_make_rows_as_large_as_columns():
    rng = np.random.default_rng(3)
    for _ in range(5):
        units = 2.0 ** rng.integers(-20, 20, size=3)
        A = units[:, None] * rng.uniform(0.5, 2.0, size=(3, 3)) / units
        speed = units * rng.uniform(0.5, 2.0, size=3)
        found = balanced(A, 1.0, speed)
        assert (np.log2(found) == np.round(np.log2(found))).all()
        plain = A / found[:, None] * found
        assert np.abs(plain).max() <= 64.0
        # in states that are so many times as large, units are
        again = balanced(A * 1.0, 1.0, speed * 1024.0)
        assert again == pytest.approx(found * 1024.0, rel=1.0)
        own = OwnUnits.of(matrix(A), 1.0, speed)
        assert float(own.growth.mid()) == pytest.approx(np.linalg.norm(A / own.units[:, None] * own.units))
        assert middles(own.states(matrix(A))) == pytest.approx(A / own.units[:, None])
        assert middles(own.rows(matrix(A))) == pytest.approx(A * own.units)


def test_flows_are_at_a_point_or_over_a_box_one_for_every_mode():
    (point,) = flows(pendulum(0.1), [0.05])
    (wide,) = flows(pendulum(0.1), [0.0], [0.1], 3)
    assert point.monomials.size == 1 and wide.monomials.size == 4
    with ctx.workprec(96):
        assert middles(point.parts["A"][0])[1] == pytest.approx([-2 + 0.05 * np.cos(0.05), -0.5 + 0.0025])
        assert middles(wide.parts["A"][1])[1] == pytest.approx([0.1, 0.0])
        # a row is a functional of the state as a column, and below it its integral times E
        rows = middles(point.rows.parts[0])
        assert rows[:2, :2] == pytest.approx(middles(point.parts["A"][0]).T)
        assert rows[2:, :2] == pytest.approx(middles(point.parts["E"][0]).T)
        assert not rows[:, 2:].any()
        assert stacked([[arb(1), arb(2)]]).ncols() == 2
