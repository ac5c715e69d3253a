"""Guards checker/arithmetic/series: products of matrices that depend on parameters hold the products at every
parameter, whatever is beyond the degree."""

from __future__ import annotations

from itertools import product as every

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

from sparserob_core.checker.arithmetic.monomials import NONE, Monomials
from sparserob_core.checker.arithmetic.series import Series, around, dot, identity, norm, products, stacked
from sparserob_core.checker.outcome import Unchecked


def matrix(values):
    return arb_mat([[arb(float(v)) for v in row] for row in np.atleast_2d(values)])


def values_of(series):
    return np.array([[[float(x.mid()) for x in row] for row in part.tolist()] for part in series.parts])


def at(series, point):
    """The matrix at parameters from -1 to 1."""
    powers = [np.prod(np.asarray(point) ** np.array(e, dtype=int)) for e in series.monomials.exponents]
    return sum((part * arb(float(p)) for part, p in zip(series.parts, powers, strict=True)), series.parts[0] * 0)


def random(rng, monomials, shape, wide=0.0):
    """One whose balls are wide, and matrices within it as a function of the parameters."""
    mid = rng.normal(size=(monomials.size, *shape))
    rad = wide * rng.uniform(size=mid.shape)
    parts = [arb_mat([[arb(float(a), float(b)) for a, b in zip(*rows, strict=True)]
                      for rows in zip(*one, strict=True)]) for one in zip(mid, rad, strict=True)]  # fmt: skip
    return Series(monomials, parts), mid


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 1), (1, 3), (2, 1), (2, 2), (3, 2)])
def test_a_product_holds_that_of_the_matrices_at_every_parameter(count, degree):
    rng, known = np.random.default_rng(count + 10 * degree), Monomials(count, degree)
    points = [*rng.choice([-1.0, 1.0], size=(8, count)), *rng.uniform(-1, 1, size=(8, count))]
    with ctx.workprec(96):
        for _ in range(5):
            (left, _), (right, _) = random(rng, known, (3, 2)), random(rng, known, (2, 4))
            found = left * right
            for point in points:
                for ball, truth in zip(at(found, point).entries(), (at(left, point) * at(right, point)).entries(),
                                       strict=True):  # fmt: skip
                    assert ball.overlaps(truth)
                    assert abs(ball.mid() - truth.mid()) <= ball.rad() + truth.rad()


@pytest.mark.parametrize(("count", "degree"), [(1, 1), (1, 4), (2, 2), (2, 3)])
def test_all_that_is_beyond_the_degree_is_needed_at_a_corner_and_no_more_is_added(count, degree):
    """With positive numbers, for which nothing cancels."""
    rng, known = np.random.default_rng(1), Monomials(count, degree)
    A, B = rng.uniform(0.5, 1.0, size=(2, known.size, 2, 2))
    with ctx.workprec(96):
        left, right = (Series(known, [matrix(one) for one in two]) for two in (A, B))
        (first, *_) = (left * right).parts
        kept = sum(A[i] @ B[j] for i, pairs in enumerate(known.products_with) for j, _ in pairs)
        beyond = A.sum(axis=0) @ B.sum(axis=0) - kept
        radii = np.array([[float(x.rad()) for x in row] for row in first.tolist()])
    assert (radii >= beyond * (1 - 1e-12)).all()
    assert (radii <= beyond * (1 + 1e-6)).all()


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 1), (1, 4), (2, 2), (2, 3)])
@pytest.mark.parametrize("dense", [True, False])
def test_a_sum_of_products_is_what_the_products_add_up_to(count, degree, dense):
    """Whether factors have all coefficients, and are one matrix, or few, and are multiplied one by one."""
    rng, known = np.random.default_rng(7), Monomials(count, degree)
    with ctx.workprec(96):
        lefts, rights = ([random(rng, known, shape, wide=1e-9)[0] for _ in range(3)] for shape in ((3, 2), (2, 4)))
        if not dense:
            lefts = [Series(known, [*one.parts[:-1], one.parts[-1] * 0]) for one in lefts]
        found = dot(lefts, rights)
        terms = [left * right for left, right in zip(lefts, rights, strict=True)]
        truth = terms[0] + terms[1] + terms[2]
        assert found.size == pytest.approx(truth.size, rel=1e-7)  # radii have thirty bits
        for ours, theirs in zip(found.parts, truth.parts, strict=True):
            for a, b in zip(ours.entries(), theirs.entries(), strict=True):
                assert a.overlaps(b)
                assert float(a.mid()) == pytest.approx(float(b.mid()), abs=1e-12)
                assert float(a.rad()) == pytest.approx(float(b.rad()), rel=1e-7, abs=1e-20)


