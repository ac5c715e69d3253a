"""Guards control/enclosures/double_length: sums of two floats are the exact product and exponential to twice the
digits, and long exponentials are as near to the truth as one rounding."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from sparserob_core.control.enclosures.double_length import flows, product
from sparserob_core.control.enclosures.flows import DoublingExponentials

Exact = list[list[Fraction]]


def exact(A: np.ndarray) -> Exact:
    return [[Fraction(x) for x in row] for row in A.tolist()]


def times(A: Exact, B: Exact) -> Exact:
    columns = list(zip(*B, strict=True))
    return [[sum((a * b for a, b in zip(row, one, strict=True)), Fraction(0)) for one in columns] for row in A]


def added(A: Exact, B: Exact) -> Exact:
    return [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(A, B, strict=True)]


def scaled(A: Exact, by: Fraction) -> Exact:
    return [[by * a for a in row] for row in A]


def exponential(A: Exact, terms: int = 30) -> tuple[Exact, Exact]:
    """``e^A`` and ``int_0^1 e^{A s} ds`` of a small ``A``, in fractions."""
    term = [[Fraction(int(i == j)) for j in range(len(A))] for i in range(len(A))]
    flow, driven = term, term
    for order in range(1, terms):
        term = scaled(times(term, A), Fraction(1, order))
        flow, driven = added(flow, term), added(driven, scaled(term, Fraction(1, order + 1)))
    return flow, driven


def off(truth: Exact, *parts: np.ndarray) -> float:
    """By how much a sum of floats is off at most, of the largest entry."""
    rest = truth
    for part in parts:
        rest = added(rest, exact(-part))
    return float(max(abs(x) for row in rest for x in row) / max(abs(x) for row in truth for x in row))


@pytest.mark.parametrize("d", [1, 2, 5, 9])
def test_a_product_of_sums_of_two_floats_has_twice_the_digits(d: int) -> None:
    rng = np.random.default_rng(d)
    one, other = rng.normal(size=(2, d, d)) * 10.0 ** rng.integers(-3, 4, (2, d, 1))
    low, lower = 1e-17 * rng.normal(size=(2, d, d))
    truth = times(added(exact(one), exact(low)), added(exact(other), exact(lower)))
    hi, lo = product(one, low, other, lower)
    assert off(truth, hi, lo) <= 1e-22
    assert (hi + lo == hi).all()
    hi, lo = product(one, None, other, None)
    assert off(times(exact(one), exact(other)), hi, lo) <= 1e-22


@pytest.mark.parametrize("d", [1, 4, 7])
def test_the_exponential_of_a_small_matrix_has_twice_the_digits_and_its_integral_those_of_a_float(d: int) -> None:
    A = np.random.default_rng(d).normal(size=(d, d))
    A /= np.abs(A).sum(axis=0).max()
    flow, driven = exponential(exact(A))
    hi, lo, integral = flows(A)
    assert off(flow, hi, lo) <= 1e-21
    assert off(driven, integral) <= 2e-16


def test_long_exponentials_are_rounded_once() -> None:
    """Squares of floats would be off by a rounding for every doubling of the time, twice as much each time: 1e-14."""
    A = np.random.default_rng(3).normal(size=(5, 5))
    exponentials, doublings = DoublingExponentials(A), 7
    flow, driven = exponential(scaled(exact(exponentials._scaled_matrix), Fraction(exponentials.step)))
    driven = scaled(driven, Fraction(exponentials.step))
    for _ in range(doublings):
        driven, flow = added(driven, times(flow, driven)), times(flow, flow)
        digits = 2**300  # of fractions that would else double their length each time
        flow, driven = ([[Fraction(round(x * digits), digits) for x in row] for row in part] for part in (flow, driven))
    known = exponentials._compute_transitions(doublings + 1)[-1]
    assert off(flow, known[0]) <= 2e-16
    assert off(driven, known[1]) <= 2e-15


def test_what_is_too_large_for_twice_the_digits_is_the_product_of_floats() -> None:
    large = np.array([[1e200, 0.0], [0.0, 1.0]])
    hi, lo = product(large, None, np.eye(2), None)
    assert (hi == large).all() and not lo.any()
