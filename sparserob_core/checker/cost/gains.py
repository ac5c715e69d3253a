"""The upper bound of how much all gains of a control with feedback can lower a weighted sum of constraints together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, balls, largest, rational
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.cost.duality import ConstraintRow
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.reach.preimages import MeasuredDeviations, ReachableSubspace
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import width
from sparserob_core.sip.convex_set import ConvexSet


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
        total = ball(0)
        rows = [
            (y, row) for y, row in rows if any(not x.is_zero() for innovation in row.innovations for x in innovation)
        ]
        if not rows:
            return total
        K, m, d = len(self.answers), self.control.dimension, self.loop.outputs
        slopes = stacked([[ball(y) * row.slope[k][i] for y, row in rows] for k in range(K) for i in range(m)])
        innovations = stacked([[x for innovation in row.innovations for x in innovation] for _, row in rows])
        product = (slopes * innovations).tolist()
        widths = [width(known(self.control), i) for i in range(m)]
        for k in range(K):
            clusters = self._cluster_breakpoints(k)
            for i in range(m):
                sizes = [ball(0)]
                for members, inverse, blocks in clusters:
                    z = (
                        inverse * stacked([[product[k * m + i][j * d + s]] for j in members for s in range(d)])
                    ).entries()
                    shares = iter(z)
                    sizes += [
                        sum((abs(next(shares)) / length for _, length in self._segments[block]), ball(0))
                        for block in blocks
                    ]
                total = total + widths[i] * largest(sizes)
        return total

    def _cluster_breakpoints(self, k: int) -> list[tuple[list[int], arb_mat, list[int]]]:
        """Return the breakpoints that the control on a piece answers, in clusters: those that measure a common block
        are together. Each has its breakpoints, the matrix of `_compute_inverse`, and its blocks."""
        groups: list[tuple[list[int], set[int]]] = []
        for j in np.flatnonzero(self.answers[k, : k + 1]).tolist():
            measured_blocks = {block for block in self.loop.innovation_matrices[j] if self._segments[block]}
            if not measured_blocks:
                continue
            cluster, separate = ([j], measured_blocks), []
            for members, blocks in groups:
                if blocks & cluster[1]:
                    cluster = (members + cluster[0], cluster[1] | blocks)
                else:
                    separate.append((members, blocks))
            groups = [*separate, cluster]
        return [(sorted(members), *self._compute_inverse(tuple(sorted(members)))) for members, _ in groups]

    @remembered()
    def _compute_inverse(self, members: tuple[int, ...]) -> tuple[arb_mat, list[int]]:
        """Return a generalised inverse ``(q, J d)`` of the matrix from the blocks to the states measured at these
        breakpoints, and the numbers of the blocks. From measurements it gives deviations with the same measurements."""
        blocks = sorted({block for j in members for block in self.loop.innovation_matrices[j] if self._segments[block]})
        d = self.loop.outputs
        table: list[list[arb]] = []
        for j in members:
            responses = self.loop.innovation_matrices[j]
            response_rows = {
                block: _multiply_by_segments(response, self._segments[block])
                for block, response in responses.items()
                if block in blocks
            }
            table += [
                [
                    x
                    for block in blocks
                    for x in (response_rows[block][s] if block in response_rows else self._list_zeros(block))
                ]
                for s in range(d)
            ]
        groups = [self._find_measuring_states(block) for block in blocks]
        pattern = np.vstack(
            [np.hstack([g.pattern & (b in self.loop.innovation_matrices[j])
                        for g, b in zip(groups, blocks, strict=True)])
             for j in members]
        )  # fmt: skip
        state_count = max(group.states for group in groups)
        rows = [(d * (k + 1), state_count) for k in range(len(members))]
        ends = np.cumsum([group.pattern.shape[1] for group in groups]).tolist()
        columns = [(end, group.entries) for end, group in zip(ends, groups, strict=True)]
        reach = np.array([float(length) for block in blocks for _, length in self._segments[block]])
        return MeasuredDeviations(stacked(table), pattern, rows, columns, reach).inverse(), blocks

    def _list_zeros(self, block: int) -> list[arb]:
        """Return zeros, one for each of the segments of a block."""
        return [ball(0.0)] * len(self._segments[block])

    def _find_measuring_states(self, block: int) -> ReachableSubspace:
        """Return which states can measure the deviations of a block; each state measures its own initial deviation."""
        loop, vectors = self.loop, [vector for vector, _ in self._segments[block]]
        if loop.measured is not None:  # through the observer every output may measure every deviation
            return ReachableSubspace(np.ones((loop.outputs, len(vectors)), dtype=bool), loop.outputs, len(vectors))
        if loop.initial is not None and block == loop.deviations.initial_block:
            return ReachableSubspace(
                np.array([[bool(v) for v in row] for row in vectors]).T, len(vectors), len(vectors)
            )
        return self._find_states_along(vectors)

    @remembered(key=lambda self, vectors: tuple(map(tuple, vectors)))
    def _find_states_along(self, vectors: list[list[Fraction]]) -> ReachableSubspace:
        """Return which states can measure deviations along some directions."""
        return self.loop.find_reachable_subspace(vectors)

    @cached_property
    def _segments(self) -> list[list[tuple[list[Fraction], arb]]]:
        """For every block the directions along which its set is long, with the lengths; empty for a block that cannot
        deviate, which is never measured."""
        loop = self.loop
        segments = {id(shape): known(shape).spans(middle) for shape, middle in loop.deviations.sets}
        return [segments[id(shape)] for shape, _ in loop.deviations.sets]


def reach(shape: ConvexSet, channel: int) -> arb:
    """Return the largest absolute value of a channel over a set."""
    axis = np.eye(shape.dimension)[channel]
    high, low = (known(shape).support(balls(sign * axis)) for sign in (1.0, -1.0))
    return high.max(low).max(high * 0)


def _multiply_by_segments(response: arb_mat, segments: Sequence[tuple[list[Fraction], arb]]) -> list[list[arb]]:
    """Return the matrix of a block times its segments: the coefficients of the segments in every entry."""
    rows, columns = response.tolist(), [[(b, v) for b, v in enumerate(vector) if v] for vector, _ in segments]
    return [
        [sum((row[b] if v == 1 else row[b] * rational(v) for b, v in column), ball(0)) for column in columns]
        for row in rows
    ]
