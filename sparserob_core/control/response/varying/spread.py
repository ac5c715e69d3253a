"""The state of a system that changes with time as a polynomial in its parameters: how far it is expanded."""

from __future__ import annotations

from math import comb
from weakref import WeakKeyDictionary

import numpy as np

from sparserob_core.control.enclosures.dependence import MOST_POWERS, Split, Spread
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.response.varying.discs import beyond, cauchy
from sparserob_core.control.response.varying.expansion import balanced
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

LEFT = ((1e-14, 64), (1e-12, 100), (1e-10, 140))
"""Of the state, what is beyond the degree is about, and with how many coefficients times states at most: the first that
is reached. A proof needs 1e-8, and norms are counted many times on the way; of twice as many numbers a run takes some
five times as long."""
MOST_ORDERS = 60  # the degree, at most, of one state and one parameter: nearly as many numbers as `LEFT` allows first
MOST_TERMS = 30  # the degree where entries are no polynomials: what 40 of them leave less is below what is rounded
FURTHER = 40  # degrees beyond, of which what is left out is added up: of norms of a few the rest is far below `LEFT`
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
    """What is beyond a degree is about that of ``exp(sum_b z^b int |A_b| dt)``, with ``|A_b|`` the norms of all
    coefficients of a degree."""
    (centre, units), powers = system.deviations, system.powers
    assert powers is not None
    A = np.max([np.abs(np.asarray(one.A, dtype=float)) for one in system.at(centre).modes], axis=0)
    nu, d = centre.size, system.states
    analytic = cauchy(system) if beyond(system, powers).any() else None
    orders = [n for n in range(MOST_ORDERS + 1) if d * comb(nu + n, nu) <= LEFT[-1][1]]
    orders = orders if analytic is None else orders[: MOST_TERMS + 1]
    most = MOST_POWERS if analytic is None else orders[-1]
    scale, paces = balanced(A, system.horizon), np.zeros(1 + max(powers, most))
    for begin, until, law in system.laws:
        for time in np.linspace(begin, until, LOOKS).tolist():
            parts = Split.of(law.entry("A"), time, centre, units, most).parts
            for key, table in parts.items():
                size = float((np.abs(table.astype(float)) * scale / scale[:, None]).sum(axis=1).max())
                paces[sum(key)] += size * (until - begin) / LOOKS
    rest = tails(paces[1:], MOST_ORDERS, FURTHER)
    for left, numbers in LEFT:
        for degree in orders[powers:]:
            if rest[degree] > left or d * comb(nu + degree, nu) > numbers:
                continue
            if analytic is None:
                return Spread(d, TaylorSpace(nu, degree), centre, units, powers)
            if (degree + 1) * analytic.share(degree, scale) <= left:  # as many products are beyond the degree
                return Spread(d, TaylorSpace(nu, degree), centre, units, powers, analytic.left(degree))
    raise InputError(
        path="system.parameters",
        expected="a box, beside the time t and in A, over which the state has an expansion of at most"
        f" {LEFT[-1][1]} numbers: fewer parameters, smaller intervals, or a shorter horizon",
        got=f"parameters that move the state by up to e^{paces[1:].sum():.2g}"
        + (
            ""
            if analytic is None
            else f", and entries whose power series leave {analytic.share(orders[-1], scale):.2g}"
        ),
    )


def tails(paces: Array, degree: int, further: int) -> Array:
    """The sums ``(degree + 1,)`` of the coefficients of ``exp(sum_b paces[b - 1] z^b)`` beyond 0, 1, ..., ``degree``,
    as far as ``further`` ones."""
    found, count = [1.0], paces.size
    for n in range(1, degree + further + 1):
        found.append(sum((b * float(paces[b - 1]) * found[n - b] for b in range(1, min(n, count) + 1)), 0.0) / n)
    return np.cumsum(found[::-1])[::-1][1 : degree + 2]
