"""Guards sip/inner/curved: what is claimed of the least curvature holds exactly, and a bound with it is never above the
optimum, which is computed in fractions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.inner.curved import curved_bound, least_curvature


def pivots(rows):
    """The pivots of the elimination of a symmetric matrix of fractions: all positive exactly where it is positive
    definite (Sylvester)."""
    rows, found = [list(row) for row in rows], []
    for k in range(len(rows)):
        found.append(rows[k][k])
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return found


def solved(matrix, right):
    """The exact solution of a system."""
    n = len(right)
    rows = [[Fraction(float(v)) for v in row] + [value] for row, value in zip(matrix, right, strict=True)]
    for k in range(n):
        for i in range(n):
            if i != k:
                factor = rows[i][k] / rows[k][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [rows[k][n] / rows[k][k] for k in range(n)]


def squares(n, seed, spread):
    """A Gram matrix whose columns have sizes from 1 to ``10 ** spread``."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n + 2, n)) * 10.0 ** np.linspace(0, spread, n)
    return root.T @ root


@pytest.mark.parametrize("spread", [0, 3])
@pytest.mark.parametrize("seed", range(5))
def test_the_curvature_that_is_split_off_leaves_a_positive_definite_matrix(seed, spread):
    P = squares(5, seed, spread)
    c = least_curvature(P)
    assert (c > 0.0).all()
    left = [[Fraction(float(v)) for v in row] for row in P]
    for i, curvature in enumerate(c):
        left[i][i] -= Fraction(float(curvature))
    assert all(pivot > 0 for pivot in pivots(left))


@pytest.mark.parametrize(
    "P",
    [
        [[1.0, 2.0], [2.0, 1.0]],
        [[1.0, 1.0], [1.0, 1.0]],
        [[0.0, 0.0], [0.0, 1.0]],
        [[1.0, 1.0 - 2**-53], [1.0 - 2**-53, 1.0]],
    ],
)
def test_nothing_is_split_off_a_matrix_that_is_not_seen_to_be_positive_definite(P):
    assert least_curvature(np.array(P)) is None


def test_the_curvature_does_not_depend_on_units():
    P, unit = squares(4, 1, 0), np.exp2([0.0, 12.0, -9.0, 3.0])
    np.testing.assert_array_equal(least_curvature(P * unit * unit[:, np.newaxis]), least_curvature(P) * unit**2)


@pytest.mark.parametrize("off", [0.0, 1e-6, 1e-2])
@pytest.mark.parametrize("seed", range(4))
def test_a_bound_of_free_variables_is_just_below_the_optimum(seed, off):
    rng = np.random.default_rng(seed)
    P, q = squares(4, seed, 1), rng.standard_normal(4)
    program = sr.SemiInfiniteProgram(n=4, P=P, q=q).finite
    exact = solved(P, [-Fraction(float(v)) for v in q])
    least = float(sum(Fraction(float(a)) * b for a, b in zip(q, exact, strict=True)) / 2)
    at = np.array([float(v) for v in exact]) + off * rng.standard_normal(4)
    bound, _ = curved_bound(program, least_curvature(P), np.zeros(0), np.zeros(0), at)
    assert least - 1e-11 * max(1.0, abs(least)) <= bound <= least


def test_a_program_with_free_variables_and_a_quadratic_cost_has_a_lower_bound():
    """Nearest to 1 in the mean among the polynomials of degree 5 that fall nowhere on [0, 6], of data that fall."""
    t = np.linspace(0.0, 6.0, 30)
    y, powers = 1 + np.tanh(t - 3) + 0.1 * np.sin(40 * t), np.arange(6)
    V = t[:, np.newaxis] ** powers
    rising = sr.ConstraintFamily(
        name="rising",
        index_set=sr.Box([0.0], [6.0]),
        rows=lambda s: (-(powers * s ** np.maximum(powers - 1, 0))[:, np.newaxis], np.zeros((len(s), 1))),
    )
    result = sr.solve(
        sr.SemiInfiniteProgram(n=6, P=V.T @ V / 15, q=-V.T @ y / 15, constant=y @ y / 30, families=[rising])
    )
    assert result.lower_bound > -np.inf
    assert abs(result.cost - result.lower_bound) <= 1e-8


def ill_conditioned(seed, largest, n=8, rows=6):
    """A Hessian of condition 1e12 whose eigenvectors are not those of the entries, a linear cost, and rows."""
    rng = np.random.default_rng(seed)
    turned = np.linalg.qr(rng.standard_normal((n, n)))[0]
    P = (turned * np.logspace(0, -12, n) * largest) @ turned.T
    return (P + P.T) / 2, rng.standard_normal(n), rng.standard_normal((rows, n)), np.abs(rng.standard_normal(rows))


@pytest.mark.parametrize("reach", [10.0, np.inf])
@pytest.mark.parametrize(("largest", "seed"), [(1.0, 0), (1e6, 0), (1e6, 1), (1e6, 2), (1e12, 2)])
def test_a_hessian_of_condition_1e12_is_solved_as_bare_piqp_solves_it(seed, largest, reach):
    piqp = pytest.importorskip("piqp")
    P, q, G, h = ill_conditioned(seed, largest)
    bare, box = piqp.DenseSolver(), np.full(8, reach)
    bare.settings.max_iter = 500
    bare.setup(P, q, None, None, G, None, h, -box, box)
    status, x = bare.solve(), bare.result.x
    result = sr.solve(sr.SemiInfiniteProgram(n=8, P=P, q=q, G=G, h=h, lower=-reach, upper=reach))
    assert result.lower_bound <= result.value
    assert abs(result.value - result.lower_bound) <= 2e-8 * abs(result.value)
    if status == piqp.PIQP_SOLVED:
        cost = 0.5 * x @ P @ x + q @ x
        assert result.value <= cost + 1e-6 * abs(cost)
        if np.isfinite(reach) and largest == 1.0:
            assert abs(result.value - cost) <= 1e-7 * abs(cost)


def test_a_matrix_is_proven_where_its_trace_proves_nothing():
    rng = np.random.default_rng(3)
    turned = np.linalg.qr(rng.standard_normal((24, 24)))[0]
    P = (turned * np.logspace(0, -14, 24)) @ turned.T
    P = (P + P.T) / 2
    c = least_curvature(P)
    left = [[Fraction(float(v)) for v in row] for row in P]
    for i, curvature in enumerate(c):
        left[i][i] -= Fraction(float(curvature))
    assert all(pivot > 0 for pivot in pivots(left))


def test_squares_that_cancel_are_summed_with_more_digits():
    P = ill_conditioned(4, 1e12)[0]
    x = np.linalg.eigh(P)[1][:, 0]
    exact = sum(
        Fraction(float(P[i, j])) * Fraction(float(x[i])) * Fraction(float(x[j])) for i in range(8) for j in range(8)
    )
    program = sr.SemiInfiniteProgram(n=8, P=P, q=np.zeros(8)).finite
    assert abs(program.objective(x) - float(exact / 2)) <= 1e-8 * abs(float(exact))
    assert abs(program.objective(x) - float(exact / 2)) <= 2.0**-50 * program.magnitude(x)
