"""The state of a system that changes with time as a polynomial in its parameters: how far it is expanded, and on which
parts of their box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from math import comb
from typing import NamedTuple, final
from weakref import WeakKeyDictionary, ref

import numpy as np

from sparserob_core.control.enclosures.dependence import MOST_POWERS, Left, Split, Spread
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.phase import Phase, PhaseInUnits
from sparserob_core.control.problem.system import System
from sparserob_core.control.response.varying.discs import NAMES, Cauchy, beyond, cauchy
from sparserob_core.control.response.varying.expansion import balanced
from sparserob_core.control.sets.sets import Box
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
FAR = 600.0  # exponents of what is too far in any case, whose exponential is a number
MOST_PARTS = 64  # of the box: an expansion of each takes as long as one of the whole, and each is proven alone
_KNOWN: WeakKeyDictionary[Phase, dict[tuple[object, ...], Parts]] = WeakKeyDictionary()


@final
@dataclass(frozen=True, eq=False)
class Parts:
    """A box of parameters in parts, and how the state depends on the parameters of each: ``every`` of them, how, and
    the known system of all coefficients. ``edges``: where the parts of every parameter begin and end; the parts are
    all their products, those of the last parameter one after another. All have the same polynomials."""

    edges: tuple[Array, ...]
    every: tuple[tuple[Spread, System], ...]

    def of(self, parameters: Array) -> np.ndarray:
        """The part that each of ``parameters (k, nu)`` is in, ``(k,)``; at an edge any one that has it."""
        places = [
            np.clip(np.searchsorted(edges, p, side="right") - 1, 0, edges.size - 2)
            for edges, p in zip(self.edges, parameters.T, strict=True)
        ]
        return np.asarray(np.ravel_multi_index(places, [edges.size - 1 for edges in self.edges]))

    def holding(self, low: Array, high: Array) -> int | None:
        """The part that holds a cell ``[low, high]``, ``(nu,)`` each; ``None`` where none does."""
        part = int(self.of(((low + high) / 2)[None])[0])
        ends = self.ends(part)
        return part if (ends[0] <= low).all() and (high <= ends[1]).all() else None

    def ends(self, part: int) -> tuple[Array, Array]:
        """From where to where a part goes, ``(nu,)`` each."""
        places = np.unravel_index(part, [edges.size - 1 for edges in self.edges])
        both = [(edges[i], edges[i + 1]) for edges, i in zip(self.edges, places, strict=True)]
        return np.array([low for low, _ in both]), np.array([high for _, high in both])

    def cut(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Cells ``(k, 1 + nu)`` of times and parameters, cut where parts end."""
        if len(self.every) == 1:
            return lower, upper
        found = [lower[:0]], [upper[:0]]
        for part in range(len(self.every)):
            low, high = self.ends(part)
            a, b = lower.copy(), upper.copy()
            a[:, 1 : 1 + low.size] = np.maximum(a[:, 1 : 1 + low.size], low)
            b[:, 1 : 1 + low.size] = np.minimum(b[:, 1 : 1 + low.size], high)
            thick = ((a < b) | (lower == upper)).all(axis=1) & (a <= b).all(axis=1)
            found[0].append(a[thick])
            found[1].append(b[thick])
        return np.concatenate(found[0]), np.concatenate(found[1])


class Looks(NamedTuple):
    """How far parameters move the state of a system: about the integrals of the norms of all coefficients of ``A`` of
    the degrees 1, 2, ..., of which what is beyond a degree is about that of the exponential, ``paces``; what every
    parameter has in them, ``shares (nu,)``; units of the states, ``scale (d,)``; and of entries that are no
    polynomials, ``analytic``, what bounds the rest of their series."""

    paces: Array
    shares: Array
    scale: Array
    analytic: Cauchy | None


