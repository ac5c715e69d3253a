"""Units of the states, powers of two, in which the rates of a system are small. Remainders are bounded in these units;
any units would be right."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array

SWEEPS = 12  # of balancing
# A source below this share of what a state receives through other states does not count. With 1 a state's own source
# would be ignored, with 0 a negligible source may determine the unit.
FAINT = 1e-6
LEAST = 2.0**-900  # the smallest rate that takes part in the balancing; units are from 2^-500 to 2^500


def balanced(A: Array, horizon: float, speed: Array) -> Array:
    """Return units ``(d,)`` of the states, powers of two, in which each row of rates ``A (d, d)`` is about as large as
    its column (Osborne 1960).

    The sources, with rates ``speed (d,)``, take part as one more state, except where their effect is negligible beside
    that of other states. Where one state drives another but not the reverse, a small rate stands for the reverse: the
    one that makes the two as large as one becomes through the other within the ``horizon``."""
    rates = np.zeros((speed.size + 1, speed.size + 1))
    rates[:-1, :-1], rates[:-1, -1] = np.abs(A), speed
    np.fill_diagonal(rates, 0.0)
    effects = term = speed
    with np.errstate(over="ignore", invalid="ignore"):
        for order in range(1, speed.size):
            term = horizon / order * (rates[:-1, :-1] @ term)
            effects = effects + term
        rates[:-1, -1] = np.where(speed < FAINT * effects, 0.0, speed)
    rates[rates < LEAST] = 0.0  # outward rounding makes such rates of zeros; they have no reciprocal
    divisors = np.where(rates > 0.0, rates, np.inf)
    rates = np.maximum(rates, (1.0 / horizon / horizon / divisors).T)
    exponents = np.zeros(speed.size + 1)
    for _ in range(SWEEPS):
        for i in range(exponents.size):
            scaled = np.exp2(exponents)
            row, column = (rates[i] * scaled).max() / scaled[i], (rates[:, i] / scaled).max() * scaled[i]
            if row > 0.0 and column > 0.0:
                exponents[i] += (np.log2(row) - np.log2(column)) / 2  # the quotient may overflow
    return np.asarray(np.exp2(np.clip(np.round(exponents[:-1] - exponents[-1]), -500, 500)), dtype=float)


def pace(rates: Array, units: Array) -> float:
    """Return the largest row sum of nonnegative ``rates (d, d)`` between states in these ``units (d,)``."""
    return float((rates * units / units[:, None]).sum(axis=1).max(initial=0.0))
