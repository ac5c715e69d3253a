"""Law of a system that changes with time as a polynomial in its parameters: its degree, and the parts of the
parameters' box. States are expanded on cells of these parts, each by itself (`Expansion.on_cell`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from math import comb
from typing import final
from weakref import WeakKeyDictionary, ref

import numpy as np

from sparserob_core.control.enclosures.dependence import ExpandedSystem, Split, TruncationBound
from sparserob_core.control.problem.phase import Phase, PhaseInUnits
from sparserob_core.control.problem.system import System
from sparserob_core.control.response.varying.discs import NAMES, Cauchy, beyond, cauchy
from sparserob_core.control.response.varying.expansion import Expansion, balanced
from sparserob_core.control.sets.sets import Box
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.taylor import taylor_space

TRUNCATION_TOLERANCES = (1e-14, 1e-12, 1e-10)
"""Shares of the state, of which the first is taken that the estimated truncation error of the law reaches. A proof
needs 1e-8."""
NUMBERS = 400  # coefficients times states of a law; twice as many are matrices of 5 MB on each of its segments
MAX_EXPANSION_DEGREE = 30  # where entries are no polynomials: what 40 of them leave less is below what is rounded
LOOKS = 17  # times at which coefficients are looked at; nothing is proven with them
DEGREE = 4  # of the coefficients that are looked at then
MAX_PARTS = 64  # of the box: each is proven alone
MAX_EXPONENT = 700.0  # largest exponent by which parameters may move the state: its exponential is still a float
_CACHE: WeakKeyDictionary[Phase, dict[tuple[object, ...], ParameterParts]] = WeakKeyDictionary()


@final
@dataclass(frozen=True, eq=False)
class ParameterParts:
    """Box of parameters in parts, with the parametric expansion of the law on each.

    ``edges``: the ends of the parts of every parameter. The parts are all their products, those of the last parameter
    one after another. ``every``: for each part, the parametric expansion and the known system of all coefficients. All
    parts have the same polynomials.
    """

    edges: tuple[Array, ...]
    every: tuple[tuple[ExpandedSystem, System], ...]

    def of(self, parameters: Array) -> np.ndarray:
        """Return the part that contains each of ``parameters (k, nu)``, ``(k,)``; at an edge, one of the parts that it
        belongs to."""
        indices = [
            np.clip(np.searchsorted(edges, p, side="right") - 1, 0, edges.size - 2)
            for edges, p in zip(self.edges, parameters.T, strict=True)
        ]
        return np.asarray(np.ravel_multi_index(indices, [edges.size - 1 for edges in self.edges]))

    def holding(self, low: Array, high: Array) -> int | None:
        """Return the part that contains a cell ``[low, high]``, ``(nu,)`` each; ``None`` where no part does."""
        part = int(self.of(((low + high) / 2)[None])[0])
        ends = self.ends(part)
        return part if (ends[0] <= low).all() and (high <= ends[1]).all() else None

    def ends(self, part: int) -> tuple[Array, Array]:
        """Return the ends of a part, the least and the largest parameters, ``(nu,)`` each."""
        indices = np.unravel_index(part, [edges.size - 1 for edges in self.edges])
        intervals = [(edges[i], edges[i + 1]) for edges, i in zip(self.edges, indices, strict=True)]
        return np.array([low for low, _ in intervals]), np.array([high for _, high in intervals])

    def cut(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return cells ``(k, 1 + nu)`` of times and parameters, cut at the ends of the parts."""
        if len(self.every) == 1:
            return lower, upper
        cells = [lower[:0]], [upper[:0]]
        for part in range(len(self.every)):
            low, high = self.ends(part)
            a, b = lower.copy(), upper.copy()
            a[:, 1 : 1 + low.size] = np.maximum(a[:, 1 : 1 + low.size], low)
            b[:, 1 : 1 + low.size] = np.minimum(b[:, 1 : 1 + low.size], high)
            is_nonempty = ((a < b) | (lower == upper)).all(axis=1) & (a <= b).all(axis=1)
            cells[0].append(a[is_nonempty])
            cells[1].append(b[is_nonempty])
        return np.concatenate(cells[0]), np.concatenate(cells[1])

    @cached_property
    def expansions(self) -> tuple[Expansion, ...]:
        """Law on each part, as polynomials in time and parameters."""
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
        """Return the responses over intervals to the state and to inputs, at every one of several parameters.

        Parameters
        ----------
        starts, stops : Array
            Times ``(k,)``.
        points : Array
            Parameters ``(v, nu)``.

        Returns
        -------
        Array, Array
            The transitions ``(v, k, d, d)``; and the responses to constant inputs, those to the disturbance after the
            others, ``(v, k, d, m + mw)``. Nothing is proven by them.
        """
        tables = [
            (indices, expansion.at_parameters(starts, stops, powers[:, None]))
            for indices, expansion, powers in self._group_by_part(points)
        ]
        state, inputs = _join_tables(tables)
        return state, inputs

    def along(self, starts: Array, stops: Array, parameters: Array) -> tuple[Array, Array]:
        """Return the responses of `over` with one of the ``parameters (k, nu)`` for each interval, ``(k, d, d)`` and
        ``(k, d, m + mw)``."""
        tables = []
        for indices, expansion, powers in self._group_by_part(parameters):
            responses = expansion.at_parameters(starts[indices], stops[indices], powers[None])
            tables.append((indices, (responses[0][0], responses[1][0])))
        state, inputs = _join_tables(tables)
        return state, inputs

    def entries(self, times: Array, parameters: Array) -> tuple[Array, Array]:
        """Return ``A (k, d, d)`` and ``[B E] (k, d, m + mw)`` at times ``(k,)`` and ``parameters (k, nu)``; nothing is
        proven by them."""
        tables, d = [], self.every[0][0].d
        for indices, expansion, powers in self._group_by_part(parameters):
            both = (table.reshape(indices.size, -1, d, table.shape[2]) for table in expansion.at(times[indices]))
            A, inputs = (np.einsum("ka,kaij->kij", powers, table) for table in both)
            tables.append((indices, (A, inputs)))
        A, inputs = _join_tables(tables)
        return A, inputs

    def averages(self, breaks: Array, points: Array) -> Array:
        """Return estimates of ``A`` between ``breaks (L + 1,)`` at parameters ``(v, nu)``, ``(v, L, d, d)``."""
        d, tables = self.every[0][0].d, []
        for indices, expansion, powers in self._group_by_part(points):
            averages = expansion.average(breaks).reshape(breaks.size - 1, -1, d, d)
            tables.append((indices, (np.einsum("va,kaij->vkij", powers, averages),)))
        return _join_tables(tables)[0]

    def bound_truncation_error(self, part: int, initial_sizes: Array, inputs: Array, growth: float) -> Array:
        """Return upper bounds ``(d,)`` of the effect of the law's truncation error on any state at any parameter of a
        part.

        Parameters
        ----------
        part : int
            The part of the parameters.
        initial_sizes, inputs : Array
            Upper bounds of the initial state ``(d,)`` and of the inputs ``(m + mw,)``.
        growth : float
            Upper bound of the growth of states between two times, in the units of the part.
        """
        spread, law = self.every[part][0], self.expansions[part]
        truncation, d = spread.remainder, spread.d
        assert truncation is not None
        units, forcing = law.units[:d], law.largest_inputs(spread) @ inputs / law.units[:d]
        state = growth * (float((initial_sizes / units).max()) + float(np.diff(law.ends) @ forcing.max(axis=1)))
        A = (truncation.sizes[:, :, :d] * units).sum(axis=2) / units
        input_error = truncation.sizes[:, :, d:] @ inputs / units
        rate = state * A.max(axis=1) + input_error.max(axis=1)
        return np.asarray(growth * float(np.diff(truncation.ends) @ rate) * units * (1.0 + 1e-9))

    def _group_by_part(self, points: Array) -> Iterator[tuple[np.ndarray, Expansion, Array]]:
        """Yield the indices of the parameters ``(v, nu)`` in every part, the law there, and their monomials."""
        part_of_point = self.of(points)
        for part in np.unique(part_of_point).tolist():
            indices, spread = np.flatnonzero(part_of_point == part), self.every[part][0]
            yield indices, self.expansions[part], spread.space.monomials(spread.shares(points[indices]))