def expanded(system: System) -> Parts:
    """How the state of a system depends on its parameters: parts of their box, as many as take the least work; raises
    `InputError` where too many were needed."""
    first, *others = system.phases
    kept, box = _KNOWN.setdefault(first, {}), system.box
    key = system.horizon, box.lower.tobytes(), box.upper.tobytes(), *((phase.begin, ref(phase)) for phase in others)
    if key not in kept:
        kept[key] = _expanded(system) if system.stated is system else _in_units(system)
    return kept[key]


def _expanded(system: System) -> Parts:
    """`expanded` of a system in the units that it is stated in."""
    edges, looks, degree = _parted(system)
    every = []
    for part, look in zip(_boxes(system, edges), looks, strict=True):
        centre, units = part.deviations
        assert part.powers is not None
        left = None if look.analytic is None else look.analytic.left(degree)
        how = Spread(system.states, TaylorSpace(centre.size, degree), centre, units, part.powers, left)
        every.append((how, part.superposed(how)))
    return Parts(edges, tuple(every))


def _in_units(system: System) -> Parts:
    """`expanded` of one in its own units, which are powers of two: the same polynomials, in these units."""
    law = system.phases[0]
    assert isinstance(law, PhaseInUnits)
    time, units = law.clock, law.units[1:]
    known, every = expanded(system.stated), list[tuple[Spread, System]]()
    of = {name: law.factors[name] * np.ones(law._shape(name)) for name in NAMES if law.entry(name) is not None}
    for how, part in known.every:
        size, left = how.space.size, how.left
        if left is not None:
            left = Left(left.ends / time, left.sizes * np.abs(np.hstack(list(of.values()))))
        whole = [np.tile(of[name], (size, size if name == "A" else 1)) for name in ("A", "B", "E")]
        drift = np.tile(of["c"], (size, 1)) if "c" in of else 1.0
        scaled = part.in_units(whole[0], whole[1], whole[2], np.zeros(0), drift, time)
        every.append((replace(how, centre=how.centre / units, units=how.units / units, left=left), scaled))
    return Parts(tuple(edges / one for edges, one in zip(known.edges, units, strict=True)), tuple(every))


def _boxes(system: System, edges: tuple[Array, ...]) -> list[System]:
    """The system with its parameters in every part of their box."""
    ends = [list(pairwise(one.tolist())) for one in edges]
    corners = [np.array(one).T for one in product(*ends)]
    return [system] if len(corners) == 1 else [system.with_parameters(Box(low, high)) for low, high in corners]


def _parted(system: System) -> tuple[tuple[Array, ...], list[Looks], int]:
    """Where the parts of every parameter begin and end, how far they move the state, and the degree: of 1, 2, 4, ...
    parts, halved along the parameter that moves the state most, those that take the least work, which is about that of
    the square of how many numbers an expansion has."""
    box, powers, d = system.box, system.powers, system.states
    assert powers is not None
    nu, best, first = box.dimension, None, _looks(system)
    paces = first.paces / float(MOST_PARTS) ** np.arange(1, first.paces.size + 1)  # of the smallest parts there may be
    counts, hopeless = (
        np.ones(nu, dtype=int),
        _degree([first._replace(paces=paces, analytic=None)], nu, d, powers) is None,
    )
    while not hopeless and counts.prod() <= MOST_PARTS and (best is None or counts.prod() * d**2 < best[0]):
        ends = zip(box.lower.tolist(), box.upper.tolist(), counts.tolist(), strict=True)
        edges = tuple(_edges(*one) for one in ends)
        looks = [_looks(part) for part in _boxes(system, edges)] if counts.prod() > 1 else [first]
        degree = _degree(looks, nu, d, powers)
        if degree is not None:
            work = counts.prod() * (d * comb(nu + degree, nu)) ** 2
            if best is not None and work >= best[0]:
                break
            best = work, edges, looks, degree
        counts[int(np.max([one.shares for one in looks], axis=0).argmax())] *= 2
    if best is not None:
        return best[1:]
    raise InputError(
        path="system.parameters",
        expected="a box, beside the time t and in A, over which the state has an expansion of at most"
        f" {LEFT[-1][1]} numbers, in at most {MOST_PARTS} parts: fewer parameters, smaller intervals, or a shorter"
        " horizon",
        got=f"parameters that move the state by up to e^{first.paces.sum():.2g}"
        + ("" if first.analytic is None else ", and entries that are no polynomials in them"),
    )


