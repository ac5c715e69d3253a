"""Deviations that explain given innovations: generalised inverses of the matrix from the disturbance to the
innovations.

Innovations are ``D z`` for deviations ``z``. Given ``p = D z``, some ``q`` with ``D q = p`` is wanted. Where
breakpoints of control and disturbance differ, rows of ``D`` depend on each other: all innovations within one block
measure the same few numbers. Columns depend on each other too, since a state holds no more numbers than it has entries.
Balls cannot show that a number is 0. Therefore the rank is bounded from above without rounding, by which states each
deviation reaches, and from below by rows that balls show to be independent. Where both bounds agree, the other rows are
combinations of these, and a ``q`` that fits these rows fits all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import final

import numpy as np
import numpy.typing as npt
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from sparserob_core.checker.arithmetic.balls import ball, spanning
from sparserob_core.checker.arithmetic.series import middles, stacked
from sparserob_core.checker.flow.units import scaled
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

EVENED = 20  # steps of scaling rows and columns to one size; the first few do most, twice as many change nothing

# Bits that a row may have lost by cancellation, and bits that it must have at least. The gains of an observer have 53
# bits, so that what they leave of earlier deviations loses about 40; other rows lose a few. Where rows that lost less
# do not suffice, rows with six known digits are used too.
OBSERVED, FEWEST = 40, 20

Pattern = npt.NDArray[np.bool_]


@final
@dataclass(frozen=True, eq=False)
class ReachableSubspace:
    """The states that each entry of a disturbance reaches in ``x' = A x + E w``, whatever the times, and whichever of
    several systems act.

    Attributes
    ----------
    pattern
        The entries of the effect on the states that may differ from 0, ``(d, q)``.
    states
        The dimension of the smallest invariant subspace that holds all effects, or an upper bound of it.
    entries
        An upper bound of the number of independent columns of ``E`` along the vectors.
    """

    pattern: Pattern
    states: int
    entries: int

    @staticmethod
    def of(modes: Sequence[tuple[arb_mat, arb_mat]], vectors: Sequence[Sequence[Fraction]]) -> ReachableSubspace:
        """Return the reached states for a disturbance along ``vectors (q, mw)``, without rounding; `Unchecked` unless
        the entries of all systems ``A (d, d)``, ``E (d, mw)`` are floats. The reached subspace is the smallest one that
        holds the columns of every ``E`` along the vectors and that no ``A`` leaves. It is found within ``d`` steps."""
        if not all(x.is_exact() for mode in modes for matrix in mode for x in matrix.entries()):
            raise Unchecked("the numbers of the system are not exact")
        systems = [_convert_to_rational(A.transpose().tolist()) for A, _ in modes]
        along = fmpq_mat([[fmpq(v.numerator, v.denominator) for v in vector] for vector in vectors]).transpose()
        columns = [_convert_to_rational(E.tolist()) * along for _, E in modes]
        pattern: Pattern = np.any([[[x != 0 for x in row] for row in E.tolist()] for E in columns], axis=0)
        linked = np.any([middles(A) != 0.0 for A, _ in modes], axis=0).astype(int)
        spanned = spanning([row for matrix in columns for row in matrix.transpose().tolist()])
        for _ in range(linked.shape[0] - 1):
            images = [row for a in systems for row in (fmpq_mat(spanned) * a).tolist()] if spanned else []
            spanned = spanning([*spanned, *images])
            pattern = pattern | (linked @ pattern.astype(int) > 0)
        return ReachableSubspace(
            pattern, len(spanned), fmpq_mat([row for matrix in columns for row in matrix.tolist()]).rank()
        )

    @staticmethod
    def linked(A: Pattern, E: Pattern, vectors: Sequence[Sequence[Fraction]]) -> ReachableSubspace:
        """Return the reached states from the positions of entries that may differ from 0, of ``A (d, d)`` and
        ``E (d, mw)``, for a disturbance along ``vectors (q, mw)``."""
        pattern: Pattern = E.astype(int) @ np.array([[bool(v) for v in vector] for vector in vectors]).T > 0
        for _ in range(len(A) - 1):
            pattern = pattern | (A.astype(int) @ pattern.astype(int) > 0)
        return ReachableSubspace(pattern, int(pattern.any(axis=1).sum()), int(pattern.any(axis=0).sum()))


def _convert_to_rational(rows: Sequence[Sequence[arb]]) -> fmpq_mat:
    return fmpq_mat([[fmpq(*float(x).as_integer_ratio()) for x in row] for row in rows])


@final
@dataclass(frozen=True, eq=False)
class MeasuredDeviations:
    """The effect of some blocks of deviations on some innovations.

    Attributes
    ----------
    matrix, pattern
        The matrix ``D (r, c)``, and which of its entries may differ from 0, ``(r, c)``.
    rows
        For each innovation: the end of its group of rows, and an upper bound of how many of them are independent.
    columns
        For each block: the end of its group of columns, and an upper bound of how many of them are independent.
    reach
        The largest deviation of every column, ``(c,)``; ``None`` where all are alike.
    """

    matrix: arb_mat
    pattern: Pattern
    rows: Sequence[tuple[int, int]]
    columns: Sequence[tuple[int, int]]
    reach: Array | None = None

    @cached_property
    def rank_bound(self) -> int:
        """An upper bound of the rank: the capacity of a cut between rows and columns, of which a group counts at most
        its number of independent members. Any cut is such a bound. The smallest one is found by the largest flow (Ford
        and Fulkerson 1956)."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import breadth_first_order, maximum_flow

        r, c = self.pattern.shape
        sizes = [r, c, len(self.rows), len(self.columns)]
        row, column, seeing, shown = (sum(sizes[:k]) for k in range(4))
        source, sink = sum(sizes), sum(sizes) + 1
        links = [(row + i, column + j, 1) for i, j in np.argwhere(self.pattern).tolist()]
        links += [(source, seeing + g, capacity) for g, (_, capacity) in enumerate(self.rows)]
        links += [(shown + g, sink, capacity) for g, (_, capacity) in enumerate(self.columns)]
        links += [(seeing + g, row + i, 1) for i, g in enumerate(_find_groups(self.rows, r))]
        links += [(column + j, shown + g, 1) for j, g in enumerate(_find_groups(self.columns, c))]
        starts, ends, room = (np.array(values, dtype=np.int32) for values in zip(*links, strict=True))
        network = csr_array((room, (starts, ends)), shape=(sink + 1, sink + 1))
        residual = csr_array(network - maximum_flow(network, source, sink).flow)
        residual.eliminate_zeros()
        inside = np.zeros(sink + 1, dtype=bool)
        inside[breadth_first_order(residual, source, return_predecessors=False)] = True
        return int(room[inside[starts] & ~inside[ends]].sum())

    def inverse(self) -> arb_mat:
        """Return a matrix ``(c, r)`` that gives, for the innovations of any deviations, deviations with the same
        innovations, the shortest in units of powers of two near ``reach``. Raise `Unchecked` if balls do not show as
        many independent rows as there can be."""
        from scipy.linalg import qr

        r, c, rank = self.matrix.nrows(), self.matrix.ncols(), self.rank_bound
        D, rows, columns = (
            _equilibrate(self.matrix) if rank == c or self.reach is None else _scale_by_reach(self.matrix, self.reach)
        )
        entries = D.tolist()
        for bits in (ctx.prec - OBSERVED, FEWEST):
            usable = [i for i, row in enumerate(entries) if _has_known_bits(row, bits)]
            if len(usable) < rank:
                continue
            chosen = usable
            if rank < min(c, len(usable)):
                chosen = [usable[i] for i in qr(middles(D)[usable].T, mode="r", pivoting=True)[1][:rank]]
            submatrix = stacked([entries[i] for i in chosen])
            transposed = submatrix.transpose()
            try:
                inverse = (
                    (transposed * submatrix).inv() * transposed
                    if rank == c
                    else transposed * (submatrix * transposed).inv()
                )
            except ZeroDivisionError:
                continue
            return scaled(_insert_zero_columns(inverse, chosen, r), columns, rows)
        raise Unchecked("the checker cannot tell in which directions the disturbance pushes the state")