def _join_tables(found: Sequence[tuple[np.ndarray, Sequence[Array]]]) -> list[Array]:
    """Return tables of all indices from tables of some of them each, ``(numbers (k,), tables)``."""
    order = np.argsort(np.concatenate([numbers for numbers, _ in found]))
    return [np.concatenate(blocks)[order] for blocks in zip(*(tables for _, tables in found), strict=True)]


def law_of(system: System) -> ParameterParts:
    """Return the parametric expansion of the law of a system, on parts of the box of parameters.

    Entries that are polynomials need one part and have no truncation error. Other entries are power series, and the
    parts are as small as these need to be. Raises `InputError` where that takes too many parts.
    """
    first, *later_phases = system.phases
    kept, box = _CACHE.setdefault(first, {}), system.box
    key = (
        system.horizon,
        box.lower.tobytes(),
        box.upper.tobytes(),
        *((phase.begin, ref(phase)) for phase in later_phases),
    )
    if key not in kept:
        kept[key] = _expand_law(system) if system.stated is system else _convert_units(system)
    return kept[key]


def _expand_law(system: System) -> ParameterParts:
    """Return the law (`law_of`) of a system in the units of the user."""
    edges, series_bounds, degree = _choose_parts(system)
    laws = []
    for part_system, series_bound in zip(_restrict_to_parts(system, edges), series_bounds, strict=True):
        centre, units = part_system.deviations
        truncation = None if series_bound is None else series_bound.bound_remainder(degree)
        spread = ExpandedSystem(system.states, taylor_space(centre.size, degree), centre, units, truncation)
        laws.append((spread, part_system.superposed(spread)))
    return ParameterParts(edges, tuple(laws))


