"""The law of a system that changes with time as a polynomial in its parameters: how far it is expanded, and on which
parts of their box. States are expanded on cells of these, each by itself (`Expansion.on_cell`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from math import comb
from typing import final
from weakref import WeakKeyDictionary, ref

import numpy as np

from sparserob_core.control.enclosures.dependence import Left, Split, Spread
from sparserob_core.control.enclosures.taylor import taylor_space
from sparserob_core.control.problem.phase import Phase, PhaseInUnits
from sparserob_core.control.problem.system import System
from sparserob_core.control.response.varying.discs import NAMES, Cauchy, beyond, cauchy
from sparserob_core.control.response.varying.expansion import Expansion, balanced
from sparserob_core.control.sets.sets import Box
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array

LEFT = (1e-14, 1e-12, 1e-10)
"""Of the state, what is beyond the degree of the law is about: the first that is reached. A proof needs 1e-8."""
NUMBERS = 400  # coefficients times states of a law; twice as many are matrices of 5 MB on each of its segments
MOST_TERMS = 30  # the degree where entries are no polynomials: what 40 of them leave less is below what is rounded
LOOKS = 17  # times at which coefficients are looked at; nothing is proven with them
DEGREE = 4  # of the coefficients that are looked at then
MOST_PARTS = 64  # of the box: each is proven alone
FAR = 700.0  # exponent by which parameters move the state, whose exponential is still a number
_KNOWN: WeakKeyDictionary[Phase, dict[tuple[object, ...], Parts]] = WeakKeyDictionary()


@final
@dataclass(frozen=True, eq=False)
class Parts:
    """A box of parameters in parts, and how the law depends on the parameters of each: ``every`` of them, how, and
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

    @cached_property
    def expansions(self) -> tuple[Expansion, ...]:
        """The law on each part, as polynomials in time and parameters."""
        return tuple(Expansion.of(system) for _, system in self.every)

    def on_cell(self, low: Array, high: Array) -> Expansion:
        """Return the law of all coefficients of the state on a cell ``[low, high]`` of parameters, ``(nu,)`` each.

        Raises `NotEnclosable` where the cell lies in several parts.
        """
        part = self.holding(low, high)
        if part is None:
            raise NotEnclosable("a cell of parameters lies in two parts of their box")
        return self.expansions[part].on_cell(self.every[part][0], low, high)

    def at_point(self, parameter: Array) -> Expansion:
        """Return the known law at a parameter ``(nu,)``."""
        part = int(self.of(parameter[None])[0])
        return self.expansions[part].at_point(self.every[part][0], parameter)

    def over(self, starts: Array, stops: Array, points: Array) -> tuple[Array, Array]:
        """Return what intervals make of the state and of inputs at every one of several parameters.

        Parameters
        ----------
        starts, stops : Array
            Times ``(k,)``.
        points : Array
            Parameters ``(v, nu)``.

        Returns
        -------
        Array, Array
            The transitions ``(v, k, d, d)``; and what inputs that stay the same bring, those of the disturbance after
            the others, ``(v, k, d, m + mw)``. Nothing is proven by them.
        """
        found = [(here, of.at_parameters(starts, stops, powers[:, None])) for here, of, powers in self._apart(points)]
        state, inputs = _joined_parts(found)
        return state, inputs

    def along(self, starts: Array, stops: Array, parameters: Array) -> tuple[Array, Array]:
        """`over` of intervals each at its own of the ``parameters (k, nu)``, ``(k, d, d)`` and ``(k, d, m + mw)``."""
        found = []
        for here, of, powers in self._apart(parameters):
            both = of.at_parameters(starts[here], stops[here], powers[None])
            found.append((here, (both[0][0], both[1][0])))
        state, inputs = _joined_parts(found)
        return state, inputs

    def entries(self, times: Array, parameters: Array) -> tuple[Array, Array]:
        """Return ``A (k, d, d)`` and ``[B E] (k, d, m + mw)`` at times ``(k,)`` and ``parameters (k, nu)``; nothing is
        proven by them."""
        found, d = [], self.every[0][0].d
        for here, of, powers in self._apart(parameters):
            both = (one.reshape(here.size, -1, d, one.shape[2]) for one in of.at(times[here]))
            A, inputs = (np.einsum("ka,kaij->kij", powers, one) for one in both)
            found.append((here, (A, inputs)))
        A, inputs = _joined_parts(found)
        return A, inputs

    def averages(self, breaks: Array, points: Array) -> Array:
        """About what ``A`` is between ``breaks (L + 1,)`` at parameters ``(v, nu)``, ``(v, L, d, d)``."""
        d, found = self.every[0][0].d, []
        for here, of, powers in self._apart(points):
            first = of.average(breaks).reshape(breaks.size - 1, -1, d, d)
            found.append((here, (np.einsum("va,kaij->vkij", powers, first),)))
        return _joined_parts(found)[0]

    def left_out(self, part: int, begun: Array, inputs: Array, growth: float) -> Array:
        """Return what the law leaves out of any state at any parameter of a part, ``(d,)``, at most.

        Parameters
        ----------
        part : int
            The part of the parameters.
        begun, inputs : Array
            How large the initial state ``(d,)`` and the inputs ``(m + mw,)`` are at most.
        growth : float
            How far states grow between two times at most, in the units of the part.
        """
        how, law = self.every[part][0], self.expansions[part]
        left, d = how.left, how.d
        assert left is not None
        units, pushes = law.units[:d], law.largest_inputs(how) @ inputs / law.units[:d]
        state = growth * (float((begun / units).max()) + float(np.diff(law.ends) @ pushes.max(axis=1)))
        A = (left.sizes[:, :, :d] * units).sum(axis=2) / units
        entered = left.sizes[:, :, d:] @ inputs / units
        rate = state * A.max(axis=1) + entered.max(axis=1)
        return np.asarray(growth * float(np.diff(left.ends) @ rate) * units * (1.0 + 1e-9))

    def _apart(self, points: Array) -> Iterator[tuple[np.ndarray, Expansion, Array]]:
        """Of parameters ``(v, nu)`` the numbers of those in every part, the law there, and their monomials."""
        which = self.of(points)
        for part in np.unique(which).tolist():
            here, how = np.flatnonzero(which == part), self.every[part][0]
            yield here, self.expansions[part], how.space.monomials(how.shares(points[here]))


