"""Guards checker/reach/states: products of polynomials of matrices in the parameters hold the exact ones, whatever the
numbers are within their radii, and are not much wider than these; nothing is known where a radius has no bound."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.reach.states import ring
from sparserob_core.checker.sets.polynomials import Enclosed


def exact(values: np.ndarray) -> np.ndarray:
    return np.vectorize(Fraction, otypes=[object])(values)


def value(monomials: Monomials, parts: np.ndarray, at: tuple[Fraction, ...]) -> np.ndarray:
    """A polynomial of matrices ``(M, rows, columns)`` at one point."""
    powers = [np.prod([x**n for x, n in zip(at, e, strict=True)], initial=Fraction(1)) for e in monomials.exponents]
    return sum(power * part for power, part in zip(powers, parts, strict=True))


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 4), (2, 3), (3, 1)])
@pytest.mark.parametrize("wide", [0.0, 1e-3])
def test_products_hold_those_of_all_numbers_within_the_radii(count: int, degree: int, wide: float) -> None:
    rng, monomials = np.random.default_rng(count), Monomials(count, degree)
    shapes = (2, monomials.size, 2, 3), (monomials.size, 3, 2)
    left, right = (Enclosed(rng.normal(size=shape), wide * rng.random(shape)) for shape in shapes)
    found = ring(monomials, left, right)
    assert found.mid.shape == (2, monomials.size, 2, 2)
    for _ in range(4):
        # each number at an end of its interval, or in the middle; parameters at the ends of theirs, too
        ours, theirs = (exact(e.mid) + exact(e.rad) * exact(rng.integers(-1, 2, e.mid.shape)) for e in (left, right))
        at = tuple(map(Fraction, rng.choice([-1.0, -0.375, 0.5, 1.0], size=count)))
        for batch in range(2):
            both = value(monomials, ours[batch], at) @ value(monomials, theirs, at)
            off = np.abs(both - value(monomials, exact(found.mid[batch]), at))
            assert (off <= value(monomials, exact(found.rad[batch]), tuple(map(abs, at)))).all()
    beyond = np.zeros(found.rad.shape[-2:])
    for i, j in product(range(monomials.size), repeat=2):
        if monomials.degrees[i] + monomials.degrees[j] > degree:
            beyond += np.abs(left.mid[:, i]).max(axis=0) @ np.abs(right.mid[j])
    assert (found.rad[:, 0] <= 1.02 * beyond + 40.0 * wide * monomials.size + 1e-12).all()


def test_what_times_no_bound_has_none() -> None:
    monomials = Monomials(1, 2)
    left = Enclosed(np.ones((1, 3, 1, 1)), np.zeros((1, 3, 1, 1)))
    right = Enclosed(np.ones((3, 1, 1)), np.array([np.inf, 0.0, 0.0])[:, None, None])
    assert (ring(monomials, left, right).rad == np.inf).all()
