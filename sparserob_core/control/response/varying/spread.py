"""The state of a system that changes with time as a polynomial in its parameters: how far it is expanded."""

from __future__ import annotations

from math import comb, factorial
from weakref import WeakKeyDictionary

import numpy as np

from sparserob_core.control.enclosures.dependence import Split, Spread
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.response.varying.expansion import balanced
from sparserob_core.errors import InputError

LEFT = ((1e-14, 64), (1e-12, 100), (1e-10, 140))
"""Of the state, what is beyond the degree is about, and with how many coefficients times states at most: the first that
is reached. A proof needs 1e-8, and norms are counted many times on the way; of twice as many numbers a run takes some
five times as long."""
MOST_ORDERS = 20  # the degree, at most: the coefficients are then as many for one parameter alone
LOOKS = 17  # times at which the coefficients of A are looked at; of an estimate, with which nothing is proven
_KNOWN: WeakKeyDictionary[VaryingSystem, tuple[Spread, VaryingSystem]] = WeakKeyDictionary()


def expanded(system: VaryingSystem) -> tuple[Spread, VaryingSystem]:
    """How the state of a system depends on its parameters, and the known system of all coefficients; raises
    `InputError` where too many were needed."""
    if system not in _KNOWN:
        spread = _spread(system)
        _KNOWN[system] = spread, system.superposed(spread)
    return _KNOWN[system]


def _spread(system: VaryingSystem) -> Spread:
    """About ``(int sum_b |A_b| dt)^n / n!`` is the coefficient of degree ``n``."""
    (centre, units), powers = system.deviations, system.powers
    assert powers is not None
    A = np.max([np.abs(np.asarray(one.A, dtype=float)) for one in system.at(centre).modes], axis=0)
    scale, pace = balanced(A, system.horizon), 0.0
    for begin, until, law in system.laws:
        sizes = []
        for time in np.linspace(begin, until, LOOKS).tolist():
            parts = Split.of(law.entry("A"), time, centre, units).parts
            every = [np.abs(table.astype(float)) for key, table in parts.items() if any(key)]
            sizes.append(sum(float((one * scale / scale[:, None]).sum(axis=1).max()) for one in every))
        pace += float(np.mean(sizes)) * (until - begin)
    nu, d = centre.size, system.states
    for left, most in LEFT:
        for degree in range(powers, MOST_ORDERS + 1):
            small = pace ** (degree + 1) / factorial(degree + 1) <= left
            if small and d * comb(nu + degree, nu) <= most:
                return Spread(d, TaylorSpace(nu, degree), centre, units, powers)
    raise InputError(
        path="system.parameters",
        expected="a box, beside the time t and in A, over which the state has an expansion of at most"
        f" {LEFT[-1][1]} numbers: fewer parameters, smaller intervals, or a shorter horizon",
        got=f"parameters that move the state by up to e^{pace:.2g}",
    )
