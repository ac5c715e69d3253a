"""Guards checker/flow/segment: what a polynomial is said to be off by from the flow is never less than it is, whatever
the polynomial, and little for a good one."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

import sparserob_core.checker.flow.segment as segments
from sparserob_core.checker.arithmetic.monomials import NONE, Monomials
from sparserob_core.checker.arithmetic.series import Series, middles
from sparserob_core.checker.flow.segment import Equation, VerifiedSegment, guess, shifted, solve, verify
from sparserob_core.checker.outcome import Unchecked

BITS = 192


@pytest.fixture(autouse=True)
def _precision():
    with ctx.workprec(BITS):
        yield


def matrix(values):
    return arb_mat([[arb(float(v)) for v in row] for row in np.atleast_2d(values)])


def series(monomials, *tables):
    """With so many first coefficients, the others 0."""
    first = matrix(tables[0])
    return Series(monomials, [*map(matrix, tables), *[first * 0] * (monomials.size - len(tables))])


def at(one, point):
    powers = [np.prod(np.asarray(point, dtype=float) ** np.array(e, dtype=int)) for e in one.monomials.exponents]
    return sum((part * arb(float(p)) for part, p in zip(one.parts, powers, strict=True)), one.parts[0] * 0)


def flow_at(A, F, point, share, count=100):
    """The flow by its power series where the parameters are numbers."""
    with ctx.workprec(2 * BITS):
        A, F = ([at(one, point) for one in every] for every in (A, F))
        d, w = A[0].nrows(), F[0].ncols()
        terms = [arb_mat([[arb(int(i == j)) for j in range(d + w)] for i in range(d)])]
        pushed = [arb_mat([[*[arb(0)] * d, *row] for row in one.tolist()]) for one in F]
        for n in range(count):
            total = arb_mat(d, d + w)
            for k in range(min(n + 1, len(A))):
                total = total + A[k] * terms[n - k]
            terms.append((total + pushed[n] if n < len(F) else total) / arb(n + 1))
        return sum((one * arb(share) ** n for n, one in enumerate(terms[1:], 1)), terms[0])


def value(terms, point, share):
    with ctx.workprec(2 * BITS):
        return sum((at(one, point) * arb(share) ** n for n, one in enumerate(terms)), terms[0].parts[0] * 0)


def missed(terms, equation, point, share):
    return np.abs(middles(value(terms, point, share) - flow_at(equation.A, equation.F, point, share)))


def system(count, degree, powers=3, size=0.6, d=2, w=2, seed=0):
    """Polynomials in the share, of coefficients that are 10 times smaller with every degree in the parameters."""
    rng, known = np.random.default_rng(seed), Monomials(count, degree) if degree else NONE
    shrink = np.array([0.1 ** sum(e) for e in known.exponents])[:, None, None]
    A, F = ([series(known, *(size * shrink * rng.normal(size=(known.size, d, n)))) for _ in range(powers)]
            for n in (d, w))  # fmt: skip
    return Equation(A, F)


def corners(count):
    rng = np.random.default_rng(7)
    return [*rng.choice([-1.0, 1.0], size=(3, count)), *rng.uniform(-1.0, 1.0, size=(2, count))]


CASES = [(0, 0, 1e-28), (1, 1, 0.3), (1, 6, 1e-5), (2, 2, 0.3), (2, 4, 1e-2)]


@pytest.mark.parametrize(("count", "degree", "near"), CASES)
def test_a_good_guess_is_off_by_less_than_is_said_and_that_is_little(count, degree, near):
    equation = system(count, degree)
    found = solve(equation.A, equation.F, np.ones(2))
    for point in corners(count):
        for share in (0.0, 0.3, 1.0):
            off = missed(found.terms, equation, point, share)
            assert (off <= found.off).all()
            ball = found.at(arb(share))
            truth = flow_at(equation.A, equation.F, point, share)
            assert all(a.overlaps(b) for a, b in zip(at(ball, point).entries(), truth.entries(), strict=True))
    assert found.off.max() < near


@pytest.mark.parametrize("count", [0, 1])
def test_a_guess_that_is_wrong_in_any_number_is_not_believed(count):
    """Every coefficient of every term in turn, by 1e-12: that is said, and hardly more."""
    equation = system(count, 9 * count, powers=2, size=0.3, w=1)
    if count:  # the parameter is in one number, so little that degree 9 is enough
        A = [series(Monomials(1, 9), [[0.1, 0.4], [-0.3, 0.2]], [[0.0, 1e-3], [0.0, 0.0]])]
        equation = Equation(A, [series(Monomials(1, 9), [[0.5], [-0.2]])])
    units, point = np.ones(2), [1.0] * count
    terms = guess(equation, units)
    small = float(verify(equation, terms, units).max())
    assert small < 1e-14
    for n, term in enumerate(terms):
        for k in range(0, len(term.parts), 4):
            for entry in range(6):
                table = term.parts[k].entries()
                table[entry] = table[entry] + (-1) ** entry * arb(1e-12)
                parts = [*term.parts[:k], arb_mat(2, 3, table), *term.parts[k + 1 :]]
                wrong = [*terms[:n], Series(term.monomials, parts), *terms[n + 1 :]]
                off = verify(equation, wrong, units)
                assert off.ravel()[entry] >= 1e-12 - small
                assert off.max() < 1e-10
                if n < 3 and k < 5 and entry < 3:
                    assert (missed(wrong, equation, point, 1.0) <= off).all()


@pytest.mark.parametrize(("count", "degree", "_"), CASES)
def test_of_a_guess_with_few_terms_all_that_is_missing_is_said(count, degree, _):
    equation, last = system(count, degree, powers=4), np.inf
    terms = guess(equation, np.ones(2))
    for kept in (1, 2, 3, 4, 6, 9):
        off = verify(equation, terms[:kept], np.ones(2))
        for point in corners(count):
            for share in (0.4, 1.0):
                assert (missed(terms[:kept], equation, point, share) <= off).all()
        assert off.max() < last * 1.5
        last = off.max()


@pytest.mark.parametrize("powers", [1, 2, 4])
@pytest.mark.parametrize("count", [0, 1])
def test_what_is_missed_at_the_beginning_grows_as_gronwall_says_and_no_more(powers, count):
    """A flow that is a share too large solves the equation, but begins elsewhere: of ``x' = a x^k x``, which grows by
    ``e^(a / (k + 1))``, at the largest parameter."""
    known = Monomials(1, 20) if count else NONE
    rates = [[[[6.0]], [[1.0]]][: 1 + count] if k == powers - 1 else [[[0.0]]] for k in range(powers)]
    equation = Equation([series(known, *one) for one in rates], [series(known, [[0.0]])])
    terms, units = guess(equation, np.ones(1)), np.ones(1)
    wrong = [one.scaled(1 + arb(1e-6)) for one in terms]
    off = verify(equation, wrong, units)[0, 0]
    grown = 1e-6 * np.exp((6.0 + count) / powers)
    assert grown * (1 - 1e-9) <= off <= grown * 1.01
    assert missed(wrong, equation, [1.0] * count, 1.0)[0, 0] <= off


def test_the_units_of_the_states_are_those_of_what_is_missed():
    """Of a state in units of 2^40 that is driven by one of 1, and drives it: in units the system is small."""
    units = np.array([2.0**40, 1.0])
    plain = system(0, 0, powers=2)
    A = [Series.known(matrix(middles(one.matrix) * units[:, None] / units)) for one in plain.A]
    F = [Series.known(matrix(middles(one.matrix) * units[:, None])) for one in plain.F]
    one, other = solve(plain.A, plain.F, np.ones(2)), solve(A, F, units)
    scale = units[:, None] / np.concatenate([units, np.ones(2)])
    assert (other.off <= 1.001 * one.off.max() * scale).all()
    assert (missed(other.terms, Equation(A, F), [], 1.0) <= other.off).all()
    cut = verify(Equation(A, F), other.terms[:5], units)
    assert (missed(other.terms[:5], Equation(A, F), [], 1.0) <= cut).all()


@pytest.mark.parametrize("order", [1, 3, 6])
def test_terms_of_the_system_beyond_those_of_the_guess_count(order):
    """``x' = 3 t^n x + 5 t^n``: of a guess that stays where it is all is missing."""
    nothing = [Series.known(matrix([[0.0]]))] * order
    begin = Series.known(matrix([[1.0, 0.0]]))
    for A, F, least in (
        (nothing, [*nothing, Series.known(matrix([[5.0]]))], (0.0, 5.0 / (order + 1))),
        ([*nothing, Series.known(matrix([[3.0]]))], nothing, (np.exp(3.0 / (order + 1)) - 1.0, 0.0)),
    ):
        off = verify(Equation(A, F), [begin], np.ones(1))
        assert (np.array(least) <= off[0] + 1e-12).all()
        assert (off[0] <= 2.5 * np.array(least) + 1e-12).all()


