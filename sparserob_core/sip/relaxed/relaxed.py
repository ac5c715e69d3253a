"""The relaxed program ``g``: the semi-infinite program with finitely many of its constraints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.convexity import ControlImage, Regulariser, require_convex
from sparserob_core.sip.evidence import Cut, Dual
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.curved import curvature_of, curved_bound
from sparserob_core.sip.inner.dual_newton import DualNewton, not_separable
from sparserob_core.sip.inner.duality import bound_with_multipliers, minimisers, remove_cost, vertex_multipliers
from sparserob_core.sip.inner.image import project_onto_stationary
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import SMALL_COST
from sparserob_core.sip.solver import RESIDUAL_ROUNDING, AccountedSolver, Solver

if TYPE_CHECKING:
    from scipy.sparse import csc_array

LAZY = 1e-9  # rows violated by less than this, relative to their norm, are not added
# Of the value: where the bound by a tangent is further below, the curvature of the cost is asked. A hundred times as
# much is more than a gap that counts as closed; a hundredth of it is lost in rounding.
UNCLOSED = 1e-9
RELAXED = "relaxed"  # what these programs are called where a solver fails on some
MAX_LAZY_ROUNDS = 200  # lazy additions at most within one evaluation
# of them, those that also drop the rows without a multiplier; later rows are only added, so that nothing can cycle
DROPPING = 20


@dataclass(frozen=True, eq=False)
class Rows:
    """Imposed constraints ``G x <= h`` with where each came from: ``G (r, n)``, ``h (r,)``, ``cuts`` of length
    ``r``."""

    G: Array
    h: Array
    cuts: tuple[Cut, ...]

    @cached_property
    def norms(self) -> Array:
        """The norms ``(r,)`` of the rows."""
        return np.asarray(np.linalg.norm(self.G, axis=1))

    def take(self, keep: np.ndarray) -> Rows:
        """The rows where the mask (or the positions) ``keep`` says so."""
        positions = np.arange(self.h.size)[keep]
        return Rows(self.G[positions], self.h[positions], tuple(self.cuts[i] for i in positions))

    def joined(self, other: Rows) -> Rows:
        """Return these rows followed by the ``other`` rows."""
        return Rows(np.vstack([self.G, other.G]), np.concatenate([self.h, other.h]), self.cuts + other.cuts)

    @staticmethod
    def none(n: int) -> Rows:
        """No rows in ``n`` variables."""
        return Rows(np.zeros((0, n)), np.zeros(0), ())


@shaped
def rows_at(
    program: SemiInfiniteProgram, family: str, indices: Float[Array, "k d"], rows: Int[np.ndarray, " k"] | None = None
) -> Rows:
    """The constraints of a family at indices ``(k, d)``: one row each when ``rows (k,)`` names it, else all of them."""
    if not indices.shape[0]:
        return Rows.none(program.n)
    constraints = program.family(family)
    positions = np.arange(indices.shape[0])
    if rows is not None and constraints.chosen is not None:
        where, row_numbers, (G, h) = positions, rows, constraints.chosen(indices, rows)
    else:
        G, h = constraints.rows_at(indices, program.n)
        if rows is not None and rows.max() >= h.shape[1]:
            raise InputError(f"family {family!r}: worst: expected a row below {h.shape[1]}, got {int(rows.max())}")
        where, row_numbers = (
            (positions, rows)
            if rows is not None
            else (np.repeat(positions, h.shape[1]), np.tile(np.arange(h.shape[1]), positions.size))
        )
        G, h = G[where, row_numbers], h[where, row_numbers]
    form = constraints.formulation
    cuts = tuple(Cut(family, indices[i], int(r), formulation=form) for i, r in zip(where, row_numbers, strict=True))
    return Rows(np.asarray(G, dtype=float), np.asarray(h, dtype=float), cuts)


def rows_of(program: SemiInfiniteProgram, groups: Iterable[tuple[Array, np.ndarray, str]]) -> Rows:
    """Return the constraints of several groups: indices ``(k, d)``, a row ``(k,)`` for each, and a family."""
    rows = Rows.none(program.n)
    for indices, numbers, family in groups:
        rows = rows.joined(rows_at(program, family, indices, numbers))
    return rows


@dataclass(frozen=True, eq=False)
class RelaxedSolution:
    """``value`` of ``g`` (see `value_of`), its optimiser, the rows that were imposed, and the checked finite solution
    with them."""

    value: float
    decision: Array
    rows: Rows
    finite: FiniteSolution

    def multipliers(self) -> dict[tuple[str, bytes, int], float]:
        """The multipliers of the imposed rows, by family, index and row."""
        y = self.finite.y[self.finite.y.size - self.rows.h.size :]
        return {_make_key(cut): float(m) for cut, m in zip(self.rows.cuts, y, strict=False)}


@dataclass(frozen=True, eq=False)
class Imposed:
    """Imposed rows of a pool: their ``positions (k,)`` and ``multipliers (k,)``, and the solution that gave these, if
    any."""

    positions: np.ndarray
    multipliers: Array
    solution: FiniteSolution | None = None


_Proven: TypeAlias = tuple[float, Array, Array, Array | None, Array]


def value_of(solution: FiniteSolution) -> float:
    """``g``: ``+inf`` where proven infeasible; where no optimum was believed the proven lower bound, so never more than
    the truth."""
    return {"optimal": solution.value, "infeasible": np.inf}.get(solution.status, solution.lower_bound)


def _make_key(cut: Cut) -> tuple[str, bytes, int]:
    return cut.family, cut.index.tobytes(), cut.row


@shaped
def _select_most_violated(excess: Float[Array, " r"], kinds: Int[np.ndarray, " r"]) -> Int[np.ndarray, " v"]:
    """The position of the largest excess of every kind, where it is above `LAZY`."""
    violated = np.flatnonzero(excess > LAZY)
    order = violated[np.lexsort((-excess[violated], kinds[violated]))]
    return np.asarray(order[np.flatnonzero(np.diff(kinds[order], prepend=-1))], dtype=int)


def require_separable(program: SemiInfiniteProgram, solver: Solver, regulariser: Regulariser | None) -> None:
    """Raise `InputError` where the solver is `DualNewton`, and the relaxed programs are not for it."""
    counted = AccountedSolver.of(solver)
    if not isinstance(counted.solver, DualNewton):
        return
    if program.spread is not None:
        reason = "under feedback rows hold for every deviation, which makes linear programs, and HiGHS solves these"
    else:
        relaxed, none = RelaxedProgram(program, solver, regulariser), Rows.none(program.n)
        reason = not_separable(relaxed.finite(none.G, none.h, 1.0))
    if reason:
        raise InputError(path="solver.name", expected=f"another solver, such as piqp: {reason}", got="dual_newton")


def _choose_tangent_point(plain: FiniteProgram, y: Array, mu: Array, x: Array) -> Array:
    """Return the point ``(n,)`` at which the cost is replaced by its tangent, for a bound from these multipliers.

    The point is the minimiser for these multipliers where that is explicit, which gives the bound of the cost itself;
    else it is ``x``, with 0 where ``x`` is not finite.
    """
    if plain.P is not None and plain.separable:
        slope = plain.q + np.maximum(y, 0.0) @ plain.G + mu @ plain.A
        own = minimisers(plain.weights, plain.curvature, slope, plain.lower, plain.upper)
        x = np.where(np.isfinite(own), own, x)
    return np.where(np.isfinite(x), x, 0.0)


def _bound_free_slopes(plain: FiniteProgram, y: Array, mu: Array, x: Array) -> float:
    """Return what slopes of entries without bounds and without curvature, which should be 0, may be worth at decisions
    of up to twice the size of ``x (n,)``."""
    assert plain.curvature is not None
    free = (np.isinf(plain.lower) | np.isinf(plain.upper)) & (plain.curvature == 0.0) & (plain.weights == 0.0)
    used = np.where(np.isfinite(plain.h), np.maximum(y, 0.0), 0.0)
    slope = plain.q + used @ plain.G + mu @ plain.A
    noise = np.abs(plain.q) + used @ np.abs(plain.G) + np.abs(mu) @ np.abs(plain.A)
    size = np.where(np.isfinite(x), np.abs(x), 0.0)
    return float((2.0 * (np.abs(slope) + RESIDUAL_ROUNDING * noise) * size)[free].sum())


@dataclass(eq=False)
class RelaxedProgram:
    """``g(epsilon; indices)``: minimise ``J + epsilon rho`` over the finite constraints and the imposed indices.

    It remembers the rows that were active and their multipliers, and starts from them at the next call. ``solved_by``
    counts whose answers the ``solves`` were (`FiniteSolution.by`). Raises `OutOfTime` instead of solving one more
    program when its ``deadline`` has passed.
    """

    program: SemiInfiniteProgram
    solver: Solver
    regulariser: Regulariser | None = None
    tolerance: float = 1e-9
    solves: int = 0
    solved_by: Counter[str] = field(default_factory=Counter)
    deadline: Deadline = field(default_factory=Deadline)
    _terms: tuple[csc_array, Array] | None = None
    _last: RelaxedSolution | None = None
    _zero_bound: tuple[float, Array, Array, Array | None] | None = None
    _programs: dict[float, FiniteProgram] = field(default_factory=dict)
    _plain_program: tuple[Rows, FiniteProgram] | None = None

    def __post_init__(self) -> None:
        self.counted = AccountedSolver.of(self.solver)
        if self.counted.instead is not None:
            self.solved_by[self.counted.name] += 0
        if self.regulariser is not None:
            from scipy.sparse import csc_array, eye_array

            base, images = self.program.finite, self.program.image_size
            S = eye_array(self.program.n, format="csc") if base.S is None else csc_array(base.S[:images])
            lengths = np.ones(images) if self.program.lengths is None else self.program.lengths
            P, q = self.regulariser.quadratic(ControlImage(S, self.program.channels, lengths))
            self._terms = require_convex("regulariser.P", P, self.program.n), q

    def solve(
        self, rows: Rows, epsilon: float, margin: float = 0.0, guess: FiniteSolution | None = None
    ) -> FiniteSolution:
        """Solve with all of these rows at once, each tightened by ``margin`` times its norm; ``guess`` is a solution
        with the same rows. The decision is rounded so that equalities hold, where the program has a way to do that."""
        h = rows.h - margin * rows.norms if margin else rows.h
        solution, settle = self._solve_rows(rows.G, h, epsilon, guess), self.program.settle
        if settle is None or solution.status == "infeasible":
            return solution
        x, finite = settle(solution.x), self.finite(rows.G, h, epsilon)
        value = finite.objective(x)
        residual, gap = finite.residual(x), value - solution.lower_bound
        return replace(solution, x=x, value=value, residual=residual, gap=gap)

    def lower_bound(self, rows: Rows, solution: FiniteSolution) -> Dual:
        """A lower bound of the *unregularised* semi-infinite program, from the multipliers of any solution with these
        rows (weak duality).

        Less an allowance for the rounding of the rows themselves; no multipliers at all are an offer too, and need
        none.
        """
        if (
            self._plain_program is None or self._plain_program[0] is not rows
        ):  # the same again and again while the weight falls
            self._plain_program = rows, self.finite(rows.G, rows.h, 0.0)
        plain = self._plain_program[1]
        offers = [(solution.y, solution.mu, solution.z)]
        if np.isfinite(solution.x).all():
            linear = plain.tangent(solution.x)
            offers.append((*vertex_multipliers(linear, solution.x, solution.y, solution.mu), solution.z))
        proven = [
            self._bound_without_multipliers(plain, solution),
            *(self._prove_bound(plain, solution, *offer) for offer in offers),
        ]
        errors = self._bound_row_errors(rows, np.max([proof[1] for proof in proven], axis=0), solution.x)
        bounds = [proof[0] - float(np.maximum(proof[1], 0.0) @ errors) for proof in proven]
        best = int(np.argmax(bounds))
        _, y, mu, z, at = proven[best]
        curved = plain.P is not None or plain.blocks is not None
        return self.dual(rows, y, mu, solution.z if z is None else z, bounds[best], at if curved else None)

    def _bound_row_errors(self, rows: Rows, y: Array, x: Array) -> Array:
        """Return the errors ``(r,)`` that rounding may cause in the rows with a multiplier, where their terms cancel.

        A lower bound speaks of an optimum, which may be far from the answer ``x (n,)``. An entry that is 0 in the
        answer may be at its bound there, and its coefficient may be nothing but rounding. So the errors are those of
        every decision within its bounds.
        """
        errors, first, reach = np.zeros(y.size), y.size - rows.h.size, self._bound_decision(x)
        for family in self.program.families:
            if family.rounding is None:
                continue
            used = [i for i in np.flatnonzero(y[first:] > 0.0).tolist() if rows.cuts[i].family == family.name]
            if used:
                bounds = family.rounding(reach, np.array([rows.cuts[i].index for i in used]))
                errors[first + np.array(used)] = bounds[np.arange(len(used)), [rows.cuts[i].row for i in used]]
        return errors

    def _bound_decision(self, x: Array) -> Array:
        """Return how large the entries of a decision may be, ``(n,)``: as their bounds, and as twice the answer
        ``x (n,)`` where they have none (`_bound_free_slopes`)."""
        base, nearby = self.program.finite, 2.0 * np.abs(np.where(np.isfinite(x), x, 0.0))
        if base.S is not None:
            return nearby
        largest = np.maximum(np.abs(base.lower), np.abs(base.upper))
        return np.where(np.isfinite(largest), largest, nearby)

    def _bound_without_multipliers(self, plain: FiniteProgram, solution: FiniteSolution) -> _Proven:
        """The bound of no multipliers at all, which is the same again and again where the cost is linear."""
        zero, x = np.zeros_like(solution.y), solution.x
        if plain.P is not None or plain.blocks is not None:
            return self._prove_bound(plain, solution, zero, np.zeros_like(solution.mu), np.zeros_like(solution.z))
        if self._zero_bound is None:
            self._zero_bound = bound_with_multipliers(
                plain, zero, np.zeros_like(solution.mu), np.zeros_like(solution.z)
            )
        bound, _, mu, z = self._zero_bound
        return bound - self.rounding(plain, zero, mu, x), zero, mu, z, x

    def _prove_bound(self, plain: FiniteProgram, solution: FiniteSolution, y: Array, mu: Array, z: Array) -> _Proven:
        """A lower bound, less its rounding, with the multipliers that prove it and where the cost is touched."""
        if plain.P is not None and plain.separable and not plain.bounded:  # where a tangent says nothing
            bound, y, mu, z_proving = bound_with_multipliers(plain, y, mu, z)
            bound -= _bound_free_slopes(plain, y, mu, solution.x)
            at = _choose_tangent_point(plain, y, mu, solution.x)
        else:
            at = _choose_tangent_point(plain, y, mu, solution.x)
            bound, y, mu, z_proving = bound_with_multipliers(plain.tangent(at), y, mu, z, at=at)
        if solution.value - bound > UNCLOSED * abs(solution.value) and self._curvature is not None:
            better, point = curved_bound(plain, self._curvature, y, mu, at)
            bound, at = (better, point) if better > bound else (bound, at)
        return bound - self.rounding(plain, y, mu, solution.x), y, mu, z_proving, at

    @cached_property
    def _curvature(self) -> Array | None:
        """Curvature ``c (n,)`` of the quadratic cost by entries (`curvature_of`); ``None`` where a tangent does as
        well.

        Pieces of a control have bounds, and a certificate about them is judged by tangents alone.
        """
        base = self.program.finite
        return None if base.bounded and self.program.lengths is not None else curvature_of(base)

    @shaped
    def rounding(
        self, plain: FiniteProgram, y: Float[Array, " r"], mu: Float[Array, " e"], x: Float[Array, " n"]
    ) -> float:
        """Return the error that rounding of the rows may cause in a lower bound from these multipliers, for ``x (n,)``
        nearby."""
        used = (y > 0) & np.isfinite(plain.h)
        if not (used.any() or mu.any()):
            return 0.0
        size = np.where(np.isfinite(x), np.abs(x), 0.0)
        total = float(y[used] @ (np.abs(plain.h[used]) + np.abs(plain.G[used]) @ size))
        if mu.size:
            total += float(np.abs(mu) @ (np.abs(plain.b) + np.abs(plain.A) @ size))
        return RESIDUAL_ROUNDING * total

    @shaped
    def dual(
        self,
        rows: Rows,
        y: Float[Array, " r"],
        mu: Float[Array, " e"],
        z: Float[Array, " k"],
        bound: float,
        at: Float[Array, " n"] | None = None,
        priced: bool = True,
        of: FiniteProgram | None = None,
    ) -> Dual:
        """Multipliers of a program with these rows (and of its fixed rows, which come first in ``y``), as a record;
        ``at``: where a bound's quadratic terms are replaced by their tangent; ``priced``: with the cost, not as a proof
        of infeasibility; ``of``: the program that they are multipliers of, where it has another cost or other
        bounds."""
        own = y[y.size - rows.h.size :]
        if self.program.finite.S is not None:
            plain = self.finite(rows.G, rows.h, 0.0) if of is None else of
            plain = remove_cost(plain) if not priced else plain if at is None else plain.tangent(at)
            z = project_onto_stationary(plain, z, plain.q + y @ plain.G + mu @ plain.A)
        cuts = tuple(replace(cut, multiplier=float(m)) for cut, m in zip(rows.cuts, own, strict=True) if m > 0.0)
        fixed = y[: y.size - rows.h.size]
        return Dual(bound, cuts, mu, None if self.program.finite.S is None else z, fixed, at)

    @shaped
    def evaluate(self, indices: Mapping[str, Float[Array, "_ _"]], epsilon: float) -> RelaxedSolution:
        """``g`` at a tuple: per family the indices ``(k, d)``. Rows are imposed lazily: those active last time, then
        what is violated."""
        pool = Rows.none(self.program.n)
        for family, points in indices.items():
            pool = pool.joined(rows_at(self.program, family, points))
        multipliers = {} if self._last is None else self._last.multipliers()
        start = [(i, y) for i, cut in enumerate(pool.cuts) if (y := multipliers.get(_make_key(cut), 0.0)) > 0.0]
        kinds = {kind: number for number, kind in enumerate(dict.fromkeys((cut.family, cut.row) for cut in pool.cuts))}
        imposed = Imposed(
            np.array([i for i, _ in start], dtype=int),
            np.array([y for _, y in start]),
            None if self._last is None else self._last.finite,
        )
        imposed, solution = self.lazily(
            pool.G, pool.h, np.array([kinds[cut.family, cut.row] for cut in pool.cuts], dtype=int), epsilon, imposed
        )
        self._last = RelaxedSolution(value_of(solution), solution.x, pool.take(imposed.positions), solution)
        return self._last

    @shaped
    def lazily(
        self,
        G: Float[Array, "r n"],
        h: Float[Array, " r"],
        kinds: Int[np.ndarray, " r"],
        epsilon: float,
        start: Imposed,
        norms: Float[Array, " r"] | None = None,
    ) -> tuple[Imposed, FiniteSolution]:
        """Solve with all rows ``G x <= h`` by imposing few of them: those of ``start``, then the most violated of every
        kind ``(r,)``, until no other is violated. Returns the rows imposed last, in terms of which the solution's
        multipliers are."""
        norms = np.maximum(np.linalg.norm(G, axis=1), np.finfo(float).tiny) if norms is None else norms
        positions, guess = start.positions, self._build_guess(start)
        for number in range(MAX_LAZY_ROUNDS):
            solution = self._solve_rows(G[positions], h[positions], epsilon, guess)
            multipliers = (
                solution.y[solution.y.size - positions.size :]
                if solution.y.size >= positions.size
                else np.zeros(positions.size)
            )
            imposed = Imposed(positions, multipliers, solution)
            if solution.status == "infeasible" or not np.isfinite(solution.x).all():
                break
            with np.errstate(over="ignore"):  # a row that is zero, with a right-hand side that nothing keeps
                excess = (G @ solution.x - h) / norms
            excess[positions] = -np.inf
            fresh = _select_most_violated(excess, kinds)
            if not fresh.size:
                break
            needed = (multipliers > 0.0) | (number > DROPPING)
            positions = np.concatenate([positions[needed], fresh])
            guess = self._build_guess(
                Imposed(positions, np.concatenate([multipliers[needed], np.zeros(fresh.size)]), solution)
            )
        return imposed, solution

    def _build_guess(self, start: Imposed) -> FiniteSolution | None:
        """The solution that the imposed rows came with, with their multipliers."""
        last = start.solution
        if last is None or not np.isfinite(last.x).all():
            return None
        fixed = last.y[: self.program.finite.h.size]
        return replace(last, y=np.concatenate([fixed, start.multipliers]))

    @shaped
    def _solve_rows(
        self, G: Float[Array, "r n"], h: Float[Array, " r"], epsilon: float, guess: FiniteSolution | None
    ) -> FiniteSolution:
        self.deadline.check()
        small = SMALL_COST if epsilon == 0.0 else np.inf  # the bounds are to meet there
        return self.answered(self.finite(G, h, epsilon), guess, small)

    def answered(
        self, finite: FiniteProgram, guess: FiniteSolution | None = None, small: float = np.inf
    ) -> FiniteSolution:
        """The checked solution of a finite program by the solver, whose answer is counted; see `solve_finite`."""
        counted = self.counted.until(self.deadline)
        solution = solve_finite(finite, counted, tolerance=self.tolerance, guess=guess, small=small)
        self.count(solution.by)
        if solution.unanswered:
            self.counted.failures.add(RELAXED, solution.unanswered, solution.by)
        return solution

    def count(self, by: str) -> None:
        """Count one program that was answered ``by`` somebody."""
        self.solves += 1
        self.solved_by[by] += 1

    @shaped
    def finite(self, G: Float[Array, "r n"], h: Float[Array, " r"], epsilon: float) -> FiniteProgram:
        """The finite program with these rows."""
        base = self._regularise(epsilon)
        return base.under(G, h)

    def _regularise(self, epsilon: float) -> FiniteProgram:
        base = self.program.finite
        if epsilon == 0.0 or self._terms is None:
            return base
        if epsilon not in self._programs:
            P, q = self._terms
            if base.P is None:  # the same entries, without what it takes to look them over again
                total = copy(P)
                total.data = epsilon * P.data
            else:
                total = (base.P + epsilon * P).tocsc()
            self._programs = {epsilon: base.curved(total, base.q + epsilon * q if q.any() else base.q)}
        return self._programs[epsilon]
