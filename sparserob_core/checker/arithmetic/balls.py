"""Conversions between floats and balls, with the direction of rounding in the name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np
from flint import arb, fmpq, fmpq_mat

from sparserob_core.sip.convex_set import Array


def ball(value: float) -> arb:
    """Return an exact number as a ball."""
    return arb(float(value))


def balls(vector: Sequence[float] | Array) -> list[arb]:
    """Return exact numbers as balls."""
    return [arb(float(v)) for v in vector]


def largest(values: Iterable[arb]) -> arb:
    """Return the largest of some balls, at least one."""
    return reduce(lambda a, b: a.max(b), values)


def smallest(values: Iterable[arb]) -> arb:
    """Return the smallest of some balls, at least one."""
    return reduce(lambda a, b: a.min(b), values)


def rational(value: Fraction) -> arb:
    """Return a ball that contains a fraction."""
    return arb(fmpq(value.numerator, value.denominator))


def above(ball: arb) -> float:
    """Return a float that is certainly not below a ball."""
    return float(np.nextafter(float(ball.upper()), np.inf))


def below(ball: arb) -> float:
    """Return a float that is certainly not above a ball; the number itself where the ball is exact and a float."""
    return float(ball) if ball.is_exact() and float(ball) == ball else float(np.nextafter(float(ball.lower()), -np.inf))


def difference(a: Any, b: Any) -> tuple[Any, Any]:
    """Return ``a - b``, of floats or arrays, exactly: as the nearest floats and the remainders (Knuth 1997, section
    4.2.2, theorem B). Two differences are equal where the pairs are equal."""
    nearest = a - b
    negative_b = nearest - a
    return nearest, (a - (nearest - negative_b)) - (b + negative_b)


def rationals(rows: Iterable[Iterable[float | Fraction]]) -> fmpq_mat:
    """Return rows of exact numbers as a matrix of fractions."""
    return fmpq_mat([[fmpq(*x.as_integer_ratio()) for x in row] for row in rows])


def is_semidefinite(matrix: fmpq_mat) -> bool:
    """Return True where a matrix is symmetric and positive semidefinite, by elimination: no pivot is negative, and the
    row of a zero pivot is zero."""
    rows: list[list[fmpq]] = matrix.tolist()
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if pivot < 0 or (pivot == 0 and any(x != 0 for x in pivot_row[k:])):
            return False
        for row in rows[k + 1 :] if pivot != 0 else ():
            share = row[k] / pivot
            row[k:] = [a - share * b for a, b in zip(row[k:], pivot_row[k:], strict=True)]
    return bool(matrix == matrix.transpose())


def spanning(rows: Sequence[Sequence[fmpq]]) -> list[list[fmpq]]:
    """Return independent rows with the same span as the given rows."""
    if not rows:
        return []
    reduced, rank = fmpq_mat(rows).rref()
    table: list[list[fmpq]] = reduced.tolist()
    return table[:rank]
