"""The least share of time that an admissible control must act, in ball arithmetic.

An entry ``u_i`` of a control with values in ``[low_i, high_i]`` satisfies
``max(u_i, 0) / high_i + max(-u_i, 0) / |low_i| <= [u_i != 0]``, or counts always where 0 is outside. So the minimum of
that cost over the admissible controls, bounded by weak duality, is below the weighted time that any of them acts.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.duality import Row
from sparserob_core.checker.sets.known import known

if TYPE_CHECKING:
    from flint import arb

ROUNDED = 1e-12  # of the terms of which a value of the control is a sum: that much counts as 0
EQUAL = 1e-12  # counts that differ by no more are equal
NEARLY = 1e-6  # of one count, by which a whole number of them may be missed

Rows = list[tuple[float, Row]]


def acted(case: Case) -> float:
    """The share of time, weighted over the channels, that the certificate's control acts."""
    values = np.asarray(case.control.values, dtype=float)
    acts = np.abs(case.theta @ values) > ROUNDED * (np.abs(case.theta) @ np.abs(values))
    counts = _counts(case)
    return float(counts[acts].sum() / counts.sum())


def shared(case: Case, rows: Rows, pieces: Any) -> tuple[Rows, Any]:
    """Multipliers of the cost, as multipliers of the count: divided by what the largest value of a channel costs, which
    is best where all have the same. Any factor that is not negative proves something."""
    most = max((max(float(abs(low).mid()), float(abs(high).mid())) for low, high in _ranges(case)), default=1.0)
    most = most * case.problem.cost.l1 or 1.0
    rest = pieces if pieces is None else (np.asarray(pieces, dtype=float) / most).tolist()
    return [(y / most, row) for y, row in rows], rest


def least(case: Case, rows: Rows, pieces: Sequence[Sequence[float]] | None) -> float:
    """The share below which no admissible control acts, by these multipliers; a whole number of pieces where all count
    the same."""
    from flint import arb

    total, slopes = case.duality.summed(rows, pieces)
    ranges = _ranges(case)
    counts = [[arb(float(c)) * length for c in np.asarray(case.problem.weights)] for length in _lengths(case)]
    for count, slope in zip(counts, slopes, strict=True):
        case.clock.check()
        total = total + _least(case, ranges, count, slope)
    table = _counts(case)
    bound = float(np.nextafter(float(total.lower()), -np.inf))
    if np.ptp(table) <= EQUAL * table.max():
        one = float(table.mean())
        return float(min(table.size, max(0.0, np.ceil(bound / one - NEARLY))) / table.size)
    return max(0.0, bound / float(table.sum()))


def _least(case: Case, ranges: list[tuple[arb, arb]], count: list[arb], slope: list[arb]) -> arb:
    """At most the minimum over the controls' set of what one piece counts and the slopes add."""
    from flint import arb

    ups, downs, certain = [], [], arb(0)
    for (low, high), one in zip(ranges, count, strict=True):
        always = low > 0 or high < 0
        certain = certain + (one if always else arb(0))
        up = arb(0) if always or not high > 0 else one / high
        down = arb(0) if always or not low < 0 else one / -low
        ups.append(up if high > 0 else down)
        downs.append(down if low < 0 else up)
    return certain + known(case.problem.control).least(ups, downs, slope)


def _ranges(case: Case) -> list[tuple[arb, arb]]:
    """The least and the largest value of every channel."""
    from flint import arb

    found, m, shape = [], case.problem.system.controls, known(case.problem.control)
    for i in range(m):
        axis = [arb(float(i == j)) for j in range(m)]
        found.append((-shape.support([-a for a in axis]), shape.support(axis)))
    return found


def _lengths(case: Case) -> list[arb]:
    from flint import arb

    breaks = case.control.breakpoints
    return [arb(float(b)) - arb(float(a)) for a, b in pairwise(breaks)]


def _counts(case: Case) -> np.ndarray:
    """What every piece of every channel counts, ``(m, K)``."""
    return np.asarray(np.outer(np.asarray(case.problem.weights, dtype=float), np.diff(case.control.breakpoints)))
