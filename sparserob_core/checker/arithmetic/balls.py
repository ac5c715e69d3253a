"""Between floats and balls, with the direction of rounding in the name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, fmpq


def ball(value: float) -> arb:
    """An exact number as a ball."""
    from flint import arb

    return arb(float(value))


def balls(vector: Sequence[float] | Array) -> list[arb]:
    """Exact numbers as balls."""
    from flint import arb

    return [arb(float(v)) for v in vector]


def largest(values: Iterable[arb]) -> arb:
    """The largest of some balls, at least one."""
    return reduce(lambda one, other: one.max(other), values)


def smallest(values: Iterable[arb]) -> arb:
    """The smallest of some balls, at least one."""
    return reduce(lambda one, other: one.min(other), values)


def rational(value: Fraction) -> arb:
    """A ball around a fraction."""
    from flint import arb, fmpq

    return arb(fmpq(value.numerator, value.denominator))


def above(ball: arb) -> float:
    """A float that is certainly not below a ball."""
    return float(np.nextafter(float(ball.upper()), np.inf))


def below(ball: arb) -> float:
    """A float that is certainly not above a ball; the ball itself where it is one."""
    return float(ball) if ball.is_exact() and float(ball) == ball else float(np.nextafter(float(ball.lower()), -np.inf))


def difference(a: float, b: float) -> tuple[float, float]:
    """``a - b`` exactly, as the nearest number and what is left of it (Knuth 1997, section 4.2.2, theorem B): equal
    pairs are equal differences."""
    nearest = a - b
    part = nearest - a
    return nearest, (a - (nearest - part)) - (b + part)


def spanning(rows: Sequence[Sequence[fmpq]]) -> list[list[fmpq]]:
    """Rows that span what some do, as many as are independent."""
    from flint import fmpq_mat

    if not rows:
        return []
    reduced, rank = fmpq_mat(rows).rref()
    table: list[list[fmpq]] = reduced.tolist()
    return table[:rank]
