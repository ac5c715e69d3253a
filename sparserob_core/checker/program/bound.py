"""Weak duality of a stated program in ball arithmetic: a lower bound of its objective, or that nothing is feasible.

Let ``y >= 0`` be multipliers of rows ``r(x) <= 0`` and ``mu`` any multipliers of equalities ``e(x) = 0``. Then no
feasible decision costs less than the least value of ``c(x) + sum y r(x) + sum mu e(x)`` over the bounds alone. Products
of the objective are those of its own diagonal, or else are replaced by their tangent at a point, which lies below them.

An entry without a bound needs a slope of exactly 0, which written numbers do not give. So some multipliers are moved:
as many as there are such entries, by the solution of a linear system in balls. These are still multipliers if none is
negative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, is_semidefinite, largest, rational, rationals, smallest
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.stated.statement import StatedProgram
from sparserob_core.sip.stated.terms import AffineFunction

MAX_JOINED_ENTRIES = 300  # in products with each other: twice as many take eight times as long, a minute
MAX_EXACT = 60  # in products whose sum is 0 along a line: fractions grow, and twice as many take sixteen times as long
INDEPENDENT = 1e-11  # of the largest entry: a smaller pivot is rounding, and a larger one gives wide balls at worst


@final
@dataclass(frozen=True, eq=False)
class WeightedRow:
    """An affine function ``coefficients x + constant`` with its multiplier, which is not negative or ``is_free``."""

    coefficients: Sequence[arb]
    constant: arb
    multiplier: arb
    is_free: bool = False


def row_of_term(term: AffineFunction, multiplier: float, n: int, is_free: bool = False) -> WeightedRow:
    """Return a row of numbers with its multiplier."""
    coefficients = [ball(0.0)] * n
    for position, value in zip(term.positions.tolist(), term.coefficients.tolist(), strict=True):
        coefficients[position] = ball(value)
    return WeightedRow(coefficients, ball(term.constant), ball(multiplier), is_free)


@final
class Lagrangian:
    """The objective plus weighted rows, of which the least value over the bounds is a lower bound.

    Parameters
    ----------
    program : StatedProgram
        The program.
    rows : sequence of WeightedRow
        Its rows with their multipliers.
    tangent : array (n,) or None
        Point at which products of the objective are replaced by their tangent, where they are not those of a diagonal.
    is_priced : bool
        Whether the objective counts; without it a positive bound proves that nothing is feasible.
    """

    def __init__(
        self, program: StatedProgram, rows: Sequence[WeightedRow], tangent: Array | None, is_priced: bool
    ) -> None:
        n = program.decisions.n
        self.n, self.rows = n, list(rows)
        self.lower, self.upper = program.bounds
        self.constant, self.slope, self.weights = ball(0.0), [ball(0.0)] * n, [ball(0.0)] * n
        self.quadratic: dict[tuple[int, int], arb] = {}
        self.products: Mapping[tuple[int, int], Fraction] = {}
        if is_priced:
            self._add_objective(program)
        self.is_diagonal = all(i == j for i, j in self.quadratic)
        self.tangent = [ball(value) for value in (np.zeros(n) if tangent is None else tangent)]

    def _add_objective(self, program: StatedProgram) -> None:
        polynomial = program.polynomial
        self.constant, self.products = rational(polynomial.constant), polynomial.products
        for position, value in polynomial.slopes.items():
            self.slope[position] = rational(value)
        for (i, j), product in polynomial.products.items():
            for key in ((i, j), (j, i)):
                self.quadratic[key] = self.quadratic.get(key, ball(0.0)) + rational(product)
        for weight, (place, factor) in program.absolutes:
            self.weights[place] = self.weights[place] + ball(weight) * abs(ball(factor))

    def require_convex(self) -> None:
        """Raise `Broken` where the objective is certainly not convex, and `Unchecked` where it is not shown to be."""
        entries = sorted({i for key in self.quadratic for i in key})
        if any(weight < 0 for weight in self.weights) or any(self.quadratic.get((i, i), arb(0)) < 0 for i in entries):
            raise Broken("the objective is not convex")
        if self.is_diagonal:
            return
        if len(entries) > MAX_JOINED_ENTRIES:
            raise Unchecked(
                f"products of more than {MAX_JOINED_ENTRIES} entries of the decision are not shown to be convex"
            )
        table = [[self.quadratic.get((i, j), arb(0)) for j in entries] for i in entries]
        for k, pivot_row in enumerate(table):
            if not pivot_row[k] > 0:
                _require_semidefinite(self.products)
                return
            for row in table[k + 1 :]:
                share = row[k] / pivot_row[k]
                row[k:] = [a - share * b for a, b in zip(row[k:], pivot_row[k:], strict=True)]

    def bound(self) -> arb:
        """Return a ball whose lower end is the bound."""
        self.require_convex()
        slope = self._sum_slopes()
        corrected: set[int] = set()
        while free := [j for j in range(self.n) if j not in corrected and self._needs_correction(j, slope[j])]:
            corrected |= set(free)  # a correction moves other slopes too, so that they are looked at again
            self._take_middles()
            self._correct(sorted(corrected), self._sum_slopes())
            slope = self._sum_slopes()
        total = self.constant + sum((row.multiplier * row.constant for row in self.rows), ball(0.0))
        if not self.is_diagonal:
            entries = ((value, self.tangent[i], self.tangent[j]) for (i, j), value in self.quadratic.items())
            total = total - sum((value * a * b for value, a, b in entries), ball(0.0)) / 2
        return total + sum(
            (ball(0.0) if j in corrected else self._least_value(j, slope[j]) for j in range(self.n)), ball(0.0)
        )

    def _take_middles(self) -> None:
        """Replace multipliers and tangent by the middles of their balls. Any numbers will do, and balls of a correction
        would widen with every further one."""
        self.rows = [
            WeightedRow(row.coefficients, row.constant, arb(row.multiplier.mid()), row.is_free) for row in self.rows
        ]
        self.tangent = [arb(value.mid()) for value in self.tangent]

    def _sum_slopes(self) -> list[arb]:
        slope = list(self.slope)
        for row in self.rows:
            for j, coefficient in enumerate(row.coefficients):
                if not coefficient.is_zero():
                    slope[j] = slope[j] + row.multiplier * coefficient
        if not self.is_diagonal:
            for (i, j), value in self.quadratic.items():
                slope[i] = slope[i] + value * self.tangent[j]
        return slope

    def _curvature(self, j: int) -> arb | None:
        return self.quadratic.get((j, j)) if self.is_diagonal else None

    def _needs_correction(self, j: int, slope: arb) -> bool:
        """Return whether an entry has no bound on a side on which its slope lets it fall for ever."""
        if self._curvature(j) is not None:
            return False
        falls_up = np.isposinf(self.upper[j]) and not slope + self.weights[j] >= 0
        falls_down = np.isneginf(self.lower[j]) and not slope - self.weights[j] <= 0
        return bool(falls_up or falls_down)

    def _correct(self, free: Sequence[int], slope: Sequence[arb]) -> None:
        """Move as many multipliers as there are entries of which the slope has to be its limit exactly."""
        targets = [self._choose_target(j, slope[j]) for j in free]
        columns = [(k, [row.coefficients[j] for j in free]) for k, row in enumerate(self.rows)]
        columns = [(k, column) for k, column in columns if self.rows[k].is_free or self.rows[k].multiplier > 0]
        if not self.is_diagonal:
            zero = ball(0.0)
            columns += [(-1 - i, [self.quadratic.get((j, i), zero) for j in free]) for i in range(self.n)]
        matrix = np.array([[float(value.mid()) for value in column] for _, column in columns]).reshape(-1, len(free)).T
        sizes = np.array([1.0 if k < 0 else abs(float(self.rows[k].multiplier.mid())) for k, _ in columns])
        chosen = _choose_columns(matrix, sizes)
        if len(chosen) < len(free):
            raise Unchecked(
                f"the multipliers leave {len(free) - len(chosen)} entries of the decision without a slope that is 0"
            )
        table = arb_mat([[columns[c][1][i] for c in chosen] for i in range(len(free))])
        right = arb_mat([[target - slope[j]] for j, target in zip(free, targets, strict=True)])
        try:
            change = table.solve(right)
        except ZeroDivisionError:
            raise Unchecked("the multipliers of entries without bounds cannot be told apart") from None
        for c, delta in zip(chosen, change.entries(), strict=True):
            k = columns[c][0]
            if k < 0:
                self.tangent[-1 - k] = self.tangent[-1 - k] + delta
                continue
            row = self.rows[k]
            multiplier = row.multiplier + delta
            if not row.is_free and not multiplier >= 0:
                raise Unchecked("a multiplier that gives an entry without bounds its slope would be negative")
            self.rows[k] = WeightedRow(row.coefficients, row.constant, multiplier, row.is_free)

    def _choose_target(self, j: int, slope: arb) -> arb:
        """Return the slope nearest to the one of an entry with which it does not fall for ever."""
        weight, target = self.weights[j].abs_lower(), slope
        if np.isposinf(self.upper[j]):
            target = largest([target, -weight])
        if np.isneginf(self.lower[j]):
            target = smallest([target, weight])
        return arb(target.mid()) if weight > 0 else ball(0.0)

    def _least_value(self, j: int, slope: arb) -> arb:
        """Return a ball whose lower end is at most ``weight |t| + slope t + curvature t^2 / 2`` over the bounds."""
        weight, curvature = self.weights[j], self._curvature(j)
        ends = [ball(end) for end in (float(self.lower[j]), float(self.upper[j])) if np.isfinite(end)]
        if curvature is None:
            values = [weight * abs(end) + slope * end for end in ends]
            if self.lower[j] <= 0.0 <= self.upper[j]:
                values.append(ball(0.0))
            return smallest(values)
        excess = largest([abs(slope) - weight, ball(0.0)])
        inside = -excess * excess / (2 * curvature)
        if not ends:
            return inside
        best = float((-slope / curvature).mid())
        if not weight.is_zero():
            best = float(np.sign(best)) * max(abs(best) - float((weight / curvature).mid()), 0.0)
        at = ball(float(np.clip(best, self.lower[j], self.upper[j])))
        if at.is_zero():
            return inside
        turn = slope + curvature * at + (weight if at > 0 else -weight)  # the derivative where the entry stands
        value = weight * abs(at) + slope * at + curvature * at * at / 2
        changes = [turn * (end - at) for end in ends] if len(ends) == 2 else [-turn * turn / (2 * curvature)]
        return largest([inside, value + smallest([*changes, ball(0.0)])])


def _require_semidefinite(products: Mapping[tuple[int, int], Fraction]) -> None:
    """Raise `Broken` where a sum of products of entries is negative somewhere."""
    entries = sorted({i for key in products for i in key})
    if len(entries) > MAX_EXACT:
        raise Unchecked(f"products of more than {MAX_EXACT} entries, whose sum may be 0, are not shown to be convex")
    table = [[(1 + (i == j)) * products.get((min(i, j), max(i, j)), Fraction(0)) for j in entries] for i in entries]
    if not is_semidefinite(rationals(table)):
        raise Broken("the objective is not convex")


def _choose_columns(matrix: Array, sizes: Array) -> list[int]:
    """Return columns that are independent, those of large multipliers first, by elimination in doubles: a wrong choice
    proves nothing, and does no harm."""
    rest, order = matrix.copy(), list[int]()
    scale = np.abs(rest).max(axis=0, initial=0.0)
    remaining = np.ones(matrix.shape[0], dtype=bool)
    while remaining.any():
        pivots = np.abs(rest[remaining])
        is_independent = pivots > INDEPENDENT * scale
        if not is_independent.any():
            break
        place, column = np.unravel_index(int(np.where(is_independent, pivots * sizes, -1.0).argmax()), pivots.shape)
        row = np.flatnonzero(remaining)[place]
        order.append(int(column))
        rest = rest - np.outer(rest[:, column] / rest[row, column], rest[row])
        rest[:, column] = 0.0
        remaining[row] = False
    return order