def test_factors_of_which_most_is_nothing_lose_nothing_either():
    known = Monomials(2, 2)
    with ctx.workprec(96):
        for i, j in every(range(known.size), repeat=2):
            parts = [[matrix([[0.0]]) for _ in range(known.size)] for _ in range(2)]
            parts[0][i], parts[1][j] = matrix([[2.0]]), matrix([[3.0]])
            left, right = (Series(known, one) for one in parts)
            assert left.there == [k == i for k in range(known.size)]
            e = tuple(a + b for a, b in zip(known.exponents[i], known.exponents[j], strict=True))
            found = left * right
            if e in known.number:
                assert found.parts[known.number[e]][0, 0] == 6
                assert sum(found.there) == 1
            else:
                assert float(found.parts[0][0, 0].rad()) >= 6.0


def test_the_balls_of_factors_are_in_products_and_sizes():
    rng, known = np.random.default_rng(4), Monomials(1, 2)
    with ctx.workprec(96):
        (left, A), (right, _) = (random(rng, known, (2, 2), wide=0.25) for _ in range(2))
        found = left * right
        for _ in range(40):
            a, b = (np.array([[[float(x.mid()) + float(x.rad()) * rng.choice([-0.99, 0.99]) for x in row]
                               for row in part.tolist()] for part in one.parts]) for one in (left, right))  # fmt: skip
            s = float(rng.choice([-1.0, 1.0, 0.3]))
            powers = s ** np.arange(3)
            truth = np.einsum("m,mij->ij", powers, a) @ np.einsum("m,mij->ij", powers, b)
            assert all(x.contains(float(v)) for x, v in zip(at(found, [s]).entries(), truth.ravel(), strict=True))
            assert (np.abs(np.einsum("m,mij->ij", powers, a)) <= left.size).all()
            assert (np.abs(a) <= left.sizes).all()
        most = np.array([[[float(x.abs_upper()) for x in row] for row in part.tolist()] for part in left.parts])
    assert (left.size <= most.sum(axis=0) * (1 + 1e-9)).all()
    assert np.allclose(values_of(left.middle), A)
    assert all(x.is_exact() for part in left.middle.parts for x in part.entries())


def test_what_a_series_is_off_by_is_in_the_balls_of_its_constant():
    known = Monomials(1, 1)
    with ctx.workprec(96):
        found = Series.constant(known, matrix([[1.0, 2.0]])).within(np.array([[0.5, 0.0]]))
        assert found.parts[0][0, 0].contains(1.4999) and not found.parts[0][0, 0].contains(1.51)
        assert found.parts[0][0, 1] == 2 and found.parts[1][0, 0] == 0
    for bad in (np.inf, np.nan):
        with pytest.raises(Unchecked, match="beyond what numbers can hold"):
            around(np.array([[bad]]))


