"""The convex terms of a cost in a linear program that grows: each is one variable above its tangents (Kelley 1960).

A quadratic form is a sum of squares along its eigenvectors, ``x'P x / 2 = sum_i t_i^2 / 2``, and every square has a
variable of its own. Tangents of one square are exact where they touch, and between two of them below it by no more than
an eighth of the square of their distance. So they are as close as is wanted after a few rounds, however many squares
there are. (One variable for the whole form would need as many rounds as there are directions.) The norm of a block is
the largest of ``d's`` over unit vectors ``d``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Directions, FiniteProgram
from sparserob_core.sip.inner.norms import spread_directions

Entries = list[tuple[np.ndarray, np.ndarray, Array]]

# Of the largest eigenvalue one that is rounding, as LAPACK computes them. Ten times less, and rounding of P counts as
# squares, which cost variables; ten times more, and up to 1e-14 of the cost at its bounds is left out of the program
# (not of what is claimed: costs are recomputed, and bounds are those of tangents of P itself).
ROUNDED_EIGENVALUE = 1e-15
# Slopes by which the rows of tangents are divided, at least: so what HiGHS leaves of a row is a share of a root, not of
# a square. (Undivided, policies whose cost is squares alone ended with gaps of 1.8e-7 after 202 programs; divided, they
# close after 25.) A hundredth of it changes nothing there, and puts entries of 1e6 beside dust; ten thousand times as
# much is not to divide at all.
FINE = 1e-4


class Linear(Protocol):
    """A linear program to which columns and rows are added."""

    def variables(self, lower: Array, upper: Array, cost: Array) -> np.ndarray:
        """Add columns, and return their numbers."""

    def rows(self, entries: Entries, lower: Array, upper: Array) -> np.ndarray:
        """Add rows, and return their numbers."""


@final
@dataclass(eq=False)
class Tangents:
    """The norms of blocks and the squares of a program's cost over the columns of ``linear``, of which the first
    ``2 n`` are the positive and the negative parts of the decision.

    ``roots (n, c)``: ``t = roots'x`` are the squares' roots.
    """

    program: FiniteProgram
    linear: Linear

    def __post_init__(self) -> None:
        blocks = self.program.blocks
        self.roots = _factor_quadratic(self.program)
        count = self.roots.shape[1]
        none, free = np.zeros(count), np.full(count, np.inf)
        self._squares = self.linear.variables(none, free, np.ones(count))
        self._t = self.linear.variables(-free, free, none)
        if count:
            row, column = np.nonzero(self.roots.T)
            value, n = self.roots.T[row, column], self.program.n
            split = [(row, column, value), (row, column + n, -value), (np.arange(count), self._t, -np.ones(count))]
            self.linear.rows(split, none, none)
        self._tangent_rows: list[np.ndarray] = [np.zeros(0, dtype=int)]  # numbers of the tangents' rows
        self._square_numbers: list[np.ndarray] = [np.zeros(0, dtype=int)]  # the square of each
        self._touching_points: list[Array] = [np.zeros(0)]  # and where it touches that
        self._direction_rows: list[tuple[np.ndarray, Directions]] = []  # numbers of the rows of directions, and these
        if blocks is not None:
            weights = self.program.weights[blocks.first]
            self._norms = self.linear.variables(np.zeros(weights.size), np.full(weights.size, np.inf), weights)
            self._add_directions(spread_directions(blocks))

    def sharpen(self, x: Array, squares: Array) -> None:
        """Touch every norm at ``x (n,)`` and every square at the root ``(c,)`` that the linear program has."""
        count = squares.size
        if count:
            numbers = np.arange(count)
            size = np.maximum(np.abs(squares), FINE)
            entries = [(numbers, self._t, squares / size), (numbers, self._squares, -1.0 / size)]
            self._tangent_rows.append(self.linear.rows(entries, np.full(count, -np.inf), squares**2 / size / 2.0))
            self._square_numbers.append(numbers)
            self._touching_points.append(squares / size)
        blocks = self.program.blocks
        if blocks is not None:
            table, unit = blocks.table, np.append(blocks.directions(x), 0.0)
            directions = Directions(np.arange(len(table)), unit[table])
            kept = directions.vectors.any(axis=1)
            self._add_directions(Directions(directions.block[kept], directions.vectors[kept]))

    def _add_directions(self, directions: Directions) -> None:
        """Add rows by which the variable of a block's norm is at least ``d's``."""
        blocks, n = self.program.blocks, self.program.n
        assert blocks is not None
        count = directions.block.size
        if not count:
            return
        row, entry = np.nonzero(directions.vectors)
        column, value = blocks.table[directions.block[row], entry], directions.vectors[row, entry]
        ones = np.arange(count), self._norms[directions.block], -np.ones(count)
        entries = [(row, column, value), (row, column + n, -value), ones]
        self._direction_rows.append((self.linear.rows(entries, np.full(count, -np.inf), np.zeros(count)), directions))

    def below(self, columns: Array) -> tuple[float, Array, Array]:
        """Return the shortfall of the cost variables of a solution below the squares and norms that they stand for, as
        a cost.

        Also returns the decision ``(n,)`` of the solution and the roots ``(c,)`` of its squares.
        """
        n, blocks = self.program.n, self.program.blocks
        x, t = columns[:n] - columns[n : 2 * n], columns[self._t]
        shortfall = float(np.maximum(t**2 / 2.0 - columns[self._squares], 0.0).sum())
        if blocks is not None:
            weights = self.program.weights[blocks.first]
            shortfall += float(weights @ np.maximum(blocks.norms(x) - columns[self._norms], 0.0))
        return shortfall, x, t

    def touching(self, x: Array, multipliers: Array) -> Array:
        """Return the decision ``(n,)`` at which the slope of the cost is that of all tangents with their multipliers:
        there one tangent proves at least as much as they do together. Of a block whose entries have squares too it is
        only nearly that of the norm."""
        blocks, answer = self.program.blocks, x
        if blocks is not None:
            answer = x.copy()
            answer[blocks.entries] = 0.0
            for at, directions in self._direction_rows:
                row, entry = np.nonzero(directions.vectors)
                shares = np.maximum(multipliers[at], 0.0)[row] * directions.vectors[row, entry]
                np.add.at(answer, blocks.table[directions.block[row], entry], shares)
        at, squares, touched = (
            np.concatenate(arrays) for arrays in (self._tangent_rows, self._square_numbers, self._touching_points)
        )
        wanted = np.bincount(squares, np.maximum(multipliers[at], 0.0) * touched, self.roots.shape[1])
        sizes = (self.roots**2).sum(axis=0)
        point: Array = answer + self.roots @ ((wanted - self.roots.T @ answer) / np.where(sizes > 0.0, sizes, 1.0))
        return point


def _factor_quadratic(program: FiniteProgram) -> Array:
    """Return columns ``(n, c)``, at right angles, whose squares along a decision add up to ``x'P x``."""
    if program.P is None:
        return np.zeros((program.n, 0))
    if program.curvature is not None:
        variables = np.flatnonzero(program.curvature > 0.0)
        return np.asarray(np.eye(program.n)[:, variables] * np.sqrt(program.curvature[variables]))
    P: Any = program.P
    variables = np.flatnonzero(np.diff(P.indptr))
    values, vectors = np.linalg.eigh(P[variables][:, variables].toarray())
    kept = values > ROUNDED_EIGENVALUE * variables.size * values.max(initial=0.0)
    roots = np.zeros((program.n, int(kept.sum())))
    roots[variables] = vectors[:, kept] * np.sqrt(values[kept])
    return roots
