"""A program that depends on one number: which values of it leave something feasible, as one more semi-infinite
program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, TypeAlias

import numpy as np
from scipy.sparse import block_diag

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.program import ConstraintFamily, Enclosure, SemiInfiniteProgram, Separation

Programs: TypeAlias = Callable[[float], SemiInfiniteProgram]
PROGRAMS_KEPT = 4  # programs that are remembered, those asked for last


@dataclass(frozen=True, eq=False)
class ParametricProgram:
    """Programs ``at(factor)`` that differ in right-hand sides and bounds only, which are affine in the factor for
    factors ``>= 0``."""

    at: Programs
    _programs: dict[float, SemiInfiniteProgram] = field(default_factory=dict, init=False, repr=False)

    def program(self, factor: float) -> SemiInfiniteProgram:
        """The program at a factor, remembered."""
        if factor not in self._programs:
            if len(self._programs) >= PROGRAMS_KEPT:
                self._programs.pop(next(iter(self._programs)))
            self._programs[factor] = self.at(factor)
        return self._programs[factor]


def extreme_program(
    factored: ParametricProgram, sense: Literal["largest", "smallest"], cap: float
) -> SemiInfiniteProgram:
    """The largest or the smallest factor in ``[0, cap]`` that leaves something feasible; the decision is
    ``(x, factor)``.

    A row ``G x <= h(f)`` with ``h(f) = h(1) + (f - 1) (h(2) - h(1))`` becomes
    ``G x - (h(2) - h(1)) f <= 2 h(1) - h(2)``; the bounds of the image do the same where they depend on the factor. A
    family's separation and enclosure are those of the program at the decision's factor.
    """
    unit_program, double_program = factored.at(1.0), factored.at(2.0)
    first, second = unit_program.finite, double_program.finite
    slope_low, slope_high = _subtract_finite(second.lower, first.lower), _subtract_finite(second.upper, first.upper)
    moves = bool(slope_low.any() or slope_high.any())
    G, h = _append_factor(first.G, first.h, second.h)
    if moves:
        rows, bounds = _build_moving_bounds(unit_program, slope_low, slope_high)
        G, h = np.vstack([G, rows]), np.concatenate([h, bounds])
    A, b = _append_factor(first.A, first.b, second.b)
    q = np.zeros(unit_program.n + 1)
    q[-1] = -1.0 if sense == "largest" else 1.0
    free = np.full(first.lower.size, np.inf)
    return SemiInfiniteProgram(
        n=unit_program.n + 1,
        q=q,
        S=_extend_image(unit_program),
        G=G if h.size else None,
        h=h if h.size else None,
        A=A if b.size else None,
        b=b if b.size else None,
        lower=np.append(-free if moves else first.lower, 0.0),
        upper=np.append(free if moves else first.upper, cap),
        families=[
            _parametrise_family(factored, unit_family, double_family)
            for unit_family, double_family in zip(unit_program.families, double_program.families, strict=True)
        ],
    )


def slack_program(program: SemiInfiniteProgram, lowest: float, highest: float) -> SemiInfiniteProgram:
    """Return the program of the least relaxation ``t`` in ``[lowest, highest]`` of all the families' rows that makes
    them feasible.

    All rows are relaxed by the same ``t``, which is negative where they have that much to spare. The decision is
    ``(x, t)``. Where the other rows, equalities and bounds are feasible, the program is feasible for a ``highest`` that
    is large enough, and the families' rows have a Slater point.
    """
    base = program.finite
    q = np.zeros(program.n + 1)
    q[-1] = 1.0
    G, A = (np.hstack([rows, np.zeros((rows.shape[0], 1))]) for rows in (base.G, base.A))
    return SemiInfiniteProgram(
        n=program.n + 1,
        q=q,
        S=_extend_image(program),
        G=G if base.h.size else None,
        h=base.h if base.h.size else None,
        A=A if base.b.size else None,
        b=base.b if base.b.size else None,
        lower=np.append(base.lower, lowest),
        upper=np.append(base.upper, highest),
        families=[_relax_family(family) for family in program.families],
    )


def _subtract_finite(second: Array, first: Array) -> Array:
    return np.where(
        np.isfinite(first), np.where(np.isfinite(first), second, 0.0) - np.where(np.isfinite(first), first, 0.0), 0.0
    )


def _append_factor(rows: Array, one: Array, two: Array) -> tuple[Array, Array]:
    return np.hstack([rows, -(two - one)[:, None]]), 2.0 * one - two


def _build_moving_bounds(program: SemiInfiniteProgram, slope_low: Array, slope_high: Array) -> tuple[Array, Array]:
    """Return the finite upper and lower bounds of the image, which change with the factor, as rows with right-hand
    sides."""
    base = program.finite
    S = np.eye(program.n) if base.S is None else base.S.toarray()
    above, below = np.isfinite(base.upper), np.isfinite(base.lower)
    rows = np.vstack([np.hstack([S[above], -slope_high[above, None]]), np.hstack([-S[below], slope_low[below, None]])])
    return rows, np.concatenate([(base.upper - slope_high)[above], (slope_low - base.lower)[below]])


def _extend_image(program: SemiInfiniteProgram) -> object:
    if program.finite.S is None:
        return None
    return block_diag([program.finite.S, [[1.0]]], format="csc")


def _parametrise_family(factored: ParametricProgram, one: ConstraintFamily, two: ConstraintFamily) -> ConstraintFamily:
    name = one.name

    def rows(indices: Array) -> tuple[Array, Array]:
        (G, first), (_, second) = one.rows(indices), two.rows(indices)
        return np.concatenate([G, -(second - first)[:, :, None]], axis=2), 2.0 * first - second

    def worst(z: Array) -> Separation:
        separation = factored.program(float(z[-1])).family(name).worst
        assert separation is not None
        return separation(z[:-1])

    def enclosure(z: Array, lower: Array, upper: Array) -> Enclosure:
        enclosed = factored.program(float(z[-1])).family(name).enclosure
        assert enclosed is not None
        return enclosed(z[:-1], lower, upper)

    return ConstraintFamily(
        name=name,
        index_set=one.index_set,
        rows=rows,
        worst=worst if one.worst else None,
        cells=one.cells,
        enclosure=enclosure if one.enclosure else None,
        explain=one.explain,
        formulation=one.formulation,
        source=one.source,
        row_units=one.row_units,
        measured=one.measured,
        along=one.along,
    )


def _relax_family(family: ConstraintFamily) -> ConstraintFamily:
    def rows(indices: Array) -> tuple[Array, Array]:
        G, h = family.rows(indices)
        return np.concatenate([G, -np.ones((*h.shape, 1))], axis=2), h

    def worst(z: Array, separation: Callable[[Array], Separation]) -> Separation:
        answer = separation(z[:-1])
        return replace(answer, violations=answer.violations - z[-1], bound=answer.bound - z[-1])

    index_set: Box = family.index_set
    return ConstraintFamily(
        name=family.name,
        index_set=index_set,
        rows=rows,
        explain=family.explain,
        formulation=family.formulation,
        source=family.source,
        row_units=family.row_units,
        measured=family.measured,
        along=family.along,
        cells=family.cells,
        worst=None if family.worst is None else partial(worst, separation=family.worst),
    )