def _joined_parts(found: Sequence[tuple[np.ndarray, Sequence[Array]]]) -> list[Array]:
    """Tables that were made of some of all indices each, ``(numbers (k,), tables)``, as those of all of them."""
    order = np.argsort(np.concatenate([numbers for numbers, _ in found]))
    return [np.concatenate(one)[order] for one in zip(*(tables for _, tables in found), strict=True)]


def law_of(system: System) -> Parts:
    """Return how the law of a system depends on its parameters, on parts of their box.

    Of entries that are polynomials there is one part, and nothing is left out. Others are power series, and parts are
    as small as these need to be. Raises `InputError` where that takes too many parts.
    """
    first, *others = system.phases
    kept, box = _KNOWN.setdefault(first, {}), system.box
    key = system.horizon, box.lower.tobytes(), box.upper.tobytes(), *((phase.begin, ref(phase)) for phase in others)
    if key not in kept:
        kept[key] = _made(system) if system.stated is system else _in_units(system)
    return kept[key]


def _made(system: System) -> Parts:
    """`law_of` a system in the units that it is stated in."""
    edges, looks, degree = _parted(system)
    every = []
    for part, look in zip(_boxes(system, edges), looks, strict=True):
        centre, units = part.deviations
        left = None if look is None else look.left(degree)
        how = Spread(system.states, taylor_space(centre.size, degree), centre, units, left)
        every.append((how, part.superposed(how)))
    return Parts(edges, tuple(every))


def _in_units(system: System) -> Parts:
    """`law_of` a system in its own units, which are powers of two: the same polynomials, in these units."""
    law = system.phases[0]
    assert isinstance(law, PhaseInUnits)
    time, units = law.clock, law.units[1:]
    known, every = law_of(system.stated), list[tuple[Spread, System]]()
    of = {name: law.factors[name] * np.ones(law._shape(name)) for name in NAMES if law.entry(name) is not None}
    for how, part in known.every:
        size, left = how.space.size, how.left
        if left is not None:
            left = Left(left.ends / time, left.sizes * np.abs(np.hstack(list(of.values()))))
        whole = [np.tile(of[name], (size, size if name == "A" else 1)) for name in ("A", "B", "E")]
        drift = np.tile(of["c"], (size, 1)) if "c" in of else 1.0
        scaled = part.in_units(whole[0], whole[1], whole[2], np.zeros(0), drift, time)
        every.append((replace(how, centre=how.centre / units, units=how.units / units, left=left), scaled))
    edges = tuple(ends / one for ends, one in zip(known.edges, units, strict=True))
    return Parts(edges, tuple(every))


