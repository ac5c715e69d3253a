"""Guards checker/sets/polynomials: what floats lose is bounded, in exact arithmetic, and not by much more."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.polynomials import (
    Enclosed,
    multiply_rows,
    rounding,
)


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