def test_products_and_sums_of_series_are_those_of_polynomials():
    rng, known = np.random.default_rng(3), Monomials(2, 2)
    A, B = rng.normal(size=(2, known.size, 2, 2))
    A[1] = 0.0
    with ctx.workprec(96):
        left, right = (Series(known, [matrix(m) for m in one]) for one in (A, B))
        product, total, less = left * right, left + right, left - right
        scaled, applied = left.scaled(arb(-0.5)), left.scaled(matrix(B[0]))
        truth = np.zeros_like(A)
        for i, j, k in ((i, j, k) for i, pairs in enumerate(known.products_with) for j, k in pairs):
            truth[k] += A[i] @ B[j]
        for one, expected in ((product, truth), (total, A + B), (less, A - B), (scaled, -A / 2), (applied, A @ B[0])):
            assert values_of(one) == pytest.approx(expected, abs=1e-14)


def test_the_norm_of_a_ball_matrix_holds_frobenius_norms():
    values = np.array([[3.0, -4.0, 12.0], [0.0, 84.0, 1.0]])
    with ctx.workprec(96):
        assert abs(float(norm(matrix(values)).mid()) - np.linalg.norm(values)) < 1e-12
        wide = arb_mat([[arb(1, 0.5), arb(0, 0.25)]])
        assert norm(wide).contains(arb(1.5**2 + 0.25**2).sqrt().mid()) and norm(wide).contains(0.5)
        assert norm(matrix(np.zeros((2, 2)))) == 0


def test_parts_of_matrices_are_put_together_and_taken_apart():
    rng, known = np.random.default_rng(5), Monomials(1, 1)
    A, B = rng.normal(size=(2, 2, 2, 3))
    with ctx.workprec(96):
        left, right = (Series(known, [matrix(m) for m in one]) for one in (A, B))
        both, below = left.append_columns(right), left.above(matrix([[7.0, 8.0, 9.0]]))
        assert (values_of(both) == np.concatenate([A, B], axis=2)).all()
        assert (values_of(both.columns(1, 4)) == np.concatenate([A, B], axis=2)[:, :, 1:4]).all()
        assert both.columns(2, 2).shape == (2, 0)
        assert (values_of(below)[:, :2] == A).all() and values_of(below)[:, 2].tolist() == [[7, 8, 9], [0, 0, 0]]
        assert (values_of(left.transpose()) == A.transpose(0, 2, 1)).all()
        assert left.append_columns(left.columns(0, 0)).shape == (2, 3)
        total = dot([left, right], [left.transpose(), right.transpose()])
        truth = left * left.transpose() + right * right.transpose()
        assert (values_of(total) == values_of(truth)).all()
        assert Series.known(matrix(A[0])).matrix == matrix(A[0])
        assert identity(2) == matrix(np.eye(2))


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 13])
def test_products_of_steps_are_what_the_later_ones_make_of_every_state(count):
    rng = np.random.default_rng(6)
    steps = rng.normal(size=(count, 2, 2))
    with ctx.workprec(96):
        found = products([Series.known(matrix(one)) for one in steps])
    assert len(found) == count + 1
    for k, one in enumerate(found):
        truth = np.linalg.multi_dot([np.eye(2), *steps[k:][::-1], np.eye(2)])
        assert values_of(one)[0] == pytest.approx(truth, abs=1e-12)


def test_a_coefficient_that_is_only_close_to_nothing_is_kept():
    known = Monomials(1, 2)
    with ctx.workprec(96):
        near = Series(known, [stacked([[arb(1)]]), stacked([[arb(0, 1e-20)]]), stacked([[arb(0)]])])
        assert near.there == [True, True, False]
        assert (near * near).parts[1][0, 0].contains(arb(2e-20))
        assert NONE.size == 1


def test_sizes_of_numbers_that_underflow_are_above_them_and_0_is_the_size_of_0() -> None:
    small = [arb(2) ** -1200, -(arb(2) ** -1074) * 3 / 2, arb(0, 1) * arb(2) ** -5000]
    size = Series(NONE, [arb_mat(1, 4, [*small, arb(0)])]).size[0]
    assert all(arb(bound) > abs(x) for bound, x in zip(size.tolist(), small, strict=False))
    assert size[3] == 0.0 < size[:3].min() <= size[:3].max() < 1e-299
