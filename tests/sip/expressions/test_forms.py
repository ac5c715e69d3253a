"""Guards sip/expressions/forms: affine forms and convex costs are what numpy computes at every decision, column by
column."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.forms import AffineForm, ConvexCost, add_columns, join_columns, take_columns

RNG = np.random.default_rng(0)
X = RNG.normal(size=6)
NUMBERS = RNG.normal(size=(1, 3))
ONE = np.array([[2.5]])


def forms(columns: int) -> AffineForm:
    """Return forms of several terms each, of which some entries occur twice."""
    owner = np.repeat(np.arange(columns), 4)
    return AffineForm(
        RNG.normal(size=(1, columns)), owner, RNG.integers(0, 6, owner.size), RNG.normal(size=(1, owner.size))
    )


A, B, C = forms(3), forms(3), forms(1)
a, b, c = A.evaluate(X), B.evaluate(X), C.evaluate(X)


def test_entries_are_themselves() -> None:
    assert AffineForm.variables(np.array([4, 1])).evaluate(X).tolist() == [[X[4], X[1]]]
    assert AffineForm.of(NUMBERS).evaluate(X) == pytest.approx(NUMBERS)


THREE, ZERO = np.array([[3.0]]), np.array([[0.0]])  # numbers of a text are arrays of one column
OPERATIONS: dict[str, Callable[..., object]] = {
    "sums": lambda p, q, r: p + q - r,
    "with numbers": lambda p, q, r: THREE - p + NUMBERS * q - ONE,
    "quotients": lambda p, q, r: p / NUMBERS - r / ONE + q / THREE,
    "negatives": lambda p, q, r: -p - (-r),
    "one beside many": lambda p, q, r: r * NUMBERS + r + p,
    "nothing": lambda p, q, r: ZERO * p + r - r,
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_arithmetic_of_forms_is_that_of_their_values(name: str) -> None:
    operation = OPERATIONS[name]
    assert operation(A, B, C).evaluate(X) == pytest.approx(operation(a, b, c), rel=1e-13, abs=1e-13)


def test_columns_are_taken_joined_and_added() -> None:
    columns, groups = np.array([2, 0, 2]), np.array([1, 0, 1])
    assert take_columns(A, columns).evaluate(X) == pytest.approx(a[:, columns])
    assert take_columns(C, np.zeros(3, dtype=int)).evaluate(X) == pytest.approx(np.repeat(c, 3, axis=1))
    sums = np.array([[a[0, 1], a[0, 0] + a[0, 2], 0.0]])
    assert add_columns(A, groups, 3).evaluate(X) == pytest.approx(sums)
    assert add_columns(a, groups, 3) == pytest.approx(sums)
    assert join_columns([np.ones((1, 2)), np.zeros((4, 1))]).shape == (4, 3)


def value_of(cost: ConvexCost) -> np.ndarray:
    total = np.broadcast_to(cost.affine.evaluate(X), (1, cost.shape[1])).copy()
    for block in cost.products:
        values = block.weight * block.left.evaluate(X)[0] * block.right.evaluate(X)[0]
        np.add.at(total[0], block.owner, values)
    for block in cost.absolutes:
        np.add.at(total[0], block.owner, block.weight * np.abs(block.form.evaluate(X)[0]))
    return total


TWO = np.array([[2.0]])
COSTS: dict[str, Callable[..., object]] = {
    "squares": lambda p, q, r: p**TWO,
    "products": lambda p, q, r: p * q - r * r,
    "a product with one": lambda p, q, r: p * r + r * q,
    "absolute values": lambda p, q, r: abs(p) + abs(r) - q,
    "scaled": lambda p, q, r: NUMBERS * p**TWO + abs(r) * NUMBERS - (r * r) / NUMBERS,
    "negative": lambda p, q, r: -(p**TWO) - (abs(q) - r),
    "one beside many": lambda p, q, r: r**TWO + abs(p) + abs(r) + NUMBERS,
}


@pytest.mark.parametrize("name", COSTS)
def test_costs_are_what_their_values_make(name: str) -> None:
    assert value_of(COSTS[name](A, B, C)) == pytest.approx(COSTS[name](a, b, c), rel=1e-13, abs=1e-13)


def test_columns_of_costs_are_added() -> None:
    cost, value = A**TWO + abs(B), a**2 + np.abs(b)
    groups = np.array([1, 0, 1])
    assert value_of(cost.add_columns(groups, 2)) == pytest.approx(np.array([[value[0, 1], value[0, 0] + value[0, 2]]]))
    single = (C**TWO + abs(C))[:, np.zeros(4, dtype=int)]
    assert value_of(single) == pytest.approx(np.repeat(c**2 + np.abs(c), 4, axis=1))
    none = (C**TWO)[:, np.zeros(0, dtype=int)].add_columns(np.zeros(0, dtype=int), 2)
    assert value_of(none).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize(
    "refused",
    [
        lambda: np.sin(A),
        lambda: np.exp(abs(A)),
        lambda: A**A,
        lambda: A ** np.array([[3.0]]),
        lambda: ONE**A,
        lambda: ONE / A,
        lambda: A / A,
        lambda: A * B * C,
        lambda: abs(A) * B,
        lambda: abs(abs(A)),
        lambda: abs(A) ** TWO,
        lambda: ONE / abs(A),
        lambda: A / abs(B),
    ],
)
def test_what_is_neither_affine_nor_a_product_of_two_is_refused(refused: Callable[[], object]) -> None:
    with pytest.raises(InputError, match="decision"):
        refused()