def test_balls_of_the_system_are_in_what_is_missed():
    """``x' = a x + f`` with ``a`` of 1 +- 0.1 and ``f`` of 1 +- 0.2: any of them."""
    wide = [Series.known(arb_mat([[arb(1, 0.1)]]))], [Series.known(arb_mat([[arb(1, 0.2)]]))]
    found = solve(*wide, np.ones(1))
    for a in (0.9, 1.1):
        for f in (0.8, 1.2):
            truth = np.array([np.exp(a), f * np.expm1(a) / a])
            assert (np.abs(middles(value(found.terms, [], 1.0))[0] - truth) <= found.off[0]).all()
    # balls of a guess are in what it is off by as well
    balls = [Series.known(arb_mat([[arb(float(x.mid()), 1e-3) for x in one.matrix.entries()]])) for one in found.terms]
    assert verify(Equation(*wide), balls, np.ones(1)).max() > found.off.max() + 1e-3


def test_a_system_that_is_too_fast_is_refused():
    for rate in (301.0, -301.0, 1e300):
        with pytest.raises(Unchecked, match="too fast"):
            solve([Series.known(matrix([[rate]]))], [Series.known(matrix([[1.0]]))], np.ones(1))
    with pytest.raises(Unchecked, match="too fast"):
        solve([Series.known(matrix([[100.0]]))] * 12, [Series.known(matrix([[1.0]]))], np.ones(1))
    stiff = solve([Series.known(matrix([[-20.0]]))], [Series.known(matrix([[1.0]]))], np.ones(1))
    assert abs(middles(stiff.at(arb(1)).matrix)[0, 0] - np.exp(-20.0)) <= float(stiff.at(arb(1)).matrix[0, 0].rad())