def _boxes(system: System, edges: tuple[Array, ...]) -> list[System]:
    """The system with its parameters in every part of their box."""
    ends = [list(pairwise(one.tolist())) for one in edges]
    corners = [np.array(one).T for one in product(*ends)]
    return [system] if len(corners) == 1 else [system.with_parameters(Box(low, high)) for low, high in corners]


def _parted(system: System) -> tuple[tuple[Array, ...], list[Cauchy | None], int]:
    """Where the parts of every parameter begin and end, what bounds the rest of the series of their entries, and the
    degree of these: of 1, 2, 4, ... parts, halved along the parameter in which that leaves least."""
    box, powers, d = system.box, system.powers, system.states
    assert powers is not None
    nu, counts, lowest = box.dimension, np.ones(box.dimension, dtype=int), max(1, powers)
    scale = _scale(system)
    far = _exponent(system, scale)
    if far > FAR:
        raise InputError(
            path="system.parameters",
            expected="a box, beside the time t and in A, over which the state has an expansion in double precision:"
            " smaller intervals, or a shorter horizon",
            got=f"parameters that move the state by up to e^{far:.2g}",
        )
    degrees = [n for n in range(lowest, MOST_TERMS + 1) if d * comb(nu + n, nu) <= NUMBERS]
    while degrees and counts.prod() <= MOST_PARTS:
        edges, looks = _looked(system, counts)
        for left, degree in product(LEFT, degrees):
            if all(_share(one, degree, scale) <= left for one in looks):
                return edges, looks, degree
        finer = [counts * (1 + one) for one in np.eye(nu, dtype=int)]
        counts = min(finer, key=lambda one: max(_share(look, degrees[-1], scale) for look in _looked(system, one)[1]))
    raise InputError(
        path="system.parameters",
        expected="a box, beside the time t, on which the entries are power series in the parameters of at most"
        f" {NUMBERS} numbers times states, in at most {MOST_PARTS} parts: fewer parameters or states, or smaller"
        " intervals",
        got="entries that turn too much for that" if degrees else f"{d * comb(nu + lowest, nu)} numbers at least",
    )


def _looked(system: System, counts: np.ndarray) -> tuple[tuple[Array, ...], list[Cauchy | None]]:
    """The ends of so many parts of every parameter, and what bounds the rest of the series of entries on each part."""
    box, powers = system.box, system.powers
    assert powers is not None
    ends = zip(box.lower.tolist(), box.upper.tolist(), counts.tolist(), strict=True)
    edges = tuple(_edges(*one) for one in ends)
    return edges, [cauchy(part) if beyond(part, powers).any() else None for part in _boxes(system, edges)]


def _scale(system: System) -> Array:
    """Units of the states, ``(d,)``, in which no entry of ``A`` at the middle of the parameters is large."""
    A = np.max([np.abs(np.asarray(one.A, dtype=float)) for one in system.at(system.deviations[0]).modes], axis=0)
    return balanced(A, system.horizon)


def _exponent(system: System, scale: Array) -> float:
    """By which exponent parameters may move the state: the integral of the norms of all coefficients of ``A`` but the
    constant one."""
    (centre, units), found = system.deviations, 0.0
    for law in system.phases:
        for time in np.linspace(law.begin, law.until, LOOKS).tolist():
            parts = Split.of(law.entry("A"), time, centre, units, DEGREE).parts
            sizes = [np.abs(table.astype(float)) * scale / scale[:, None] for key, table in parts.items() if any(key)]
            rate = sum(float(one.sum(axis=1).max()) for one in sizes)
            found += rate * (law.until - law.begin) / LOOKS
    return found


def _share(look: Cauchy | None, degree: int, scale: Array) -> float:
    """About what series leave of states in units ``scale (d,)``, as a share; nothing of polynomials."""
    return 0.0 if look is None else (degree + 1) * look.share(degree, scale)


def _edges(low: float, high: float, count: int) -> Array:
    """The ends of ``count`` equal parts of an interval."""
    found = np.linspace(low, high, count + 1)
    found[0], found[-1] = low, high
    return found
