"""The robust counterpart of finitely many uncertain rows as one sparse linear program, and what its multipliers prove.

Where the deviations are entry by entry within ``[-r, r]``, the worst case of a row is ``g x + sum_q r_q |a_q| <= h``
with
``a = C x + d``. Absolute values are split into two parts that are not negative, those of variables at once, others by
one equality (Ben-Tal, El Ghaoui and Nemirovski 2009, section 1.3): an extended formulation, with all deviations at
once. For other sets the support function of every block is replaced by the largest over finitely many of its points,
which grow in number.

By the duality of linear programs the multipliers of a row with those of its equalities say one deviation in the set,
a mean of extreme ones. The row at this deviation is linear in the decision: so finitely many cuts, one for each row,
prove the same bound, and nothing but these cuts has to be believed.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from scipy.optimize import lsq_linear
from scipy.sparse import csr_array, vstack

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, Spread, UncertainRows, entries_of
from sparserob_core.sip.inner.simplex.growing import BELIEVED, HIGHS_ACCURACY, GrowingProgram
from sparserob_core.sip.inner.simplex.robust_bound import weighted
from sparserob_core.sip.inner.simplex.tangents import Tangents
from sparserob_core.sip.solver import AccountedSolver

# Of what is added up to the cost: by how much its tangents may be below it. HiGHS meets rows to 1e-10, and there is one
# tangent of every term, so that ten times less may not be reached; ten times more is a tenth of a gap that is asked for
# at 1e-8.
TANGENT_SHORTFALL = 1e-9
TOUCHED = 60  # rounds of tangents: each quarters what squares are below, 30 leave 1e-18 of it
PERTURBED = 1e-4  # of slopes: what a perturbed cost may leave; a hundredth of it is seen, and 1e-2 is another entry's
CORRECTIONS = 3  # of multipliers by least squares: the first two meet nearly all, and each takes as long as a round
# Of least squares within bounds, at most: what is left of a slope after some lowers a bound, which holds
LEAST_SQUARES_PASSES = 20
# Numbers in the table of rows that may get a multiplier; larger ones are left as they are. Ten times as many take
# seconds in each round, and with a tenth plans of 100 pieces keep slopes.
TIGHT_NUMBERS = 250_000
SAME_POINT_DISTANCE = 1e-12  # points of a set that are closer are one
# Share by which deviations of sets that are no boxes are drawn inwards, so that they are shown to be in them
DRAWN = 2.0**-41


@final
@dataclass(frozen=True, eq=False)
class RobustAnswer:
    """``x (n,)``, multipliers ``y (r,)`` of all rows in order and the deviation ``(r, Q)`` of each, ``mu (e,)``;
    ``slack``: by how much the rows must be relaxed, or the factor, where that was asked for. ``solved``: whether there
    is an answer; ``said``: the solver's words. ``at (n,)``: the decision at which the multipliers ask for the tangent
    of a cost that is not linear."""

    solved: bool
    said: str
    x: Array
    y: Array
    deviations: Array
    mu: Array
    slack: float = 0.0
    at: Array | None = None


@final
@dataclass(frozen=True, eq=False)
class _Part:
    """Linear expression of the worst case of one part: the variables ``columns`` times ``sizes``, plus a ``constant``.

    ``entries`` are those of the deviations in the part; ``at`` are the numbers of the equalities whose multipliers give
    these deviations. ``single``: every entry is a single variable, without equalities. For sets that are no boxes,
    ``points`` holds for every block its entries, its variable, its known points and the numbers of their rows.
    """

    columns: np.ndarray
    sizes: Array
    constant: float
    entries: np.ndarray
    at: np.ndarray
    single: bool = False
    points: tuple[tuple[slice, int, list[Array], list[int]], ...] = ()


@final
@dataclass(eq=False)
class Counterpart:
    """Uncertain rows over one program and one spread, to which rows are added; solved by HiGHS, from the last basis, or
    by who is ``asked``; ``answered``: whose answers there were, and how many.

    Its columns are the positive and the negative parts of the decision, a slack of all rows where it is ``elastic``
    (the only cost, at least ``lowest``), and what rows need beside them. Where it ``scales`` there is a factor instead,
    at most ``highest``, which is to be as large as possible: so many times as large are the deviations, and the
    variables that answer them answer the deviations of the factor 1. ``ceiling``: weights ``(n,)``, and what the
    weighted sum of absolute values of the decision may be at most.
    """

    program: FiniteProgram
    spread: Spread
    elastic: bool = False
    lowest: float = 0.0
    scales: bool = False
    highest: float = 0.0
    ceiling: tuple[Array, float] | None = None
    asked: AccountedSolver | None = None
    answered: Counter[str] = field(default_factory=Counter)
    blocks: list[UncertainRows] = field(default_factory=list)
    _imposed_rows: list[tuple[np.ndarray, Array, list[_Part]]] = field(default_factory=list, repr=False)
    _margin: float = 0.0

    def __post_init__(self) -> None:
        self._linear, self._x = GrowingProgram(self.asked), np.zeros(self.program.n)
        program, n = self.program, self.program.n
        low, high = program.lower, program.upper
        priced = not (self.elastic or self.scales)
        alone = np.ones(program.weights.size) if program.blocks is None else program.blocks.number < 0
        for side, sign in ((1.0, 1.0), (-1.0, -1.0)):
            ends = (low, high) if side > 0 else (-high, -low)
            cost = (program.weights * alone + sign * program.q) * priced
            self._linear.variables(np.maximum(ends[0], 0.0), np.maximum(ends[1], 0.0), cost)
        if self.elastic:
            self._linear.variables(np.full(1, self.lowest), np.full(1, np.inf), np.ones(1))
        if self.scales:
            self._linear.variables(np.zeros(1), np.full(1, self.highest), -np.ones(1))
        curved = priced and (program.P is not None or program.blocks is not None)
        self._tangents = Tangents(program, self._linear) if curved else None
        self._equality_rows = np.zeros(0, dtype=int)
        if program.b.size:
            row, column = np.nonzero(program.A)
            entries = _split_signs(row, column, program.A[row, column], n)
            self._equality_rows = self._linear.rows([entries], program.b, program.b)

        if self.ceiling is not None:
            (weights, limit), column = self.ceiling, np.flatnonzero(self.ceiling[0])
            both = np.concatenate([column, column + n])
            summed = (np.zeros(both.size, dtype=int), both, np.tile(weights[column], 2))
            self._linear.rows([summed], np.full(1, -np.inf), np.full(1, limit))

    def add(self, block: UncertainRows) -> None:
        """Impose rows from now on; exact ones as equations, unless they may be relaxed."""
        if block.exact and not (self.elastic and self.lowest == 0.0):
            table, rhs = block.equations
            table = table.tocoo()
            entries = [_split_signs(table.row, table.col, table.data, self.program.n)]
            if self.scales:  # what answers deviations answers those of the factor 1, times the factor
                answers = np.arange(rhs.size) % (1 + self.spread.size) > 0
                scaled_rows = np.flatnonzero(answers & (rhs != 0.0))
                entries.append((scaled_rows, np.full(scaled_rows.size, 2 * self.program.n), -rhs[scaled_rows]))
                rhs = np.where(answers, 0.0, rhs)
            at = self._linear.rows(entries, rhs, rhs)
            self.blocks.append(block)
            self._imposed_rows.append((at, rhs, []))
            return
        parts = [self._add_part(C, d) for C, d in zip(block.C, block.d, strict=True)]
        count, limits = block.h.size, block.h.copy()
        entries = [_split_signs(*entries_of(block.g), self.program.n)]
        for p, part in enumerate(parts):
            rows = np.flatnonzero(block.part == p)
            scale = np.abs(block.factor[rows])
            if self.scales:
                entries.append((rows, np.full(rows.size, 2 * self.program.n), scale * part.constant))
            else:
                limits[rows] -= scale * part.constant
            row, column = np.repeat(rows, part.columns.size), np.tile(part.columns, rows.size)
            entries.append((row, column, (scale[:, None] * part.sizes).ravel()))
        if self.elastic:
            entries.append((np.arange(count), np.full(count, 2 * self.program.n), -np.ones(count)))
        where = self._linear.rows(entries, np.full(count, -np.inf), limits - self._margin)
        self.blocks.append(block)
        self._imposed_rows.append((where, limits, parts))

    def _add_part(self, C: csr_array, d: Array) -> _Part:
        if not self.spread.is_box:
            return self._add_part_by_points(C, d)
        radii, counts, n = self.spread.radii, np.diff(C.indptr), self.program.n
        entries = np.flatnonzero(counts)
        constant = float(radii[counts == 0] @ np.abs(d[counts == 0]))
        if not (counts > 1).any() and not d[entries].any():
            sizes = np.abs(C.data) * radii[entries]
            columns, none = np.concatenate([C.indices, C.indices + n]), np.zeros(0, dtype=int)
            return _Part(columns, np.tile(sizes, 2), constant, entries, none, single=True)
        count = entries.size
        free, nothing = np.full(count, np.inf), np.zeros(count)
        pairs = [self._linear.variables(nothing, free, nothing) for _ in range(2)]
        rows, ones = np.arange(count), np.ones(count)
        inner = _split_signs(np.repeat(rows, counts[entries]), C.indices, C.data, n)
        split = [inner, (rows, pairs[0], -ones), (rows, pairs[1], ones)]
        if self.scales:
            split.append((rows, np.full(count, 2 * n), d[entries]))
        rhs = nothing if self.scales else -d[entries]
        at = self._linear.rows(split, rhs, rhs)
        if not self.scales:  # begin where the last solution leaves nothing of these equations
            self._linear.enter(np.where((C @ self._x + d)[entries] >= 0.0, *pairs), at)
        return _Part(np.concatenate(pairs), np.tile(radii[entries], 2), constant, entries, at)

    def _add_part_by_points(self, C: csr_array, d: Array) -> _Part:
        """Return a part with one new variable for each block of the spread.

        The variable is at least the value of the block at each of its known points; at first only 0 is known.
        """
        points: list[tuple[slice, int, list[Array], list[int]]] = []
        for span, count, convex, _ in self.spread.parts:
            q = convex.dimension
            for a in range(span.start, span.start + count * q, q):
                if C.indptr[a + q] > C.indptr[a] or d[a : a + q].any():
                    (name,) = self._linear.variables(np.zeros(1), np.full(1, np.inf), np.zeros(1)).tolist()
                    points.append((slice(a, a + q), name, [], []))
        names, none = np.array([name for _, name, _, _ in points], dtype=int), np.zeros(0, dtype=int)
        return _Part(names, np.ones(names.size), 0.0, none, none, points=tuple(points))

    def sharpen(self, x: Array) -> bool:
        """Impose the worst points of every imposed row at ``x (n,)``, where the sets are no boxes.

        Returns ``False`` where all of them were known, and for boxes, whose worst case is exact.
        """
        if self.spread.is_box:
            return False
        entries: list[tuple[np.ndarray, np.ndarray, Array]] = []
        limits: list[float] = []
        first = self._linear.count
        coefficients = [
            block.coefficients(x) for block, (_, _, parts) in zip(self.blocks, self._imposed_rows, strict=True) if parts
        ]
        deviations = self.spread.worst(np.concatenate([*coefficients, np.zeros((0, self.spread.size))]))
        index = 0
        for block, (_, _, parts) in zip(self.blocks, self._imposed_rows, strict=True):
            for part, C, d in zip(parts, block.C, block.d, strict=False):  # none of an equality
                worst, index = deviations[index], index + 1
                for span, name, points, at in part.points:
                    point = worst[span]
                    if any(np.abs(point - previous).max() <= SAME_POINT_DISTANCE for previous in points):
                        continue
                    points.append(point)
                    at.append(first + len(limits))
                    row = (C[span].T @ point).reshape(-1)
                    column = np.flatnonzero(row)
                    number = np.full(column.size, len(limits))
                    entries.append(_split_signs(number, column, row[column], self.program.n))
                    entries.append((np.array([len(limits)]), np.array([name]), -np.ones(1)))
                    offset = float(point @ d[span])
                    if self.scales:
                        entries.append((np.array([len(limits)]), np.array([2 * self.program.n]), np.array([offset])))
                    limits.append(0.0 if self.scales else -offset)
        if limits:
            self._linear.rows(entries, np.full(len(limits), -np.inf), np.array(limits))
        return bool(limits)

    @property
    def basis(self) -> Any:
        """Basis of the last answer, for `begin` of a program with the same rows and variables."""
        return self._linear.highs.getBasis()

    def begin(self, basis: Any) -> None:
        """Solve from there the next time; what is added beforehand begins slack, or at 0."""
        self._linear.highs.setBasis(basis)

    @property
    def approximate(self) -> bool:
        """True where the cost is replaced by tangents, so that the accuracy of an answer can be chosen."""
        return self._tangents is not None

    def solve(self, margin: float = 0.0, accuracy: float = 0.0, seconds: float = np.inf) -> RobustAnswer:
        """Return the optimum with every row tightened by ``margin``, to about ``accuracy`` in the cost where that has
        tangents; where it is elastic, how far the rows must be relaxed so that they can be met. It is not solved where
        ``seconds`` do not suffice."""
        if margin != self._margin:
            self._margin = margin
            for where, limits, parts in self._imposed_rows:
                if parts:
                    self._linear.limit(where, limits - margin)
        until = time.monotonic() + seconds
        for rounds in reversed(range(TOUCHED)):
            solved, message, columns, rows = self._linear.solve(until - time.monotonic())
            self.answered[self._linear.by] += 1
            if not solved:
                none = np.zeros(0)
                return RobustAnswer(False, message, none, none, np.zeros((0, 0)), none)
            if self._tangents is None:
                break
            shortfall, decided, roots = self._tangents.below(columns)
            if shortfall <= max(accuracy, TANGENT_SHORTFALL * self.program.added(decided)) or not rounds:
                break  # the last ones are not sharpened: their multipliers are those of the rows that were solved with
            self._tangents.sharpen(decided, roots)
        n, mu = self.program.n, rows[self._equality_rows]
        x = self._x = columns[:n] - columns[n : 2 * n]
        at = None if self._tangents is None else self._tangents.touching(x, rows)
        y, deviations = self._recover_multipliers(rows, mu, at)
        slack = float(columns[2 * n]) if self.elastic or self.scales else 0.0
        return RobustAnswer(True, message, x, y, deviations, mu, slack, at)

    def _recover_multipliers(self, even: Array, mu: Array, touched: Array | None) -> tuple[Array, Array]:
        """Return the multipliers ``(r,)`` of all rows, and the deviations ``(r, Q)`` that those of the parts stand
        for."""
        y, deviations = self._read_multipliers(even)
        priced = self.program if touched is None else self.program.tangent(touched)
        if not (self.elastic or self.scales):
            self._refine_multipliers(mu @ self.program.A + priced.q, priced.weights, y)
        terms = [(np.zeros(0, dtype=int), np.zeros(0))]
        late: list[tuple[UncertainRows, int, _Part, np.ndarray, float]] = []
        first = 0
        for block, (where, _, parts) in zip(self.blocks, self._imposed_rows, strict=True):
            multipliers = y[first : first + block.h.size]
            if not parts:
                table = even[where].reshape(block.h.size // 2, -1).copy()
                table[:, 0] = np.subtract(*multipliers.reshape(2, -1))
                terms.append(weighted(table.ravel(), block.equations[0]))
            elif multipliers.any():
                terms.append(weighted(multipliers, block.g))
            for p, part in enumerate(parts):
                rows = np.flatnonzero(block.part == p)
                total = float(multipliers[rows] @ np.abs(block.factor[rows]))
                if total <= 0.0:
                    continue
                if part.single:
                    late.append((block, p, part, first + rows, total))
                    continue
                w = self._find_constant_deviations(block, p)
                limit = self.spread.radii[part.entries]
                w[part.entries] = np.clip(even[part.at] / total, -limit, limit)
                for span, _, points, at in part.points:
                    shares = np.maximum(even[np.array(at, dtype=int)], 0.0)
                    weight = max(total, float(shares.sum()))  # what is missing to it is the share of 0
                    w[span] = shares @ np.array(points) / weight if points else 0.0
                terms.append(weighted(total * w, block.C[p]))
                deviations[first + rows] = np.sign(block.factor[rows])[:, None] * w
            first += block.h.size
        column, value = (np.concatenate(arrays) for arrays in zip(*terms, strict=True))
        slope = mu @ self.program.A + (0.0 if self.elastic else priced.q)
        slope = slope + np.bincount(column, value, self.program.n)
        is_balanced = self._balance_slopes(slope, deviations, late)
        free = self._find_inner_variables() & ~is_balanced & (priced.weights == 0.0)
        self._refine_deviations(slope, free, y, deviations)
        if not self.spread.is_box:
            deviations = deviations + DRAWN * (self.spread.inner - deviations)
        return y, deviations

    def _read_multipliers(self, even: Array) -> tuple[Array, Array]:
        """Return the multipliers of all rows, and the deviations of exact ones, 0 for the others. The multipliers of
        equations are those of one row at a deviation and of its opposite at none. A multiplier that is negative, by
        less than the tolerance of the solver, is one of the opposite row, if there is one."""
        y, deviations = [np.zeros(0)], [np.zeros((0, self.spread.size))]
        for block, (where, _, parts) in zip(self.blocks, self._imposed_rows, strict=True):
            multipliers, w = np.maximum(even[where], 0.0), np.zeros((block.h.size, self.spread.size))
            for negative in np.flatnonzero(even[where] < 0.0).tolist() if parts else ():
                opposite = _find_opposite(block, negative)
                if opposite is not None:
                    multipliers[opposite] -= even[where][negative]
            if not parts:
                half = block.h.size // 2
                table = even[where].reshape(half, -1)
                multipliers = np.zeros(block.h.size)
                for row, (plain, *answers) in enumerate(table):
                    multipliers[row], w[row] = self._split_product(float(plain), np.array(answers))
                    multipliers[half + row] = multipliers[row] - plain
            y.append(multipliers)
            deviations.append(w)
        return np.concatenate(y), np.vstack(deviations)

    def _split_product(self, plain: float, answers: Array) -> tuple[float, Array]:
        """Return a multiplier of at least ``plain`` and a deviation whose product is ``answers (Q,)``."""
        free = self.spread.radii > 0.0
        answers = np.where(free, answers, 0.0)
        size = max(plain, float((np.abs(answers[free]) / self.spread.radii[free]).max(initial=0.0)))
        if size <= 0.0:
            return 0.0, np.zeros(answers.size)
        multiplier = float(np.exp2(np.ceil(np.log2(size))))  # a power of two, by which nothing is rounded
        while not self.spread.holds(answers / multiplier):
            multiplier *= 2.0
        return multiplier, answers / multiplier

    def _find_constant_deviations(self, block: UncertainRows, p: int) -> Array:
        """Return the worst deviations where no decision enters a part; 0 elsewhere."""
        w = np.zeros(self.spread.size)
        if self.spread.is_box:
            bare = np.diff(block.C[p].indptr) == 0
            w[bare] = np.sign(block.d[p][bare]) * self.spread.radii[bare]
        return w

    def _balance_slopes(
        self, slope: Array, deviations: Array, late: list[tuple[UncertainRows, int, _Part, np.ndarray, float]]
    ) -> np.ndarray:
        """Set the deviations of the parts whose entries are single variables, such that no slope is left in these, as
        far as their sets allow, shared by the rows in which a variable is. Return which variables ``(n,)`` these
        are."""
        reach = np.zeros(self.program.n)
        for block, p, part, _, total in late:
            np.add.at(reach, block.C[p].indices, total * np.abs(block.C[p].data) * self.spread.radii[part.entries])
        share = np.zeros(self.program.n)
        np.divide(-slope, reach, out=share, where=reach > 0.0)
        share = np.clip(share, -1.0, 1.0)
        for block, p, part, rows, _ in late:
            w = self._find_constant_deviations(block, p)
            w[part.entries] = np.sign(block.C[p].data) * share[block.C[p].indices] * self.spread.radii[part.entries]
            at = rows - rows[0] + np.flatnonzero(block.part == p)[0]
            deviations[rows] = np.sign(block.factor[at])[:, None] * w
        return reach > 0.0

    def _find_inner_variables(self) -> np.ndarray:
        """Return which entries ``(n,)`` of the last answer are between their bounds: others may keep a slope."""
        return (self._x > self.program.lower) & (self._x < self.program.upper)

    def _refine_multipliers(self, slope: Array, weights: Array, y: Array) -> None:
        """Correct multipliers, such that less is left of slopes in the variables that answer nothing.

        No slope is left in variables between their bounds, and none that draws others from where they are. ``slope
        (n,)`` and ``weights (n,)`` are those of the cost and of equalities. HiGHS perturbs costs by 1e-6, and its last
        basis may be that of perturbed costs, or too inexact for other ones.
        """
        sizes = self._find_adjustable_sizes(y)
        active = np.flatnonzero(sizes > 0.0)
        if not active.size:
            return
        rows = csr_array(vstack([block.g for block in self.blocks]))
        answering = np.concatenate([C.indices for block in self.blocks for C in block.C])
        is_inner, is_corrected = self._find_inner_variables(), np.zeros(self.program.n, dtype=bool)
        for _ in range(CORRECTIONS):  # what one of them corrects may draw other variables
            balanced = self._balance_at_bounds(slope + y @ rows, weights)
            residual = slope + y @ rows - balanced
            # of an answer that is no vertex, entries near a bound or near 0 have slopes of their own
            is_small = np.abs(residual) <= PERTURBED * max(1.0, float(np.abs(slope).max(initial=0.0)))
            is_corrected |= is_small & ((residual != 0.0) | is_inner)
            is_corrected[answering] = False
            columns = np.flatnonzero(is_corrected)
            if np.abs(residual[columns]).max(initial=0.0) <= HIGHS_ACCURACY:
                return
            shares = rows[active][:, columns].T.toarray() * sizes[active]
            change = sizes[active] * np.linalg.lstsq(shares, -residual[columns], rcond=SAME_POINT_DISTANCE)[0]
            y[active] = np.maximum(y[active] + change, 0.0)
        if np.abs(slope - balanced + y @ rows)[columns].max() > HIGHS_ACCURACY:
            self._enter_tight_rows(slope, weights, balanced, rows, (sizes > 0.0), columns, y)

    def _balance_at_bounds(self, slope: Array, weights: Array) -> Array:
        """Return the part ``(n,)`` of a slope that the weights of absolute values and the bounds of the variables keep
        in balance where these are."""
        x, low, high = self._x, self.program.lower, self.program.upper
        kept = np.where(x == 0.0, np.clip(slope, -weights, weights), -weights * np.sign(x))
        excess = slope - kept
        return (
            kept + np.where(x <= low, np.maximum(excess, 0.0), 0.0) + np.where(x >= high, np.minimum(excess, 0.0), 0.0)
        )

    def _enter_tight_rows(
        self,
        slope: Array,
        weights: Array,
        balanced: Array,
        rows: csr_array,
        is_active: np.ndarray,
        columns: np.ndarray,
        y: Array,
    ) -> None:
        """Correct multipliers, those of rows without one among them, such that less is left of slopes in ``columns``
        beside what is ``balanced (n,)``.

        Multipliers below the tolerance of a solver are 0 in its answer. Rows that hold with equality in the answer, and
        in which nothing deviates, may have one. A change is made only where it raises the bound.
        """
        slack = np.concatenate([block.h for block in self.blocks]) - rows @ self._x
        is_tight = self._find_certain_rows() & (np.abs(slack) <= BELIEVED)
        candidates, changed = np.flatnonzero(is_active | is_tight), y.copy()
        if candidates.size * columns.size > TIGHT_NUMBERS:
            return
        for _ in range(LEAST_SQUARES_PASSES):
            residual = (slope - balanced + changed @ rows)[columns]
            table = rows[candidates][:, columns].T.toarray()
            changed[candidates] += np.linalg.lstsq(table, -residual, rcond=SAME_POINT_DISTANCE)[0]
            is_negative = changed[candidates] < 0.0
            if not is_negative.any():
                break
            changed, candidates = np.maximum(changed, 0.0), candidates[~is_negative]
        before, after = (self._measure_shortfall(slope + each @ rows, weights) + each @ slack for each in (y, changed))
        if after < before:
            y[:] = changed

    def _measure_shortfall(self, slope: Array, weights: Array) -> float:
        """Return by how much the least cost of the variables within their bounds is below that of the last answer, for
        these slopes and weights of absolute values."""
        low, high = self.program.lower, self.program.upper
        ends = np.stack([low, high, np.clip(0.0, low, high)])
        with np.errstate(invalid="ignore"):
            least = (weights * np.abs(ends) + np.where(slope == 0.0, 0.0, slope * ends)).min(axis=0)
        return float((weights * np.abs(self._x) + slope * self._x - least).sum())

    def _find_certain_rows(self) -> np.ndarray:
        """Return which rows ``(r,)`` no deviation enters."""
        masks = [np.zeros(0, dtype=bool)]
        for block in self.blocks:
            is_certain = np.array(
                [not (C.data.any() or d.any()) for C, d in zip(block.C, block.d, strict=True)], dtype=bool
            )
            mask = is_certain[block.part] if block.part.size else np.zeros(block.h.size, dtype=bool)
            if block.exact:  # one of the two opposites has a deviation
                mask[: block.h.size // 2] = False
            masks.append(mask)
        return np.concatenate(masks)

    def _find_adjustable_sizes(self, y: Array) -> Array:
        """Return the sizes ``(r,)`` of multipliers that may change, 0 for others: those of rows with multipliers, and
        of the opposites of equations, which have no deviations, those of both."""
        sizes, first = y.copy(), 0
        for block in self.blocks:
            half = block.h.size // 2
            if block.exact:
                sizes[first + half : first + block.h.size] = y[first : first + block.h.size].reshape(2, -1).max(axis=0)
                sizes[first : first + half] = 0.0
            first += block.h.size
        return sizes

    def _refine_deviations(self, slope: Array, free: np.ndarray, y: Array, deviations: Array) -> None:
        """Correct the deviations of rows, such that less slope is left in the variables that answer them.

        The slopes of a solver are as accurate as its tolerance. For variables that are ``free (n,)``, since no row has
        them as an entry of its own whose deviation balances them, the products of multipliers and deviations are
        corrected by least squares, for one entry of the deviations after another. Only deviations inside of their sets
        are changed, and only where this raises the bound: among rows that are nearly dependent, small slopes ask for
        large changes of deviations, which cost more than the slopes.
        """
        if not self.spread.is_box or not (slope[free] != 0.0).any():
            return
        # of each part its matrix, constants, rows, signs and weight
        parts: list[tuple[csr_array, Array, np.ndarray, Array, float]] = []
        first = 0
        for block in self.blocks:
            for p in range(len(block.C)):
                rows = np.flatnonzero(block.part == p)
                rows = rows[: rows.size // 2] if block.exact else rows  # the opposites of equations have no deviations
                total = float(y[first + rows] @ np.abs(block.factor[rows]))
                if total > 0.0:
                    parts.append((block.C[p], block.d[p], first + rows, np.sign(block.factor[rows]), total))
            first += block.h.size
        for entry, radius in enumerate(self.spread.radii.tolist()):
            answering = [part for part in parts if part[0].indptr[entry] < part[0].indptr[entry + 1]]
            if radius <= 0.0 or not answering:
                continue
            lines = [C[[entry]] for C, _, _, _, _ in answering]
            columns = np.unique(np.concatenate([line.indices for line in lines]))
            columns = columns[free[columns]]
            if not columns.size or not slope[columns].any():
                continue
            shares = np.array([deviations[rows[0], entry] * signs[0] for _, _, rows, signs, _ in answering]) / radius
            weights = radius * np.array([total for _, _, _, _, total in answering])
            constants = weights * np.array([d[entry] for _, d, _, _, _ in answering])
            table = np.stack([line.toarray()[0][columns] for line in lines], axis=1) * weights
            room = np.maximum(1.0 - np.abs(shares), 0.0)  # what is inside of its set moves first
            change = room * np.clip(
                np.linalg.lstsq(table * room, -slope[columns], rcond=SAME_POINT_DISTANCE)[0], -1.0, 1.0
            )
            shares = self._move_shares(slope, columns, table, constants, (shares, change))
            limits = np.nextafter(-1.0 - shares, -np.inf), np.nextafter(1.0 - shares, np.inf)
            change = lsq_linear(
                table, -slope[columns], limits, "bvls", SAME_POINT_DISTANCE, max_iter=LEAST_SQUARES_PASSES
            ).x
            shares = self._move_shares(slope, columns, table, constants, (shares, change))
            for (_, _, rows, signs, _), share in zip(answering, shares.tolist(), strict=True):
                deviations[rows, entry] = signs * share * radius

    def _move_shares(
        self, slope: Array, columns: np.ndarray, table: Array, constants: Array, moved: tuple[Array, Array]
    ) -> Array:
        """Return shares of a deviation after a change, and correct the ``slope`` in ``columns`` in place; the shares as
        they are where the change does not raise the bound.

        ``table`` and ``constants`` are the slopes and the constant of each share, and ``moved`` has the shares and
        their change.
        """
        shares, change = moved
        changed = np.clip(shares + change, -1.0, 1.0)
        before, after = slope[columns], slope[columns] + table @ (changed - shares)
        gain = self._bound_variables(columns, after) - self._bound_variables(columns, before)
        if not float(constants @ (changed - shares)) + gain > 0.0:
            return shares
        slope[columns] = after
        return changed

    def _bound_variables(self, columns: np.ndarray, slope: Array) -> float:
        """Return the least value of variables in ``columns`` within their bounds, times their ``slope``."""
        bounds = np.where(slope > 0.0, self.program.lower[columns], self.program.upper[columns])
        is_sloped = slope != 0.0  # what has no slope adds nothing, also where it has no bound
        return float(slope[is_sloped] @ bounds[is_sloped])


def _find_opposite(block: UncertainRows, row: int) -> int | None:
    """Return the row whose coefficients are those of another row with the other sign; ``None`` where there is none."""
    candidates = np.flatnonzero((block.part == block.part[row]) & (block.factor == -block.factor[row]))
    sums = block.g[candidates] + block.g[[row] * candidates.size]
    opposites = candidates[np.abs(sums).max(axis=1).toarray().reshape(-1) == 0.0] if candidates.size else candidates
    return int(opposites[0]) if opposites.size else None


def _split_signs(row: np.ndarray, column: np.ndarray, value: Array, n: int) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return entries of the decision in its positive and its negative part."""
    return np.concatenate([row, row]), np.concatenate([column, column + n]), np.concatenate([value, -value])
