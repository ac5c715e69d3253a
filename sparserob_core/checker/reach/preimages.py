"""Deviations that are seen as given: inverses of what innovations see of the blocks of the disturbance.

Innovations are ``D z`` for deviations ``z``. Of ``p = D z`` one wants some ``q`` with ``D q = p``. Where breakpoints of
control and disturbance differ, rows of ``D`` depend on others (all that lie within one block see the same few numbers),
and so do columns (a state sees no more numbers than it has entries). Balls cannot tell that a number is 0; so the rank
is bounded from above by who can see what, without rounding, and from below by rows that balls show to be independent.
Where these agree, the other rows are combinations of them, and ``q`` from them alone is right for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np
import numpy.typing as npt

from sparserob_core.checker.arithmetic.balls import ball, spanning
from sparserob_core.checker.arithmetic.series import middles, stacked
from sparserob_core.checker.flow.units import scaled
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat, fmpq_mat

EVENED = 20  # steps in which rows and columns become of one size; the first few do most, twice as many change nothing

# Bits that a row may have lost to what cancels in it. An observer's numbers have 53, so that of what it leaves of what
# was seen before so many are lost; other rows lose a few. Where those do not suffice, of which six digits are known do.
OBSERVED, FEWEST = 40, 20

Pattern = npt.NDArray[np.bool_]


@final
@dataclass(frozen=True, eq=False)
class Pushed:
    """Who of the states can see which entry of a disturbance in ``x' = A x + E w``, whatever the times, and whichever
    of several systems act: ``pattern (d, mw)``; of all of these at most ``states`` are independent of each other, and
    at most ``entries``."""

    pattern: Pattern
    states: int
    entries: int

    @staticmethod
    def of(modes: Sequence[tuple[arb_mat, arb_mat]], vectors: Sequence[Sequence[Fraction]]) -> Pushed:
        """Without rounding, for a disturbance along the ``vectors (q, mw)``, of systems ``A (d, d)``, ``E (d, mw)``;
        raises `Unchecked` where their numbers are not exact.

        Where columns of ``E`` are brought to by any of the systems, one after another, is the least subspace that holds
        them and that no ``A`` leaves; it is reached within ``d`` steps."""
        from flint import fmpq, fmpq_mat

        if not all(x.is_exact() for mode in modes for part in mode for x in part.entries()):
            raise Unchecked("the numbers of the system are not exact")
        systems = [_rational(A.transpose().tolist()) for A, _ in modes]
        along = fmpq_mat([[fmpq(v.numerator, v.denominator) for v in vector] for vector in vectors]).transpose()
        entered = [_rational(E.tolist()) * along for _, E in modes]
        pattern: Pattern = np.any([[[x != 0 for x in row] for row in E.tolist()] for E in entered], axis=0)
        linked = np.any([middles(A) != 0.0 for A, _ in modes], axis=0).astype(int)
        spanned = spanning([row for one in entered for row in one.transpose().tolist()])
        for _ in range(linked.shape[0] - 1):
            moved = [row for a in systems for row in (fmpq_mat(spanned) * a).tolist()] if spanned else []
            spanned = spanning([*spanned, *moved])
            pattern = pattern | (linked @ pattern.astype(int) > 0)
        return Pushed(pattern, len(spanned), fmpq_mat([row for one in entered for row in one.tolist()]).rank())

    @staticmethod
    def linked(A: Pattern, E: Pattern, vectors: Sequence[Sequence[Fraction]]) -> Pushed:
        """From which entries of the matrices are other than 0 alone."""
        pattern: Pattern = E.astype(int) @ np.array([[bool(v) for v in vector] for vector in vectors]).T > 0
        for _ in range(len(A) - 1):
            pattern = pattern | (A.astype(int) @ pattern.astype(int) > 0)
        return Pushed(pattern, int(pattern.any(axis=1).sum()), int(pattern.any(axis=0).sum()))


def _rational(rows: Sequence[Sequence[arb]]) -> fmpq_mat:
    from flint import fmpq, fmpq_mat

    return fmpq_mat([[fmpq(*float(x).as_integer_ratio()) for x in row] for row in rows])


@final
@dataclass(frozen=True, eq=False)
class SeenDeviations:
    """What some innovations see of some blocks: ``matrix``, and which of its entries may be other than 0, ``pattern``.
    ``rows``: of every group of rows, one for each innovation, where it ends and how many of it are independent at most;
    ``columns``: the same for each block. ``reach``: how far every column deviates, all alike unless given."""

    matrix: arb_mat
    pattern: Pattern
    rows: Sequence[tuple[int, int]]
    columns: Sequence[tuple[int, int]]
    reach: Array | None = None

    @cached_property
    def most(self) -> int:
        """No more rows than this are independent: a cut between rows and columns, groups of either counted once, leaves
        nothing but zeros. Any cut is a bound; the least one is that of the largest flow (Ford and Fulkerson 1956)."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import breadth_first_order, maximum_flow

        r, c = self.pattern.shape
        sizes = [r, c, len(self.rows), len(self.columns)]
        row, column, seeing, shown = (sum(sizes[:k]) for k in range(4))
        source, sink = sum(sizes), sum(sizes) + 1
        links = [(row + i, column + j, 1) for i, j in np.argwhere(self.pattern).tolist()]
        links += [(source, seeing + g, most) for g, (_, most) in enumerate(self.rows)]
        links += [(shown + g, sink, most) for g, (_, most) in enumerate(self.columns)]
        links += [(seeing + g, row + i, 1) for i, g in enumerate(_groups(self.rows, r))]
        links += [(column + j, shown + g, 1) for j, g in enumerate(_groups(self.columns, c))]
        starts, ends, room = (np.array(values, dtype=np.int32) for values in zip(*links, strict=True))
        network = csr_array((room, (starts, ends)), shape=(sink + 1, sink + 1))
        left = csr_array(network - maximum_flow(network, source, sink).flow)
        left.eliminate_zeros()
        inside = np.zeros(sink + 1, dtype=bool)
        inside[breadth_first_order(left, source, return_predecessors=False)] = True
        return int(room[inside[starts] & ~inside[ends]].sum())

    def inverse(self) -> arb_mat:
        """A matrix that takes what is seen of any deviations to deviations that are seen alike, of all such the least
        beside how far they reach; raises `Unchecked` where balls do not show as many independent rows as there can
        be."""
        from flint import ctx
        from scipy.linalg import qr

        r, c, rank = self.matrix.nrows(), self.matrix.ncols(), self.most
        D, rows, columns = (
            _evened(self.matrix) if rank == c or self.reach is None else _reaching(self.matrix, self.reach)
        )
        every = D.tolist()
        for bits in (ctx.prec - OBSERVED, FEWEST):
            told = [i for i, row in enumerate(every) if _is_told(row, bits)]
            if len(told) < rank:
                continue
            chosen = told
            if rank < min(c, len(told)):
                chosen = [told[i] for i in qr(middles(D)[told].T, mode="r", pivoting=True)[1][:rank]]
            some = stacked([every[i] for i in chosen])
            turned = some.transpose()
            try:
                inverse = (turned * some).inv() * turned if rank == c else turned * (some * turned).inv()
            except ZeroDivisionError:
                continue
            return scaled(_spread(inverse, chosen, r), columns, rows)
        raise Unchecked("the checker cannot tell in which directions the disturbance pushes the state")


