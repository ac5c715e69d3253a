"""Guards checker/sets/polynomials: what floats lose is bounded, in exact arithmetic, and not by much more."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.polynomials import (
    HALF_ULP,
    NEAR,
    Enclosed,
    Truncated,
    lengths,
    multiply_rows,
    rounding,
)

KNOWN = Monomials(2, 2)


def drawn(rng, n, times=3, size=1.0, lost=0.0):
    scale = size * 10.0 ** rng.uniform(-3, 0, size=(n, times, KNOWN.size))
    return Truncated(KNOWN, rng.normal(size=scale.shape) * scale, np.full(n, lost))


def exact(values):
    return np.vectorize(Fraction, otypes=[object])(np.asarray(values, dtype=float))


def test_a_ball_is_within_what_its_float_may_be_off():
    rng = np.random.default_rng(0)
    with ctx.workprec(120):
        entries = [
            [arb(float(v)) / 3 + arb(0, float(r) if r < 1e-3 else 0.0) for v, r in pairs]
            for pairs in rng.uniform(size=(20, 5, 2)) * [1e3, 2e-3]
        ]
        found = Enclosed.of(arb_mat(entries))
        for row, mids, rads in zip(entries, found.mid, found.rad, strict=True):
            for ball, mid, rad in zip(row, mids, rads, strict=True):
                centre, radius = (Fraction(int(q.p), int(q.q)) for q in (x.fmpq() for x in (ball.mid(), ball.rad())))
                off = abs(centre - Fraction(float(mid))) + radius
                assert off <= Fraction(float(rad))
                assert Fraction(float(rad)) <= radius * (1 + Fraction(1, 10**9)) + Fraction(2.5e-16) * abs(centre)
        shaped = Enclosed.all([arb_mat(entries[:2]), arb_mat(entries[2:4])], (2, 2, 5))
        assert (shaped.mid[1, 0] == found.mid[2]).all() and (shaped.rad[1, 0] == found.rad[2]).all()
        assert not Enclosed.of(arb_mat([[0]])).rad.any()
        with pytest.raises(Unchecked):
            Enclosed.of(arb_mat([[arb(10) ** 400]]))
        with pytest.raises(Unchecked):
            Enclosed.of(arb_mat([[arb(0, 1) * arb(10) ** 400]]))


def test_sums_lose_no_more_than_they_say_and_say_little():
    rng = np.random.default_rng(1)
    a, b = drawn(rng, 200), drawn(rng, 200)
    factors = rng.normal(size=200)
    for found, truth, size in (
        (a + b, exact(a.coefficients) + exact(b.coefficients), a.size + b.size),
        (a.scaled(factors), exact(a.coefficients) * exact(factors)[:, None, None], np.abs(factors) * a.size),
    ):
        off = np.abs(truth - exact(found.coefficients)).sum(axis=(1, 2))
        assert (off <= exact(found.error)).all()
        assert (found.error <= 2e-15 * size).all()
    for number in (-1.0, 1.0 / 3.0, 1e6):
        found, truth = a.plus(number), exact(a.coefficients)
        truth[:, 0, 0] += Fraction(number)
        assert (np.abs(truth - exact(found.coefficients)).sum(axis=(1, 2)) <= exact(found.error)).all()
        assert (found.error <= 2e-15 * (a.size + abs(number))).all()


def test_a_product_bounds_what_it_drops_and_what_rounding_does():
    rng = np.random.default_rng(2)
    J, exponents = 3, KNOWN.exponents
    a, b = drawn(rng, 12), drawn(rng, 12)
    found = a * b
    left, right = exact(a.coefficients), exact(b.coefficients)
    kept, beyond = exact(np.zeros_like(a.coefficients)), exact(np.zeros(12))
    for s in range(J):
        for t in range(J):
            for i, e in enumerate(exponents):
                for j, f in enumerate(exponents):
                    term = left[:, s, i] * right[:, t, j]
                    both = tuple(x + y for x, y in zip(e, f, strict=True))
                    if s + t < J and both in KNOWN.number:
                        kept[:, s + t, KNOWN.number[both]] += term
                    else:
                        beyond += np.abs(term)
    off = np.abs(kept - exact(found.coefficients)).sum(axis=(1, 2))
    assert (off + beyond <= exact(found.error)).all()
    assert (exact(found.error) <= beyond * (1 + Fraction(1, 10**11)) + exact(3e-14 * a.size * b.size)).all()


def test_what_was_lost_before_is_carried_on():
    """For numbers the worst product is known: ``(|a| + l)(|b| + m)`` instead of ``|a| |b|``."""
    number = np.zeros((1, 1, KNOWN.size))
    number[0, 0, 0] = 1.0
    for lost, more in ((0.25, 0.0), (0.0, 0.5), (0.25, 0.5)):
        a, b = Truncated(KNOWN, 2.0 * number, np.array([lost])), Truncated(KNOWN, -3.0 * number, np.array([more]))
        assert (a * b).error[0] == pytest.approx((2.0 + lost) * (3.0 + more) - 6.0, rel=1e-9, abs=1e-12)
        assert (a * b).error[0] >= (2.0 + lost) * (3.0 + more) - 6.0
        assert (a + b).error[0] == pytest.approx(lost + more, abs=1e-12)
        assert (a + b).error[0] >= lost + more
        assert a.scaled(np.array([-4.0])).error[0] == pytest.approx(4.0 * lost, abs=2e-12)
        assert a.scaled(np.array([-4.0])).error[0] >= 4.0 * lost
        assert a.plus(5.0).error[0] == pytest.approx(lost, abs=1e-13)


def valued(coefficients, share, delta):
    """Polynomials ``(n, J, M, ...)`` at shares of a cell and parameters, ``(n, samples, ...)``."""
    times = np.vander(share, coefficients.shape[1], increasing=True)
    powers = np.prod(delta[:, None, :] ** np.array(KNOWN.exponents)[None], axis=2)
    return np.einsum("kt,km,ntm...->nk...", times, powers, coefficients)


@pytest.mark.parametrize("spread", [1e-3, 0.01, 0.04])
def test_a_polynomial_above_a_length_is_above_it_and_as_near_as_it_says(spread):
    rng = np.random.default_rng(3)
    parts = spread * rng.normal(size=(40, 3, KNOWN.size, 2)) / KNOWN.size
    parts[:, 0, 0] += rng.normal(size=(40, 2)) + 2.0
    found, lost, above = lengths(KNOWN, parts)
    share, delta = rng.uniform(size=300), rng.uniform(-1, 1, size=(300, 2))
    share[:2], delta[:40] = (0.0, 1.0), np.sign(delta[:40])
    truth = np.linalg.norm(valued(parts, share, delta), axis=2)
    value = valued(found, share, delta)
    assert np.isfinite(lost).all()
    assert (truth <= value + lost[:, None] + 1e-15).all()
    assert (value <= truth + (lost + above)[:, None] + 1e-14).all()
    # of fourth order in what the square differs from its middle by; of third what is dropped
    closer = parts.copy()
    closer[:, 1:] /= 2.0
    closer[:, :, 1:] /= np.where(np.arange(3) > 0, 1.0, 2.0)[None, :, None, None]
    if spread > 1e-3:
        _, less, nearer = lengths(KNOWN, closer)
        assert (nearer < above / 5.0).all() and (less < lost / 3.0).all()


def test_a_length_is_over_estimated_by_the_first_term_that_is_left_out_and_little_more():
    """``1 + x`` as the root of ``1 + e``, ``e = 2 x + x^2``: with all powers kept, what is left out is
    ``5/128 e^4 (1 + z)^(-7/2)`` for a ``z`` between 0 and ``e``."""
    known = Monomials(1, 8)
    for size in (0.01, 0.05, 0.15):
        parts = np.zeros((1, 1, known.size, 1))
        parts[0, 0, 0, 0], parts[0, 0, 1, 0] = 3.0, 3.0 * size
        found, lost, above = lengths(known, parts)
        delta = np.linspace(-1.0, 1.0, 201)
        over = np.polynomial.polynomial.polyval(delta, found[0, 0]) - 3.0 * (1.0 + size * delta)
        assert lost[0] < 1e-12
        assert over.min() >= -lost[0]
        assert over.max() <= above[0] + lost[0]
        e = 2.0 * size + size**2
        assert above[0] <= over.max() * (1.0 + size / 2.0) ** 4 / (1.0 - e) ** 3.5 * 1.7 + 1e-12
        assert above[0] == pytest.approx(3.0 * 5.0 / 128.0 * e**4 / (1.0 - e) ** 3.5, rel=1e-6)


def test_a_length_that_is_a_number_is_held_to_rounding():
    rng = np.random.default_rng(4)
    parts = np.zeros((500, 1, KNOWN.size, 3))
    parts[:, 0, 0] = rng.normal(size=(500, 3)) * 10.0 ** rng.uniform(-3, 3, size=(500, 1))
    found, lost, above = lengths(KNOWN, parts)
    squares = (exact(parts[:, 0, 0]) ** 2).sum(axis=1)
    upper = exact(found[:, 0, 0]) + exact(lost)
    assert (upper**2 >= squares).all()
    assert (lost <= 2e-14 * found[:, 0, 0]).all() and (above <= 1e-50 * found[:, 0, 0]).all()


def test_rounding_of_the_root_and_of_the_reciprocal_comes_on_top_of_what_products_lose():
    """The square is divided by a rounded number and the root multiplied by a rounded root: two units of rounding that
    no product of polynomials accounts for, with the final products some more."""
    rng = np.random.default_rng(5)
    parts = np.zeros((50, 1, KNOWN.size, 1))
    parts[:, 0, 0, 0] = rng.uniform(1, 9, size=50)
    _, lost, _ = lengths(KNOWN, parts)
    none = np.zeros(50)
    part = Truncated(KNOWN, parts[..., 0], none)
    square = Truncated(KNOWN, np.zeros_like(part.coefficients), none) + part * part
    middle = square.coefficients[:, 0, 0]
    e = square.scaled(1.0 / middle).plus(-1.0)
    inner = e * e.scaled(none + 1.0 / 16.0).plus(-1.0 / 8.0)
    products = (e * inner.plus(0.5)).plus(1.0).scaled(np.sqrt(middle)).error
    assert (lost >= products + 4.0 * HALF_ULP * np.sqrt(middle)).all()
    assert (lost <= products + 1e-14 * np.sqrt(middle)).all()


def test_a_length_that_may_vanish_has_no_polynomial():
    parts = np.zeros((5, 2, KNOWN.size, 1))
    parts[:, 0, 0, 0] = [0.0, 1.0, 1.0, np.nan, 1e200]
    parts[1, 1, 0, 0] = 2.0
    parts[2, 1, 0, 0] = 0.05
    found, lost, above = lengths(KNOWN, parts)
    assert np.isfinite(lost).tolist() == [False, False, True, False, False]
    assert np.isfinite(above).tolist() == [False, False, True, False, False]
    assert np.isfinite(found).all()
    assert 0.0 < NEAR < 1.0


def test_rounding_of_a_sum_is_what_higham_bounds_it_by():
    unit = 2.0**-53
    for terms in (1, 2, 8, 1000):
        assert rounding(terms) >= terms * unit / (1.0 - terms * unit)
        assert rounding(terms) <= 1.2 * (terms + 5) * unit


def test_an_exact_0_alone_has_no_radius_however_small_a_number_is() -> None:
    entries = [arb(0), arb(0, 1e-299), arb(3), arb(2) ** -1200, arb(0, 1) * arb(2) ** -1200]
    found = Enclosed.of(arb_mat(1, 5, entries))
    assert found.rad[0, 0] == 0.0
    assert (found.rad[0, 1:] > 0.0).all() and found.rad[0, 1] >= 1e-299
    for x, mid, rad in zip(entries, found.mid[0].tolist(), found.rad[0].tolist(), strict=True):
        assert abs(x - mid) <= arb(rad)


def test_products_of_many_terms_hold_the_truth_and_round_as_sums_of_sums() -> None:
    rng = np.random.default_rng(5)
    for d in (1, 31, 32, 33, 300):
        left, right = rng.normal(size=(3, d)), rng.normal(size=(2, d, 4))
        found = multiply_rows(Enclosed(left, 0.0 * left), Enclosed(right, 0.0 * right))
        for j, part in enumerate(right):
            exact = (arb_mat(left.tolist()) * arb_mat(part.tolist())).tolist()
            pairs = zip(found.mid[:, j].tolist(), exact, strict=True)
            off = [[abs(arb(m) - x) for m, x in zip(*pair, strict=True)] for pair in pairs]
            assert (np.array([[float(x.upper()) for x in row] for row in off]) <= found.rad[:, j]).all()
        assert (found.rad <= 6e-15 * np.einsum("kd,jdn->kjn", np.abs(left), np.abs(right))).all()


def test_sums_and_matrices_of_enclosed_arrays_hold_what_their_parts_do() -> None:
    one, other = (Enclosed(np.array([[0.1, -3.0]]), np.array([[1e-3, 0.5]])) for _ in range(2))
    total = (one + other).matrix.tolist()[0]
    for entry, low, high in zip(total, (0.198, -7.0), (0.202, -5.0), strict=True):
        assert entry.lower() <= low and high <= entry.upper() and entry.rad() <= 0.5001 * (high - low)
    third = Enclosed(np.array([1.0]), np.zeros(1)) + Enclosed(np.array([2.0**-54]), np.zeros(1))
    assert third.mid[0] + third.rad[0] >= 1.0 + 2.0**-52 / 4
    assert one[..., 1:].swapped(0, 1).mid.tolist() == [[-3.0]]