def _convert_units(system: System) -> ParameterParts:
    """Return the law (`law_of`) of a system in its own units, which are powers of two: the same polynomials, in these
    units."""
    law = system.phases[0]
    assert isinstance(law, PhaseInUnits)
    time, units = law.clock, law.units[1:]
    user_law, laws = law_of(system.stated), list[tuple[ExpandedSystem, System]]()
    factors = {name: law.factors[name] * np.ones(law._shape(name)) for name in NAMES if law.entry(name) is not None}
    for spread, part_system in user_law.every:
        size, truncation = spread.space.size, spread.remainder
        if truncation is not None:
            truncation = TruncationBound(
                truncation.ends / time, truncation.sizes * np.abs(np.hstack(list(factors.values())))
            )
        tiled = [np.tile(factors[name], (size, size if name == "A" else 1)) for name in ("A", "B", "E")]
        drift = np.tile(factors["c"], (size, 1)) if "c" in factors else 1.0
        scaled = part_system.in_units(tiled[0], tiled[1], tiled[2], np.zeros(0), drift, time)
        laws.append(
            (replace(spread, centre=spread.centre / units, units=spread.units / units, remainder=truncation), scaled)
        )
    edges = tuple(ends / unit for ends, unit in zip(user_law.edges, units, strict=True))
    return ParameterParts(edges, tuple(laws))


def _restrict_to_parts(system: System, edges: tuple[Array, ...]) -> list[System]:
    """Return the system with its parameters in every part of their box."""
    ends = [list(pairwise(breaks.tolist())) for breaks in edges]
    corners = [np.array(intervals).T for intervals in product(*ends)]
    return [system] if len(corners) == 1 else [system.with_parameters(Box(low, high)) for low, high in corners]