def _edges(low: float, high: float, count: int) -> Array:
    """The ends of ``count`` equal parts of an interval."""
    found = np.linspace(low, high, count + 1)
    found[0], found[-1] = low, high
    return found


def _degree(looks: Sequence[Looks], nu: int, d: int, powers: int) -> int | None:
    """The degree of the expansion; ``None`` where it would have too many numbers. What is beyond grows as states do,
    and meets states that grew: by the exponential of the paces each. Of series of entries as many products are beyond
    as the degree is."""
    paces = np.max([one.paces for one in looks], axis=0)
    rest = tails(paces, MOST_ORDERS, FURTHER) * np.exp(min(2.0 * paces.sum(), FAR))
    analytic = [(one.analytic, one.scale) for one in looks if one.analytic is not None]
    for left, most in LEFT:
        for degree in range(max(1, powers), (MOST_TERMS if analytic else MOST_ORDERS) + 1):
            if rest[degree] > left or d * comb(nu + degree, nu) > most:
                continue
            if all((degree + 1) * entries.share(degree, scale) <= left for entries, scale in analytic):
                return degree
    return None


def _looks(system: System) -> Looks:
    """How far its parameters move the state of a system."""
    (centre, units), powers = system.deviations, system.powers
    assert powers is not None
    nu, d = centre.size, system.states
    A = np.max([np.abs(np.asarray(one.A, dtype=float)) for one in system.at(centre).modes], axis=0)
    orders = [n for n in range(MOST_TERMS + 1) if d * comb(nu + n, nu) <= LEFT[-1][1]]
    analytic = cauchy(system) if beyond(system, powers).any() else None
    most = MOST_POWERS if analytic is None else orders[-1]
    scale, paces, shares = balanced(A, system.horizon), np.zeros(1 + max(powers, most)), np.zeros(nu)
    for law in system.phases:
        begin, until = law.begin, law.until
        for time in np.linspace(begin, until, LOOKS).tolist():
            parts = Split.of(law.entry("A"), time, centre, units, most).parts
            for key, table in parts.items():
                size = float((np.abs(table.astype(float)) * scale / scale[:, None]).sum(axis=1).max())
                paces[sum(key)] += size * (until - begin) / LOOKS
                shares += np.array(key) * size * (until - begin) / LOOKS
            for name in () if analytic is None else ("B", "E", "c"):  # whose series must end too
                parts = {} if law.entry(name) is None else Split.of(law.entry(name), time, centre, units, most).parts
                sizes = {key: float(np.abs(table.astype(float)).max(initial=0.0)) for key, table in parts.items()}
                whole = max(sum(sizes.values()), np.finfo(float).tiny)
                shares += sum((np.array(key) * size / whole / LOOKS for key, size in sizes.items()), np.zeros(nu))
    return Looks(paces[1:], shares, scale, analytic)


def tails(paces: Array, degree: int, further: int) -> Array:
    """The sums ``(degree + 1,)`` of the coefficients of ``exp(sum_b paces[b - 1] z^b)`` beyond 0, 1, ..., ``degree``,
    as far as ``further`` ones."""
    found, count = [1.0], paces.size
    for n in range(1, degree + further + 1):
        found.append(sum((b * float(paces[b - 1]) * found[n - b] for b in range(1, min(n, count) + 1)), 0.0) / n)
    return np.cumsum(found[::-1])[::-1][1 : degree + 2]
