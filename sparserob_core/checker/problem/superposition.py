"""Parameters of a system that changes with time, as coordinates of a larger state: derived from the problem's records
alone.

Let every entry of ``[A B E c]`` be a sum ``f_0(t) + sum_j f_j(t) s_j``. Here ``s_j`` is the deviation of parameter
``j`` from a middle value, as a share of its largest deviation. Let no entry of ``A`` with an ``s_j`` multiply a state
that depends on a parameter. Then the state is ``x = x_0 + sum_j s_j y_j`` with ``y_j' = A_0 y_j + A_j x_0 + B_j u + E_j
w + c_j``. After the ``d`` states of the problem come the coordinates of ``y_1`` that can differ from 0, then those of
``y_2``, and so on. Rows on ``x`` are affine in ``s``. They hold on a box where they hold at its corners, at which every
``s_j`` is -1 or 1; so do convex sets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import product
from math import inf, nextafter
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.checker.arithmetic.models import matrix_at
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.problem.integrals import with_zeros
from sparserob_core.control.problem.phase import PARTS, Phase
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.terms.integral import IntegralConstraint
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.control.problem.terms.windows import MixedConstraint
from sparserob_core.control.sets.sets import Box, ConvexSet, Cylinder, Equality, Polytope
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.problem.terms.windows import PathConstraint

NO_PLANE = "the checker knows parameters beside the time that the state depends on affinely"


@final
class Affine:
    """A number of which only the ``parameters`` that it depends on are known, by their places, at any time. It is an
    affine function of them; where ``is_nonlinear`` is True, it may be any function of them."""

    __slots__ = ("is_nonlinear", "parameters")

    def __init__(self, parameters: frozenset[int] = frozenset(), is_nonlinear: bool = False) -> None:
        self.parameters, self.is_nonlinear = parameters, is_nonlinear

    def _add(self, other: object, product: bool = False) -> Affine:
        if not isinstance(other, Affine):
            return self
        is_bilinear = product and bool(self.parameters) and bool(other.parameters)
        return Affine(self.parameters | other.parameters, self.is_nonlinear or other.is_nonlinear or is_bilinear)

    def _multiply(self, other: object) -> Affine:
        return self._add(other, product=True)

    def _apply_nonlinear(self, *_: object) -> Affine:
        return Affine(self.parameters, self.is_nonlinear or bool(self.parameters))

    def _return_self(self) -> Affine:
        return self

    def __truediv__(self, other: object) -> Affine:
        return self * other._apply_nonlinear() if isinstance(other, Affine) else self

    def __pow__(self, other: object) -> Affine:
        if isinstance(other, Affine):
            return self._apply_nonlinear() * other._apply_nonlinear()
        if other == 0:
            return Affine()
        return self if other == 1 else self._apply_nonlinear()

    __add__ = __radd__ = __sub__ = __rsub__ = _add
    __mul__ = __rmul__ = _multiply
    __neg__ = __pos__ = _return_self
    __rtruediv__ = __rpow__ = sin = cos = tan = exp = sqrt = log = tanh = kepler = _apply_nonlinear


@final
@dataclass(frozen=True, eq=False)
class ParameterExpansion:
    """The system of a problem about the ``middle (nu,)`` of its parameters."""

    system: System
    middle: tuple[float, ...]

    @cached_property
    def scales(self) -> list[float]:
        """The largest deviation of every parameter, or a double above it."""
        box = self.system.parameters
        if not isinstance(box, Box):
            raise Unchecked("the checker knows boxes of parameters beside the time")
        ranges = zip(box.lower.tolist(), box.upper.tolist(), self.middle, strict=True)
        return [
            _round_up(max(Fraction(high) - Fraction(middle), Fraction(middle) - Fraction(low)))
            for low, high, middle in ranges
        ]

    def depends(self, entry: object) -> tuple[np.ndarray, np.ndarray]:
        """Return which entries of a matrix may differ from 0, and which depend on a parameter, at any time: Booleans
        ``(rows, columns)`` and ``(nu, rows, columns)``; raise `Unchecked` where an entry is no affine function of the
        parameters."""
        movable = [frozenset([j]) if scale else frozenset[int]() for j, scale in enumerate(self.scales)]
        matrix = _evaluate_matrix(entry, [Affine(), *map(Affine, movable)])
        nonzero, dependent = np.zeros(matrix.shape, dtype=bool), np.zeros((len(movable), *matrix.shape), dtype=bool)
        for index, value in np.ndenumerate(matrix):
            nonzero[index] = isinstance(value, Affine) or float(value) != 0.0
            if isinstance(value, Affine):
                if value.is_nonlinear:
                    raise Unchecked(NO_PLANE)
                dependent[(list(value.parameters), *index)] = True
        return nonzero, dependent

    def tables(self, entry: object, time: object) -> list[np.ndarray]:
        """Return ``f_0, f_1, ..., f_nu`` of a matrix at a time: ``f_0`` in the middle, ``f_j`` its change where
        parameter ``j`` deviates by its `scales`."""
        zero: Any = 0.0 * time  # type: ignore[operator]  # a number of the kind of the time
        middle, dependent = [zero + value for value in self.middle], self.depends(entry)[1]
        tables = [_evaluate_matrix(entry, [time, *middle])]
        for j, (scale, mask) in enumerate(zip(self.scales, dependent, strict=True)):
            change = np.zeros(mask.shape, dtype=object)
            if mask.any():
                shifted = _evaluate_matrix(entry, [time, *middle[:j], middle[j] + scale, *middle[j + 1 :]])
                for index in zip(*np.nonzero(mask), strict=True):
                    change[index] = shifted[index] - tables[0][index]
            tables.append(change)
        return tables

    @cached_property
    def is_affine(self) -> bool:
        """True where the state is shown to be an affine function of the parameters."""
        try:
            _ = self.sensitive_states
        except Unchecked:
            return False
        return True

    @cached_property
    def sensitive_states(self) -> list[list[int]]:
        """The coordinates of every ``y_j`` that may differ from 0; raises `Unchecked` where the state is not shown to
        be affine in the parameters."""
        d, nu = self.system.states, len(self.middle)
        coupling, dependent_coupling, affected = (
            np.zeros((d, d), dtype=bool),
            np.zeros((nu, d, d), dtype=bool),
            np.zeros((nu, d), bool),
        )
        for phase in self.system.phases:
            for name in PARTS:
                entry = phase.entry(name)
                if entry is None:
                    continue
                nonzero, dependent = self.depends(entry)
                if name == "A":
                    coupling |= nonzero
                    dependent_coupling |= dependent
                affected |= dependent.any(axis=2)
        reachable = np.minimum(np.eye(d) + coupling, 1.0)
        for _ in range(d.bit_length()):  # the states that a state can influence in 1, 2, 4, ... steps
            reachable = np.minimum(reachable @ reachable, 1.0)
        coordinates = [
            np.flatnonzero(reachable @ affected_states > 0.0).tolist() for affected_states in affected.astype(float)
        ]
        if any(dependent_coupling[:, :, states].any() for states in coordinates):
            raise Unchecked(NO_PLANE)
        return coordinates

    @property
    def size(self) -> int:
        """The number of all coordinates."""
        return self.system.states + sum(map(len, self.sensitive_states))

    def compute_projection(self, shares: tuple[float, ...]) -> Array:
        """Return the matrix ``(d, size)`` that gives ``x`` from all coordinates, at the shares ``s_j`` of the
        parameters."""
        d = self.system.states
        projection, column = np.zeros((d, self.size)), d
        projection[:, :d] = np.eye(d)
        for share, states in zip(shares, self.sensitive_states, strict=True):
            for state in states:
                projection[state, column] = share
                column += 1
        return projection

    def corners(self) -> Iterator[tuple[float, ...]]:
        """Return the corners of a box that contains all shares ``s_j``; a parameter without any effect has the share 0
        only."""
        pairs = zip(self.scales, self.sensitive_states, strict=True)
        return product(*((-1.0, 1.0) if scale and states else (0.0,) for scale, states in pairs))


@final
@dataclass(frozen=True, eq=False)
class Larger:
    """A matrix of the system of all coordinates."""

    parts: ParameterExpansion
    name: str
    entry: object

    def __call__(self, p: Any) -> np.ndarray:
        """Return the matrix at a time ``(1,)``."""
        tables, coordinates, d = (
            self.parts.tables(self.entry, p[0]),
            self.parts.sensitive_states,
            self.parts.system.states,
        )
        if self.name != "A":
            return np.concatenate(
                [tables[0], *(table[states] for table, states in zip(tables[1:], coordinates, strict=True))]
            )
        matrix, row = np.zeros((self.parts.size, self.parts.size), dtype=object), d
        matrix[:d, :d] = tables[0]
        for table, states in zip(tables[1:], coordinates, strict=True):
            rows = slice(row, row + len(states))
            matrix[rows, :d], matrix[rows, rows] = table[states], tables[0][np.ix_(states, states)]
            row += len(states)
        return matrix


def parted(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the problem with coordinates for the parameters of a system that changes with time; the problem itself
    where there are none, or the state is not shown to be affine in them."""
    system = problem.system
    if not system.varies or system.parameters is None:
        return problem
    expansion = ParameterExpansion(system, tuple(system.parameters.interior_point().tolist()))
    if not expansion.is_affine:  # then the flow is expanded on boxes of parameters
        return problem
    d, extra = system.states, expansion.size - system.states
    corners = [expansion.compute_projection(shares) for shares in expansion.corners()]
    all_sensitive_states = {state for states in expansion.sensitive_states for state in states}
    if any(all_sensitive_states & set(end.fixed.tolist()) for end in problem.terminal_equalities):
        raise Unchecked("the checker knows fixed final values of states that no parameter beside the time moves")
    is_numbered = sum(not isinstance(entry, Return) for entry in problem.windows) > 1
    labels = [entry.name or (f"path[{i}]" if is_numbered else "path") for i, entry in enumerate(problem.windows)]
    state_names = list(problem.names.states or [f"x{i + 1}" for i in range(d)])
    units = list(problem.names.state_units)
    for name, scale, states in zip(system.names, expansion.scales, expansion.sensitive_states, strict=True):
        state_names += [f"{state_names[i]} per {scale:.3g} {name}" for i in states]
        units += [units[i] for i in states] if problem.names.state_units else []
    return replace(
        problem,
        **with_zeros(problem, extra),
        system=System(tuple(_extend_phase(expansion, phase) for phase in system.phases), None, system.delay),
        path=[
            row
            for entry, name in zip(problem.path, labels, strict=True)
            for row in _extend_constraint(entry, name, corners)
        ],
        terminal=[
            bound
            for end in problem.terminal
            for bound in (
                [Equality(np.pad(end.values, (0, extra), constant_values=np.nan))]
                if isinstance(end, Equality)
                else _extend_set(end, corners)
            )
        ],
        integral=[_extend_integral(entry, corners) for entry in problem.integral],
        names=replace(problem.names, states=state_names, state_units=units),
    )