@pytest.mark.parametrize("order", [1, 2, 4, 99])
@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 6), (2, 3)])
def test_parts_of_a_segment_hold_the_flow_with_as_few_terms_as_one_wants(count, degree, order):
    equation = system(count, degree)
    found = solve(equation.A, equation.F, np.ones(2))
    columns = series(found.terms[0].monomials, [[1.0], [-2.0], [0.5]], *[[[0.1], [0.2], [-0.1]]] * bool(count))
    applied = found.applied(columns)
    for start, width in ((0.0, 1.0), (0.25, 0.5), (0.9, 0.1), (0.3, 0.01), (0.7, 0.0)):
        terms, off = found.within(arb(start), arb(width), order)
        pushed, away = applied.within(arb(start), arb(width), order)
        assert len(terms) == len(pushed) == min(order, len(found.terms))
        for point in corners(count):
            for part in (0.0, 0.5, 1.0):
                truth = middles(flow_at(equation.A, equation.F, point, start + width * part))
                assert (np.abs(middles(value(terms, point, part)) - truth) <= off + 1e-14).all()
                state = middles(matrix(truth[:, :3]) * at(columns, point))
                assert (np.abs(middles(value(pushed, point, part)) - state) <= away + 1e-14).all()
        if width == 0.01 and order == 4:
            assert (off <= found.off + 1e-6).all() and (away <= 4.0 * found.off.max() + 1e-6).all()
        if order == 99:
            assert (off <= found.off * (1 + 1e-9)).all()


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 2)])
def test_the_end_and_the_first_terms_hold_the_flow_with_what_they_are_off_by(count, degree):
    equation = system(count, degree, size=1.0)
    one = solve(equation.A, equation.F, np.ones(2))
    for point in corners(count):
        inside = at(one.end, point)
        assert all(a.overlaps(b) for a, b in zip(inside.entries(), flow_at(
            equation.A, equation.F, point, 1.0).entries(), strict=True))  # fmt: skip
    for kept in (1, 4, len(one.terms) - 1):
        terms, off = one.first(kept)
        assert len(terms) == kept
        rest = sum(term.size for term in one.terms[kept:])
        assert (off >= rest + one.off).all() and (off <= (rest + one.off) * (1.0 + 1e-9)).all()
        for point in corners(count):
            for share in (0.3, 1.0):
                assert (missed(terms, equation, point, share) <= off).all()
    wide = VerifiedSegment(one.terms, one.off + 1e-3)
    assert (radii_of(wide.end.parts[0]) >= radii_of(one.end.parts[0]) + 1e-3 * (1.0 - 1e-4)).all()