def _find_groups(groups: Sequence[tuple[int, int]], count: int) -> list[int]:
    """Return the index of the group of each of ``count`` members."""
    return [int(g) for g in np.searchsorted([end for end, _ in groups], np.arange(count), side="right")]


def _insert_zero_columns(matrix: arb_mat, places: list[int], count: int) -> arb_mat:
    """Return a matrix with its columns at these ``places`` of ``count``, and columns of 0 at the others."""
    zero, rows = ball(0), []
    for row in matrix.tolist():
        entries = dict(zip(places, row, strict=True))
        rows.append([entries.get(i, zero) for i in range(count)])
    return stacked(rows)


def _has_known_bits(row: Sequence[arb], bits: int) -> bool:
    """Return True where the largest entry of a row has at least so many known bits. With rows of one size, a row of
    which few bits are known makes a matrix that balls cannot invert, or an inverse of which few bits are known."""
    return max(float(abs(x.mid())) for x in row) > 2.0**bits * max(float(x.rad()) for x in row)


def _scale_by_reach(D: arb_mat, reach: Array) -> tuple[arb_mat, Array, Array]:
    """Return a scaled matrix, and the powers of two that multiply its rows and its columns. Columns are multiplied by
    about their reach, so that short solutions are those that use little of it. Rows are multiplied so that their
    largest entry is about 1."""
    columns = np.exp2(np.round(np.log2(reach)))
    largest = (np.abs(middles(D)) * columns).max(axis=1)
    rows = np.exp2(-np.round(np.log2(np.where(largest > 0.0, largest, 1.0))))
    return scaled(D, rows, columns), rows, columns


def _equilibrate(D: arb_mat) -> tuple[arb_mat, Array, Array]:
    """Return a scaled matrix, and the powers of two that multiply its rows and its columns, so that the largest entry
    of each is about 1 (Ruiz 2001). Units of rows and columns change the scaled matrix by rounded powers of two only."""
    sizes = np.abs(middles(D))
    rows, columns = np.ones(sizes.shape[0]), np.ones(sizes.shape[1])
    for _ in range(EVENED):
        evened = sizes * rows[:, None] * columns
        for factors, largest in ((rows, evened.max(axis=1)), (columns, evened.max(axis=0))):
            factors /= np.sqrt(np.where(largest > 0.0, largest, 1.0))
    rows, columns = (np.exp2(np.round(np.log2(factors))) for factors in (rows, columns))
    return scaled(D, rows, columns), rows, columns