def _groups(groups: Sequence[tuple[int, int]], count: int) -> list[int]:
    """The group of each of so many members."""
    return [int(g) for g in np.searchsorted([end for end, _ in groups], np.arange(count), side="right")]


def _spread(matrix: arb_mat, places: list[int], count: int) -> arb_mat:
    """The columns of a matrix at these places of ``count``, 0 at the others."""
    zero, found = ball(0), []
    for row in matrix.tolist():
        given = dict(zip(places, row, strict=True))
        found.append([given.get(i, zero) for i in range(count)])
    return stacked(found)


def _is_told(row: Sequence[arb], bits: int) -> bool:
    """Whether so many bits of a row are known. Beside rows of one size, one of which little is known would make a
    matrix that no balls invert, or an inverse of which little is known."""
    return max(float(abs(x.mid())) for x in row) > 2.0**bits * max(float(x.rad()) for x in row)


def _reaching(D: arb_mat, reach: Array) -> tuple[arb_mat, Array, Array]:
    """A matrix with its columns multiplied by powers of two near how far they reach, so that short deviations are those
    that use little of it, and its rows so that the largest entry of each is about 1; and these powers."""
    columns = np.exp2(np.round(np.log2(reach)))
    most = (np.abs(middles(D)) * columns).max(axis=1)
    rows = np.exp2(-np.round(np.log2(np.where(most > 0.0, most, 1.0))))
    return scaled(D, rows, columns), rows, columns


def _evened(D: arb_mat) -> tuple[arb_mat, Array, Array]:
    """A matrix with its rows and columns multiplied by powers of two, so that the largest entry of each is about 1
    (Ruiz 2001), and these powers: what is inverted is then of no unit."""
    sizes = np.abs(middles(D))
    rows, columns = np.ones(sizes.shape[0]), np.ones(sizes.shape[1])
    for _ in range(EVENED):
        evened = sizes * rows[:, None] * columns
        for factors, most in ((rows, evened.max(axis=1)), (columns, evened.max(axis=0))):
            factors /= np.sqrt(np.where(most > 0.0, most, 1.0))
    rows, columns = (np.exp2(np.round(np.log2(factors))) for factors in (rows, columns))
    return scaled(D, rows, columns), rows, columns
