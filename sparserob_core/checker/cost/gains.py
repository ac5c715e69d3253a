"""The upper bound of how much all gains of a control with feedback can lower a weighted sum of constraints together.

An entry of the control on a piece adds ``F z`` to a deviation ``z``, with ``F = M D``: gains ``M`` times the matrix
``D`` from deviations to the innovations that this piece answers. In a sum of constraints at deviations ``z_i`` with
weights ``s_i``, gains contribute ``F q`` with ``q = sum_i s_i z_i``. Any ``q'`` with ``D q' = D q`` contributes as
much. The width of the control's set bounds ``h(F) + h(-F)``, hence ``F q'``: by the width times the size of ``q'`` in
units of the deviations, in the block where this is largest.

Two choices are compared, ``q`` itself and the shortest ``q'``. The first one is small where every deviation is
measured, since honest multipliers make ``D q`` vanish. The second one is small where few numbers measure many
deviations. Balls cannot show that rows or columns of ``D`` depend on each other. Without rounding, some are left out
beforehand: states that follow from others in every innovation, and directions whose effect is that of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import final

import numpy as np
from flint import arb, arb_mat, fmpq, fmpq_mat

from sparserob_core.checker.arithmetic.balls import ball, largest, rational, rationals, spanning
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import exactly, identity, middles, stacked, zeros
from sparserob_core.checker.cost.duality import ConstraintRow
from sparserob_core.checker.flow.plant import modes_at
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import width
from sparserob_core.sip.convex_set import Array, ConvexSet

NEGLIGIBLE = 1e-9  # of the largest number, what counts as 0 in a guess; no claim rests on it


@final
@dataclass(frozen=True, eq=False)
class GainsBound:
    """The gains with which a control answers the measurements of a ``loop`` at rest.

    ``answers (K, K)`` says which pieces answer which breakpoints, and ``control`` is the set of the control.
    """

    loop: VerifiedLoop
    answers: np.ndarray
    control: ConvexSet

    def of(self, rows: Sequence[tuple[float, ConstraintRow]]) -> arb:
        """Return an upper bound of how much the gains can lower the sum of ``rows`` times their multipliers."""
        total, K, m = ball(0), len(self.answers), self.control.dimension
        rows = [(y, row) for y, row in rows if any(not x.is_zero() for block in row.deviations for x in block)]
        if not rows:
            return total
        slopes = stacked([[ball(y) * row.slope[k][i] for y, row in rows] for k in range(K) for i in range(m)])
        sums = (slopes * stacked([[x for block in row.deviations for x in block] for _, row in rows])).tolist()
        for k in range(K):
            clusters = self._cluster_breakpoints(k)
            for i in range(m):
                shares = [self._measure(members, sums[k * m + i]) for members in clusters]
                total = total + width(known(self.control), i) * largest([ball(0), *shares])
        return total

    def _cluster_breakpoints(self, k: int) -> list[tuple[int, ...]]:
        """Return the breakpoints that the control on a piece answers, in clusters: those that measure a common block
        are together."""
        groups: list[tuple[tuple[int, ...], set[int]]] = []
        for j in np.flatnonzero(self.answers[k, : k + 1]).tolist():
            members: tuple[int, ...] = (j,)
            blocks, separate = set(self._list_blocks(members)), []
            for group in groups if blocks else ():
                if blocks & group[1]:
                    members, blocks = group[0] + members, group[1] | blocks
                else:
                    separate.append(group)
            groups = [*separate, (members, blocks)] if blocks else groups
        return [tuple(sorted(members)) for members, _ in groups]

    def _list_blocks(self, members: tuple[int, ...]) -> list[int]:
        """Return the blocks that may deviate and are measured at some breakpoints."""
        measured = {block for j in members for block in self.loop.innovations.matrices[j]}
        return sorted(block for block in measured if self._segments[block])

    def _measure(self, members: tuple[int, ...], deviations: Sequence[arb]) -> arb:
        """Return the size of the deviations ``(Q,)`` that the breakpoints of a cluster measure, in the block where it
        is largest: of these, or of the shortest ones with the same innovations."""
        coordinates = list[arb]()
        for block in self._list_blocks(members):
            first, matrix = self.loop.deviations.starts[block], self._coordinates[block]
            coordinates += (matrix * stacked([[x] for x in deviations[first : first + matrix.ncols()]])).entries()
        projection = self._project(members)
        if projection is None:
            return self._find_largest(members, coordinates)
        shortest = (projection * stacked([[x] for x in coordinates])).entries()
        return min((self._find_largest(members, point) for point in (coordinates, shortest)), key=arb.upper)

    def _find_largest(self, members: tuple[int, ...], coordinates: Sequence[arb]) -> arb:
        """Return the size of deviations in the block where it is largest. They are given by their coordinates along the
        segments."""
        shares = iter(coordinates)
        sums = [
            sum((abs(next(shares)) / length for _, length in self._segments[block]), ball(0))
            for block in self._list_blocks(members)
        ]
        return largest(sums)

    @remembered()
    def _project(self, members: tuple[int, ...]) -> arb_mat | None:
        """Return the matrix from deviations to others with the same innovations at these breakpoints: ``X (D X)^-1 D``
        for directions that the innovations do not determine, as others do not change. Any ``X``, and any choice of
        directions, is valid; the pseudoinverse makes the result short. ``None`` where all directions are determined, or
        balls do not show that ``D X`` is regular."""
        table = list[list[arb]]()
        for j in members:
            parts = [
                self.loop.innovations.matrices[j][block] * self._vectors[block]
                if block in self.loop.innovations.matrices[j]
                else zeros(self.loop.innovations.outputs, self._vectors[block].ncols())
                for block in self._list_blocks(members)
            ]
            rows = [[x for line in lines for x in line] for lines in zip(*map(arb_mat.tolist, parts), strict=True)]
            table += [rows[s] for s in self._independent[0]] if j and self.loop.measured is None else rows
        lengths = np.array(
            [float(length) for block in self._list_blocks(members) for _, length in self._segments[block]]
        )
        free = _find_undetermined(middles(stacked(table)) * lengths)
        if not free:
            return None
        rows = [row for row in ([line[c] for c in free] for line in table) if any(not x.is_zero() for x in row)]
        shortened = zeros(len(free), len(free))  # of directions without any innovation
        if rows:
            D, size = stacked(rows), lengths[free]
            X = exactly(size[:, None] * np.linalg.pinv(_scale_rows(middles(D) * size)))
            try:
                shortened = X * (D * X).inv() * D
            except ZeroDivisionError:
                return None
        projection = identity(lengths.size).tolist()
        for place, line in zip(free, shortened.tolist(), strict=True):
            for column, x in zip(free, line, strict=True):
                projection[place][column] = x
        return stacked(projection)

    @cached_property
    def _independent(self) -> tuple[list[int], list[int], arb_mat]:
        """The states from which the others follow in every innovation after the first, the directions of the
        disturbance from whose effect that of the others follows, and the coordinates along these."""
        loop = self.loop
        if loop.deviations.shape is None:
            return [], [], identity(0)
        return find_independent(loop, [vector for vector, _ in self._spans[0]])

    @cached_property
    def _spans(self) -> list[list[tuple[list[Fraction], arb]]]:
        """For every block the directions along which its set is long, with the lengths; empty for a block that cannot
        deviate, which is never measured."""
        sets = self.loop.deviations.sets
        spans = {id(shape): known(shape).spans(middle) for shape, middle in sets}
        return [spans[id(shape)] for shape, _ in sets]

    @cached_property
    def _segments(self) -> list[list[tuple[list[Fraction], arb]]]:
        """The `_spans`, of the disturbance only independent ones."""
        blocks, chosen = self.loop.deviations.blocks, self._independent[1]
        return [[spans[s] for s in chosen] if block < blocks else spans for block, spans in enumerate(self._spans)]

    @cached_property
    def _vectors(self) -> list[arb_mat]:
        """The directions of the segments of every block, as columns ``(d, s)``."""
        return [_stack_columns(segments) for segments in self._segments]

    @cached_property
    def _coordinates(self) -> list[arb_mat]:
        """The matrices ``(s, d)`` that give the coordinates of deviations along the segments of every block."""
        matrices = list[arb_mat]()
        for block, spans in enumerate(self._spans):
            V = _stack_columns(spans)
            matrix = (V.transpose() * V).inv() * V.transpose()
            matrices.append(self._independent[2] * matrix if block < self.loop.deviations.blocks else matrix)
        return matrices


def find_independent(loop: VerifiedLoop, vectors: Sequence[Sequence[Fraction]]) -> tuple[list[int], list[int], arb_mat]:
    """Return what a disturbance along ``vectors (q, mw)`` moves in a loop, without rounding.

    The first result holds states from whose effect that on all states follows, the second one vectors from whose
    effect that of all vectors follows. The third one, ``(r, q)``, gives the same effect along these ``r`` vectors. Of a
    system that changes with time, only the entries that may differ from 0 are known; then no vector is left out."""
    d, driven, q = loop.flow.states, loop.flow.driven, len(vectors)
    along = rationals(vectors).transpose()
    modes = [] if loop.flow.plant.is_timed else modes_at(loop.system, ())
    if not modes or not all(x.is_exact() for mode in modes for name in "AE" for x in mode[name].entries()):
        is_nonzero = loop.flow.law.there
        reached = (is_nonzero[:, d + driven :] @ np.array(along.tolist(), dtype=bool)).any(axis=1)
        for _ in range(d):
            reached = reached | (is_nonzero[:, :d] @ reached)
        return np.flatnonzero(reached).tolist(), list(range(q)), identity(q)
    systems = [rationals(middles(mode["A"].transpose()).tolist()) for mode in modes]
    effects = [rationals(middles(mode["E"]).tolist()) * along for mode in modes]
    basis = spanning([row for effect in effects for row in effect.transpose().tolist()])
    for _ in range(d - 1 if basis else 0):
        basis = spanning([*basis, *(row for A in systems for row in (fmpq_mat(basis) * A).tolist())])
    reduced = spanning([row for effect in effects for row in effect.tolist()])
    return _find_leads(basis), _find_leads(reduced), arb_mat(len(reduced), q, [arb(x) for row in reduced for x in row])


def _find_undetermined(table: Array) -> list[int]:
    """Return the directions in which deviations with the same innovations differ, with the matrix ``table``."""
    _, sizes, directions = np.linalg.svd(_scale_rows(table))
    null_space = directions[int((sizes > NEGLIGIBLE * sizes.max(initial=0.0)).sum()) :]
    return np.flatnonzero((np.abs(null_space) > NEGLIGIBLE).any(axis=0)).tolist()


def _scale_rows(table: Array) -> Array:
    """Return a matrix whose rows are divided by their largest absolute values."""
    sizes = np.abs(table).max(axis=1, initial=0.0)[:, None]
    return np.asarray(table / np.where(sizes > 0.0, sizes, 1.0))


def _find_leads(rows: Sequence[Sequence[fmpq]]) -> list[int]:
    """Return the place of the first entry of every row that is not 0."""
    return [next(place for place, x in enumerate(row) if x != 0) for row in rows]


def _stack_columns(segments: Sequence[tuple[Sequence[Fraction], arb]]) -> arb_mat:
    """Return vectors as columns ``(d, s)``."""
    columns = [[rational(v) for v in vector] for vector, _ in segments]
    return stacked(columns).transpose() if columns else zeros(0, 0)
