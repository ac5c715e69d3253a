"""Units of the states, powers of two, in which a system is small: what is left of an expansion is bounded in them. Any
would be right."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

SWEEPS = 12  # of balancing
FAINT = 1e-6  # with 1 a state's own source would be overlooked beside others, with 0 its unit may be that of a speck
LEAST = 2.0**-900  # rate that takes part in it; units end at 2^-500


def balanced(A: Array, horizon: float, speed: Array) -> Array:
    """Units ``(d,)`` of the states, powers of two, in which rows and columns of ``A`` are about as large as each other
    (Osborne 1960).

    The sources take part as one more state, and where one state drives another but not the reverse, a small number
    stands for the reverse: what makes the two of the size that one reaches through the other within the horizon. A
    source that moves a state by next to nothing of what it is moved by through others does not count.
    """
    rates = np.zeros((speed.size + 1, speed.size + 1))
    rates[:-1, :-1], rates[:-1, -1] = np.abs(A), speed
    np.fill_diagonal(rates, 0.0)
    through = reached = speed
    with np.errstate(over="ignore", invalid="ignore"):
        for turn in range(1, speed.size):
            reached = horizon / turn * (rates[:-1, :-1] @ reached)
            through = through + reached
        rates[:-1, -1] = np.where(speed < FAINT * through, 0.0, speed)
    rates[rates < LEAST] = 0.0  # such are what outward rounding makes of no drive at all; they have no reciprocal
    driven = np.where(rates > 0.0, rates, np.inf)
    rates = np.maximum(rates, (1.0 / horizon / horizon / driven).T)
    exponents = np.zeros(speed.size + 1)
    for _ in range(SWEEPS):
        for i in range(exponents.size):
            scaled = np.exp2(exponents)
            row, column = (rates[i] * scaled).max() / scaled[i], (rates[:, i] / scaled).max() * scaled[i]
            if row > 0.0 and column > 0.0:
                exponents[i] += (np.log2(row) - np.log2(column)) / 2  # apart: their quotient may overflow
    return np.asarray(np.exp2(np.clip(np.round(exponents[:-1] - exponents[-1]), -500, 500)), dtype=float)


def pace(rates: Array, units: Array) -> float:
    """The largest sum of a row of ``rates (d, d)``, none of them negative, between states in these units."""
    return float((rates * units / units[:, None]).sum(axis=1).max(initial=0.0))


def scaled(matrix: arb_mat, rows: Array, columns: Array) -> arb_mat:
    """A ball matrix with its rows and its columns multiplied by powers of two, which is exact."""
    factors = list(map(float, columns))
    return stacked(
        [
            [x * row * factor for x, factor in zip(line, factors, strict=True)]
            for line, row in zip(matrix.tolist(), map(float, rows), strict=True)
        ]
    )