def radii_of(one):
    return np.array([[float(x.rad()) for x in row] for row in one.tolist()])


def test_powers_of_what_is_shifted_are_those_of_binomials_from_above():
    for start, width in ((0.0, 1.0), (0.3, 0.7), (0.9, 0.05), (1.0, 0.0)):
        found = shifted(start, width, 40)
        for j in range(40):
            for n in range(40):
                with ctx.workprec(200):
                    exact = arb(start) ** (n - j) * arb(width) ** j * comb(n, j) if n >= j else arb(0)
                assert exact <= found[j, n] * (1 + 1e-300) or exact == 0
                assert float(found[j, n]) <= float(exact.upper()) * (1 + 1e-12)


def test_a_flow_keeps_to_the_parameters_that_appear():
    known = Monomials(2, 3)
    parts = [matrix([[0.5 if e == (0, 1) else 0.0]]) for e in known.exponents]
    found = solve([Series(known, parts)], [series(known, [[0.0]])], np.ones(1)).at(arb(1))
    for e, part in zip(known.exponents, found.parts, strict=True):
        if e[0]:
            assert part[0, 0].is_zero()
        else:
            assert abs(float(part[0, 0].mid()) - 0.5 ** e[1] / [1, 1, 2, 6][e[1]]) < 1e-15


def test_small_numbers_beside_large_ones_are_known_to_many_digits():
    units = np.array([2.0**42, 1.0])
    A = matrix([[-0.5, 2.0**40], [2.0**-45, -0.25]])
    found = solve([Series.known(A)], [Series.known(matrix([[0.0], [0.0]]))], units).at(arb(1)).matrix
    for ball, truth in zip([x for row in found.tolist() for x in row[:2]], A.exp().entries(), strict=True):
        assert ball.overlaps(truth)
        assert float(ball.rad()) < 1e-24 * abs(float(truth.mid()))


def test_a_polynomial_of_low_degree_is_not_taken_for_one_of_a_system_that_is():
    """``(1 + t) x`` is constant: its transitions are linear in the time, while ``1 / (1 + t)`` has all powers."""
    rates = [Series.known(matrix([[-(0.125 ** (k + 1))]])) for k in range(25)]
    found = solve(rates, [Series.known(matrix([[0.0]]))], np.ones(1))
    assert abs(middles(found.at(arb(1)).matrix)[0, 0] - 0.875) < 1e-15
    assert found.off.max() < 1e-20


def test_terms_are_as_many_as_are_needed_and_no_more_than_are_allowed(monkeypatch):
    equation = system(0, 0, size=0.2)
    found = solve(equation.A, equation.F, np.ones(2))
    assert 15 < len(found.terms) < 60
    monkeypatch.setattr(segments, "TERMS", 6)
    short = solve(equation.A, equation.F, np.ones(2))
    assert len(short.terms) <= 6 + segments.AT_ONCE and short.off.max() > 1e-9
    assert (missed(short.terms, equation, [], 1.0) <= short.off).all()


def test_what_is_remembered_of_one_polynomial_is_not_said_of_another():
    equation = system(0, 0)
    terms = guess(equation, np.ones(2))
    for n in range(6):
        for changed in range(max(0, n - 2), n + 1):
            wrong = [*terms]
            wrong[changed] = terms[changed].scaled(arb(2))
            for given in (terms, wrong, terms):
                found, fresh = equation.slope(given, n), Equation(equation.A, equation.F).slope(given, n)
                assert (middles(found.matrix) == middles(fresh.matrix)).all()
