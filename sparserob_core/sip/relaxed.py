"""The relaxed program ``g``: the semi-infinite program with finitely many of its constraints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.sip.check import solve_finite
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.duality import dual_bound
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.regulariser import ControlImage, Regulariser
from sparserob_core.sip.result import Cut
from sparserob_core.sip.solver import Claim, QuadraticProgram, Solver
from sparserob_core.sip.vertex import vertex_multipliers

if TYPE_CHECKING:
    from scipy.sparse import csc_array

LAZY = 1e-9     # rows violated by less than this, relative to their norm, are not added
ROUNDS = 50     # lazy additions at most within one evaluation


@dataclass(frozen=True, eq=False)
class Rows:
    """Imposed constraints ``G x <= h`` with where each came from: ``G (r, n)``, ``h (r,)``, ``cuts`` of length ``r``."""

    G: Array
    h: Array
    cuts: tuple[Cut, ...]

    def take(self, keep: np.ndarray) -> Rows:
        """The rows where the mask (or the positions) ``keep`` says so."""
        positions = np.arange(self.h.size)[keep]
        return Rows(self.G[positions], self.h[positions], tuple(self.cuts[i] for i in positions))

    def joined(self, other: Rows) -> Rows:
        """These rows and then the others."""
        return Rows(np.vstack([self.G, other.G]), np.concatenate([self.h, other.h]), self.cuts + other.cuts)

    @staticmethod
    def none(n: int) -> Rows:
        """No rows in ``n`` variables."""
        return Rows(np.zeros((0, n)), np.zeros(0), ())


def rows_at(program: SemiInfiniteProgram, family: str, indices: Array, rows: np.ndarray | None = None) -> Rows:
    """The constraints of a family at indices ``(k, d)``: one row each when ``rows (k,)`` names it, else all of them."""
    if not indices.shape[0]:
        return Rows.none(program.n)
    G, h = program.family(family).rows(indices)
    count, per_index = h.shape
    where, which = (np.arange(count), rows) if rows is not None else (np.repeat(np.arange(count), per_index),
                                                                      np.tile(np.arange(per_index), count))
    cuts = tuple(Cut(family, indices[i], int(r)) for i, r in zip(where, which, strict=True))
    return Rows(np.asarray(G[where, which], dtype=float), np.asarray(h[where, which], dtype=float), cuts)


@dataclass(frozen=True, eq=False)
class RelaxedSolution:
    """``value`` of ``g`` (``+inf`` when infeasible), its optimiser, the rows that carry a multiplier, and the checked finite solution."""

    value: float
    decision: Array
    rows: Rows
    finite: FiniteSolution


class CountedSolver(Solver):
    """A solver that counts its ``calls``: many relaxed programs are solved from the last one, without it."""

    def __init__(self, solver: Solver) -> None:
        self.solver, self.calls = solver, 0

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        self.calls += 1
        return self.solver.solve(program, accuracy)


@dataclass(eq=False)
class RelaxedProgram:
    """``g(epsilon; indices)``: minimise ``J + epsilon rho`` over the finite constraints and the imposed indices.

    It remembers the rows that were active and their multipliers, and starts from them at the next call.
    """

    program: SemiInfiniteProgram
    solver: Solver
    regulariser: Regulariser | None = None
    tolerance: float = 1e-9
    solves: int = 0
    _terms: tuple[csc_array, Array] | None = None
    _last: tuple[Rows, FiniteSolution] | None = None
    _programs: dict[float, FiniteProgram] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.counted = CountedSolver(self.solver)
        if self.regulariser is not None:
            from scipy.sparse import csc_array, eye_array

            base, images = self.program.finite, self.program.image_size
            S = csc_array(eye_array(self.program.n)) if base.S is None else base.S[:images]
            lengths = np.ones(images) if self.program.lengths is None else self.program.lengths
            self._terms = self.regulariser.quadratic(ControlImage(csc_array(S), self.program.channels, lengths))

    def finite(self, rows: Rows, epsilon: float, margin: float = 0.0) -> FiniteProgram:
        """The finite program with these rows, every one of them tightened by ``margin`` times its norm."""
        base = self._regularised(epsilon)
        norms = np.linalg.norm(rows.G, axis=1) if margin else 0.0
        return replace(base, G=np.vstack([base.G, rows.G]), h=np.concatenate([base.h, rows.h - margin * norms]))

    def solve(self, rows: Rows, epsilon: float, margin: float = 0.0, guess: FiniteSolution | None = None) -> FiniteSolution:
        """Solve with all of these rows at once; ``guess`` is a solution with the same rows."""
        self.solves += 1
        return solve_finite(self.finite(rows, epsilon, margin), self.counted, tolerance=self.tolerance, guess=guess)

    def lower_bound(self, rows: Rows, solution: FiniteSolution) -> float:
        """A lower bound of the *unregularised* semi-infinite program, from the multipliers of any solution with these rows (weak duality)."""
        plain = self.finite(rows, 0.0)
        bounds = [dual_bound(plain, solution.y, solution.mu, solution.z, at=solution.x)]
        if plain.P is None and np.isfinite(solution.x).all():
            y, mu = vertex_multipliers(plain, solution.x, solution.y, solution.mu)
            bounds.append(dual_bound(plain, y, mu, solution.z, at=solution.x))
        return float(max(bounds))

    def evaluate(self, indices: Mapping[str, Array], epsilon: float) -> RelaxedSolution:
        """``g`` at a tuple: per family the indices ``(k, d)``. Rows are imposed lazily: those active last time, then what is violated."""
        pool = Rows.none(self.program.n)
        for family, points in indices.items():
            pool = pool.joined(rows_at(self.program, family, points))
        norms = np.maximum(np.linalg.norm(pool.G, axis=1), np.finfo(float).tiny)
        working = self._matching(pool)
        for _ in range(ROUNDS):
            rows = pool.take(working)
            solution = self.solve(rows, epsilon)
            self._last = (rows, solution)
            if solution.status != "optimal":
                break
            violated = np.setdiff1d(np.flatnonzero((pool.G @ solution.x - pool.h) / norms > LAZY), working)
            if not violated.size:
                break
            order = np.argsort(-((pool.G[violated] @ solution.x - pool.h[violated]) / norms[violated]))
            working = np.concatenate([working, violated[order[: max(10, working.size)]]])
        value = {"optimal": solution.value, "infeasible": np.inf}.get(solution.status, np.nan)
        return RelaxedSolution(value, solution.x, rows, solution)

    def _matching(self, pool: Rows) -> np.ndarray:
        """Positions in the pool of the rows that were active in the last evaluation."""
        if self._last is None or self._last[1].y.size < self._last[0].h.size:
            return np.zeros(0, dtype=int)
        rows, solution = self._last
        active = solution.y[solution.y.size - rows.h.size:] > 0
        keys = {(cut.family, cut.index.tobytes(), cut.row) for cut, on in zip(rows.cuts, active, strict=True) if on}
        return np.array([i for i, cut in enumerate(pool.cuts) if (cut.family, cut.index.tobytes(), cut.row) in keys], dtype=int)

    def _regularised(self, epsilon: float) -> FiniteProgram:
        base = self.program.finite
        if epsilon == 0.0 or self._terms is None:
            return base
        if epsilon not in self._programs:
            P, q = self._terms
            total = epsilon * P if base.P is None else base.P + epsilon * P
            self._programs = {epsilon: replace(base, P=total.tocsc(), q=base.q + epsilon * q)}
        return self._programs[epsilon]