def _choose_parts(system: System) -> tuple[tuple[Array, ...], list[Cauchy | None], int]:
    """Return the edges of the parts of every parameter, the bounds of the truncation errors of the entries' series, and
    the degree of the series.

    There are 1, 2, 4, ... parts: their number doubles along the parameter for which the truncation error is then least.
    """
    box, powers, d = system.box, system.powers, system.states
    assert powers is not None
    nu, counts, lowest = box.dimension, np.ones(box.dimension, dtype=int), max(1, powers)
    scale = _choose_state_units(system)
    exponent = _estimate_exponent(system, scale)
    if exponent > MAX_EXPONENT:
        raise InputError(
            path="system.parameters",
            expected="a box, beside the time t and in A, over which the state has an expansion in double precision:"
            " smaller intervals, or a shorter horizon",
            got=f"parameters that move the state by up to e^{exponent:.2g}",
        )
    degrees = [n for n in range(lowest, MAX_EXPANSION_DEGREE + 1) if d * comb(nu + n, nu) <= NUMBERS]
    while degrees and counts.prod() <= MAX_PARTS:
        edges, series_bounds = _bound_parts(system, counts)
        for tolerance, degree in product(TRUNCATION_TOLERANCES, degrees):
            if all(_estimate_truncation(series_bound, degree, scale) <= tolerance for series_bound in series_bounds):
                return edges, series_bounds, degree
        candidates = [counts * (1 + direction) for direction in np.eye(nu, dtype=int)]
        counts = min(
            candidates,
            key=lambda numbers: max(
                _estimate_truncation(series_bound, degrees[-1], scale)
                for series_bound in _bound_parts(system, numbers)[1]
            ),
        )
    raise InputError(
        path="system.parameters",
        expected="a box, beside the time t, on which the entries are power series in the parameters of at most"
        f" {NUMBERS} numbers times states, in at most {MAX_PARTS} parts: fewer parameters or states, or smaller"
        " intervals",
        got="entries that turn too much for that" if degrees else f"{d * comb(nu + lowest, nu)} numbers at least",
    )


def _bound_parts(system: System, counts: np.ndarray) -> tuple[tuple[Array, ...], list[Cauchy | None]]:
    """Return the edges of so many parts of every parameter, and the bounds of the truncation errors of the entries'
    series on each part."""
    box, powers = system.box, system.powers
    assert powers is not None
    ends = zip(box.lower.tolist(), box.upper.tolist(), counts.tolist(), strict=True)
    edges = tuple(_divide_interval(*interval) for interval in ends)
    return edges, [
        cauchy(part_system) if beyond(part_system, powers).any() else None
        for part_system in _restrict_to_parts(system, edges)
    ]


def _choose_state_units(system: System) -> Array:
    """Return units of the states, ``(d,)``, in which no entry of ``A`` at the middle of the parameters is large."""
    A = np.max([np.abs(np.asarray(mode.A, dtype=float)) for mode in system.at(system.deviations[0]).modes], axis=0)
    return balanced(A, system.horizon)


def _estimate_exponent(system: System, scale: Array) -> float:
    """Return an estimate of the exponent by which parameters may move the state: the integral of the norms of all
    coefficients of ``A`` except the constant one, from `LOOKS` times and up to `DEGREE`."""
    (centre, units), exponent = system.deviations, 0.0
    for law in system.phases:
        for time in np.linspace(law.begin, law.until, LOOKS).tolist():
            coefficients = Split.of(law.entry("A"), time, centre, units, DEGREE).parts
            sizes = [
                np.abs(table.astype(float)) * scale / scale[:, None] for key, table in coefficients.items() if any(key)
            ]
            rate = sum(float(size.sum(axis=1).max()) for size in sizes)
            exponent += rate * (law.until - law.begin) / LOOKS
    return exponent


def _estimate_truncation(look: Cauchy | None, degree: int, scale: Array) -> float:
    """Return an estimate of the relative truncation error of series for states in units ``scale (d,)``; 0 for
    polynomials."""
    return 0.0 if look is None else (degree + 1) * look.share(degree, scale)


def _divide_interval(low: float, high: float, count: int) -> Array:
    """Return the ends of ``count`` equal parts of an interval."""
    edges = np.linspace(low, high, count + 1)
    edges[0], edges[-1] = low, high
    return edges
