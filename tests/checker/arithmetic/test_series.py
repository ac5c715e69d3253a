"""Guards checker/arithmetic/series: exponentials of series hold the exact ones, and what is left out of them is
bounded."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
from flint import arb, arb_mat, ctx

from sparserob_core.checker.arithmetic import series
from sparserob_core.checker.arithmetic.jets import Monomials
from sparserob_core.checker.arithmetic.series import Exponentials, Series, _tail, norm


def matrix(values):
    return arb_mat([[arb(float(v)) for v in row] for row in np.atleast_2d(values)])


@pytest.mark.parametrize("size", [0.1, 0.2, 0.249, 0.25, 0.4])
@pytest.mark.parametrize("terms", [0, 1, 4, 8])
def test_what_the_exponential_leaves_out_is_at_most_its_tail_and_not_much_less(size, terms):
    with ctx.workprec(200):
        missing = arb(size).exp() - sum((arb(size) ** k / arb(k).fac() for k in range(terms + 1)), arb(0))
        bound = _tail(arb(size), terms)
        assert missing < bound
        assert bound < 2.0 * missing
        assert _tail(arb(0.99), 0) > arb(0.99).exp() - 1


def test_the_exponential_of_a_number_that_depends_on_a_parameter_is_held_to_all_digits():
    """``exp((a + b delta) s)`` has the coefficients ``e^(a s) (b s)^k / k!``."""
    known = Monomials(1, 6)
    for a, b in ((0.094, 1e-30), (0.2, 1e-30), (0.3, 0.1), (-2.0, 0.7), (5.0, -3.0), (-40.0, 2.0)):
        for precision in (64, 96, 160):
            with ctx.workprec(precision):
                parts = [matrix([[a]]), matrix([[b]]), *[matrix([[0.0]])] * 5]
                found = [part[0, 0] for part in Series(known, parts).exp().parts]
            with ctx.workprec(600):
                for k, ball in enumerate(found):
                    truth = arb(a).exp() * arb(b) ** k / arb(k).fac()
                    assert ball.contains(truth.mid()), (a, b, precision, k)
                    # squaring back is exact but for rounding: relative to the first coefficient
                    assert float(ball.rad()) < 2.0 ** (40 - precision) * math.exp(max(a, 0.0) + abs(b))


def test_exponentials_that_are_products_of_one_another_hold_the_exact_ones_and_hardly_grow():
    """``exp((a + b delta) s)`` at ticks in any order, and up to a tick beside them."""
    known, (a, b), tick = Monomials(1, 4), (-1.7, 0.3), 2.0**-40
    rng = np.random.default_rng(3)
    with ctx.workprec(96):
        every = Exponentials(Series(known, [matrix([[a]]), matrix([[b]]), *[matrix([[0.0]])] * 3]), tick)
        for ticks in (
            *(2**38 * k for k in (2, 1, 3)),
            *(2**36 * k + 1 for k in range(12)),
            *rng.integers(1, 2**41, 20),
        ):
            at, near = every.at(int(ticks)), every.at(int(ticks)) * every.around(1)
            for part, beside, k in zip(at.parts, near.parts, range(5), strict=True):
                with ctx.workprec(300):
                    for found, off in ((part, 0.0), (beside, 0.99), (beside, -0.99)):
                        time = arb(tick) * (arb(int(ticks)) + arb(off))
                        assert found[0, 0].contains((arb(a) * time).exp() * (arb(b) * time) ** k / arb(k).fac())
                assert float(part[0, 0].rad()) < 2.0**-70
                assert float(beside[0, 0].rad()) < 2.0**-34


def test_exponentials_hold_those_of_every_time_of_a_ball_in_any_units_and_in_many_strides():
    """A rotation whose speed depends on a parameter, in units that are 2^40 apart: ``exp`` of ``(a + b delta) J t``."""
    known, (a, b), c = Monomials(1, 3), (3.0, 0.5), 2.0**40
    turn, order = np.array([[0.0, 1.0 / c], [-c, 0.0]]), range(4)
    with ctx.workprec(96):
        parts = [matrix(a * turn), matrix(b * turn), matrix(0 * turn), matrix(0 * turn)]
        every = Exponentials(Series(known, parts), 2.0**-20, [1.0, c])
        for centre, rad in ((0.0, 2.0**-30), (0.25, 0.0), (7.0, 2.0**-50), (37.7, 2.0**-40), (300.0, 0.0)):
            found = every.of(arb(centre, rad))
            for time in (arb(centre) - arb(rad), arb(centre), arb(centre) + arb(rad)):
                for part, k in zip(found.parts, order, strict=True):
                    with ctx.workprec(400):
                        angle, scale = arb(a) * time, (arb(b) * time) ** k / arb(k).fac()
                        # the k-th derivative of cosine and sine
                        waves = [angle.cos(), -angle.sin(), -angle.cos(), angle.sin()]
                        cosine, sine = scale * waves[k % 4], -scale * waves[(k + 1) % 4]
                        assert part[0, 0].contains(cosine.mid()) and part[1, 1].contains(cosine.mid())
                        assert part[0, 1].contains((sine / arb(c)).mid()) and part[1, 0].contains((-sine * c).mid())
            most = 2.0**-60 + 4.0 * rad * (1.0 + b * centre) ** 3
            for part in found.parts:
                sizes = np.array([[float(x.rad()) for x in row] for row in part.tolist()])
                assert (sizes * [[1.0, c], [1.0 / c, 1.0]]).max() < most * (1.0 + centre**3)
        for length in (2.0**-9, 0.3, 2.0):
            inside = every.within(arb(length))
            for time in np.linspace(0.0, length, 5):
                assert inside.parts[0][0, 1].contains(arb(a * time).sin() / c)
            assert float(inside.parts[0][0, 0].rad()) < 3.0 * (np.exp(3.5 * length) - 1.0)


def test_what_is_left_out_of_a_sum_of_powers_is_in_every_entry():
    """With as few terms as one, the first entries are off by the whole tail, in their units."""
    with ctx.workprec(64):
        every = Exponentials(Series(Monomials(0, 0), [matrix([[0.0, 8.0], [0.0, 0.0]])]), 1.0, [8.0, 1.0])
        every.__dict__["_terms"] = 1
        (found,) = every.of(arb(0.125)).parts
        for (i, j), unit in {(0, 0): 1.0, (0, 1): 8.0, (1, 0): 0.125, (1, 1): 1.0}.items():
            assert float(found[i, j].rad()) >= unit * 0.125**2 / 2.0
            assert float(found[i, j].rad()) < unit * 0.125**2 * 1.1


def test_whole_strides_are_remembered_and_no_more_than_are_kept(monkeypatch):
    monkeypatch.setattr(series, "STRIDES_KEPT", 8)
    with ctx.workprec(96):
        every = Exponentials(Series(Monomials(1, 1), [matrix([[0.2]]), matrix([[0.01]])]), 1.0)
        for ticks in range(1, 200):
            assert every.at(ticks).parts[0][0, 0].contains((arb(0.2) * ticks).exp())
            assert every.at(ticks) is every.at(ticks)
        assert len(every._strides) < 8 + 9


def test_an_exponential_in_too_many_strides_is_no_number():
    for value in (1e30, float("inf"), float("nan")):
        every = Exponentials(Series(Monomials(1, 1), [matrix([[value]]), matrix([[1.0]])]), 1.0)
        for found in (every.of(arb(1)), every.within(arb(1))):
            assert not found.parts[0][0, 0].is_finite()
    every = Exponentials(Series(Monomials(1, 1), [matrix([[1.0]]), matrix([[1.0]])]), 1.0)
    assert not every.of(arb(0, 0.6)).parts[0][0, 0].is_finite()  # wider than a stride: 1.2 times the norm
    none = Exponentials(Series(Monomials(1, 1), [matrix([[0.0]]), matrix([[0.0]])]), 1.0)
    assert float(none.of(arb(1e6)).parts[0][0, 0].mid()) == 1.0


def test_the_exponential_of_a_matrix_that_depends_on_two_parameters_is_that_at_each_of_them():
    rng, known = np.random.default_rng(1), Monomials(2, 9)
    A = rng.normal(size=(known.size, 3, 3)) * 0.02 ** np.array([sum(e) for e in known.exponents])[:, None, None]
    A[3:] = 0.0
    with ctx.workprec(96):
        found = Series(known, [matrix(a) for a in A]).exp()
        values = np.array([[[float(x.mid()) for x in row] for row in part.tolist()] for part in found.parts])
    for delta in rng.uniform(-1, 1, size=(10, 2)):
        powers = np.prod(delta[None] ** np.array(known.exponents), axis=1)
        truth = scipy.linalg.expm(np.einsum("m,mij->ij", powers, A))
        assert np.abs(np.einsum("m,mij->ij", powers, values) - truth).max() < 1e-12


def test_coefficients_in_variables_that_do_not_appear_have_no_tail():
    known = Monomials(2, 2)
    with ctx.workprec(64):
        parts = [matrix([[0.1]]), matrix([[0.0]]), matrix([[0.2]]), *[matrix([[0.0]])] * 3]
        exponents = known.exponents
        assert exponents[2] == (1, 0)
        for e, part in zip(exponents, Series(known, parts).exp().parts, strict=True):
            assert part[0, 0].is_zero() == (e[1] > 0)


def test_an_exponential_that_is_too_large_is_no_number():
    known = Monomials(1, 1)
    with ctx.workprec(64):
        parts = Series(known, [matrix([[1e19]]), matrix([[1.0]])]).exp().parts
        assert not any(part[0, 0].is_finite() for part in parts)
        assert Series(known, [matrix([[-1e9]]), matrix([[1.0]])]).exp().parts[0][0, 0].is_finite()


def test_the_state_and_its_integral_are_those_of_a_constant_input():
    rng = np.random.default_rng(2)
    A, B, time = rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), 0.8
    known = Monomials(1, 3)
    with ctx.workprec(96):
        zeros = [matrix(np.zeros((3, 3)))] * 3, [matrix(np.zeros((3, 2)))] * 3
        Phi, Gamma = Series(known, [matrix(A), *zeros[0]]).held(Series(known, [matrix(B), *zeros[1]]), arb(time))
        plain = Series(Monomials(0, 0), [matrix(A)]).held(Series(Monomials(0, 0), [matrix(B)]), arb(time))
    for found in ((Phi, Gamma), plain):
        values = [np.array([[float(x.mid()) for x in row] for row in one.parts[0].tolist()]) for one in found]
        assert values[0] == pytest.approx(scipy.linalg.expm(A * time), abs=1e-12)
        assert values[1] == pytest.approx(np.linalg.solve(A, values[0] - np.eye(3)) @ B, abs=1e-11)
    assert all(x.contains(0) for part in (*Phi.parts[1:], *Gamma.parts[1:]) for x in part.entries())


def test_products_and_sums_of_series_are_those_of_polynomials():
    rng, known = np.random.default_rng(3), Monomials(2, 2)
    A, B = rng.normal(size=(2, known.size, 2, 2))
    A[1] = 0.0
    with ctx.workprec(96):
        left, right = (Series(known, [matrix(m) for m in one]) for one in (A, B))
        product, total = left * right, left + right
        scaled, applied = left.scaled(arb(-0.5)), left.applied(matrix(B[0]))
        truth = np.zeros_like(A)
        for i, j, k in known.products:
            truth[k] += A[i] @ B[j]
        for one, expected in ((product, truth), (total, A + B), (scaled, -A / 2), (applied, A @ B[0])):
            values = np.array([[[float(x.mid()) for x in row] for row in part.tolist()] for part in one.parts])
            assert values == pytest.approx(expected, abs=1e-14)
        size = left.size()
    sizes = [float(np.linalg.norm(a)) for a in A]
    assert float(size.mid()) == pytest.approx(sum(sizes))
    assert size.is_exact() or float(size.lower()) >= sum(sizes) * (1 - 1e-15)


def test_the_norm_of_a_ball_matrix_holds_frobenius_norms():
    values = np.array([[3.0, -4.0, 12.0], [0.0, 84.0, 1.0]])
    with ctx.workprec(96):
        assert abs(float(norm(matrix(values)).mid()) - np.linalg.norm(values)) < 1e-12
        wide = arb_mat([[arb(1, 0.5), arb(0, 0.25)]])
        assert norm(wide).contains(arb(1.5**2 + 0.25**2).sqrt().mid()) and norm(wide).contains(0.5)
        assert norm(matrix(np.zeros((2, 2)))) == 0