def _evaluate_matrix(entry: object, arguments: list[Any]) -> np.ndarray:
    """Return a matrix at the time and the parameters, numbers of any kind."""
    p = np.empty(len(arguments), dtype=object)
    p[:] = arguments
    return matrix_at(entry, p)


def _round_up(exact: Fraction) -> float:
    """Return the number itself, or the next double above it."""
    rounded = float(exact)
    return nextafter(rounded, inf) if Fraction(rounded) < exact else rounded


def _extend_phase(parts: ParameterExpansion, phase: Phase) -> Phase:
    matrices = {name: Larger(parts, name, phase.entry(name)) for name in PARTS if phase.entry(name) is not None}
    times = Box([phase.begin], [phase.until])
    return Phase(
        matrices["A"],
        matrices["B"],
        matrices["E"],
        times,
        ("t",),
        matrices.get("c"),
        phase.begin,
        phase.until,
        timed=True,
    )


def _deduplicate_rows(blocks: list[Array]) -> Array:
    """Return every distinct row once, in the order of first occurrence."""
    return np.array(list(dict.fromkeys(tuple(row) for block in blocks for row in block.tolist())))


def _extend_set(bound: ConvexSet, corners: list[Array]) -> list[ConvexSet]:
    """Return sets of the larger state: it is in all of them where ``x`` is in a given set at every corner. A flat set
    becomes one polytope, another set one set for each corner."""
    facets = bound.halfspaces()
    if facets is not None:
        rows = _deduplicate_rows([np.column_stack([facets[0] @ projection, facets[1]]) for projection in corners])
        return [Polytope(rows[:, :-1], rows[:, -1])]
    base = bound.base if isinstance(bound, Cylinder) else bound
    b = base.dimension
    distinct_slopes = list(dict.fromkeys(tuple(map(tuple, projection[:b, b:].tolist())) for projection in corners))
    return [Cylinder(base, corners[0].shape[1], np.array(slopes)) for slopes in distinct_slopes]


def _extend_constraint(
    entry: PathConstraint | MixedConstraint | ConvexSet, name: str, corners: list[Array]
) -> list[PathConstraint | MixedConstraint]:
    assert not isinstance(entry, ConvexSet)
    d, size = corners[0].shape
    if isinstance(entry, MixedConstraint):
        H, G = np.asarray(entry.H), np.asarray(entry.G)
        table = _deduplicate_rows(
            [
                np.column_stack([H @ projection, G, np.broadcast_to(np.asarray(entry.h), len(H))])
                for projection in corners
            ]
        )
        return [replace(entry, name=name, H=table[:, :size], G=table[:, size:-1], h=table[:, -1])]
    rows = None if entry.relative_to is None else np.asarray(entry.relative_to)
    padded = None if rows is None else np.pad(rows, ((0, 0), (0, size - d)))
    bounds = _extend_set(entry.set, corners)
    return [
        replace(entry, name=name if len(bounds) == 1 else f"{name} at corner {k + 1}", set=bound, relative_to=padded)
        for k, bound in enumerate(bounds)
    ]


def _extend_integral(entry: IntegralConstraint, corners: list[Array]) -> IntegralConstraint:
    size, sides = corners[0].shape[1], [np.asarray(side, dtype=float) for side in (entry.lower, entry.upper)]
    table = _deduplicate_rows(
        [np.column_stack([np.asarray(entry.H) @ projection, np.asarray(entry.G), *sides]) for projection in corners]
    )
    return replace(entry, H=table[:, :size], G=table[:, size:-2], lower=table[:, -2], upper=table[:, -1])
