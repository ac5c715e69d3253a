"""The exchange method: solve with few constraints, add those that the optimiser violates most, until the bounds meet.

Blankenship and Falk (1976) with three additions: the rows are tightened by a tiny margin, so that the optimiser is
feasible for the whole continuum and its cost is an upper bound; the lower bound comes from multipliers and untightened
rows by weak duality; and the weight of the regulariser decreases only until the cost stops changing (exact
regularisation: Friedlander and Tseng 2007).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from pydantic import Field

from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished, frozen
from sparserob_core.sip.evidence import NO_BOUND, Cut, Dual, Proof
from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram, Separation, WorstConstraint
from sparserob_core.sip.proof.branch_and_bound import TOLERANCE, prove
from sparserob_core.sip.proof.irreducible import irreducible
from sparserob_core.sip.proof.verdict import infeasible_subsystem, verdict, witness, worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows, rows_at
from sparserob_core.sip.result import Result, Status, relative_gap
from sparserob_core.sip.separation.separation import separate

IDLE_ROUNDS = 3  # rounds that a row may stay without a multiplier before it is dropped
DROPPING_ROUNDS = 40  # rounds after which rows are only added, so that nothing can cycle
SMALLEST_MARGIN, LARGEST_MARGIN = 1e-15, 1e-6  # in units of the decision's bounds, where those are below 1
RESIDUAL = 1e-8  # of bounds, fixed rows and equalities, relative to their scale, at a decision that is returned
CRUDE = 1e-4  # residual and relative gap of a relaxed solution that a round can do with
ALLOWED = TOLERANCE / 2  # a violation that the search may leave to the proof

Prover: TypeAlias = Callable[[Array], Sequence[Proof]]


class Exchange(Method, Options):
    """Exchange of indices until the relative gap is at most ``tolerance``, in at most ``rounds`` rounds."""

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds at most."""

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """`certified` when the gap is closed and every family is proven; infeasible, refuted or undecided otherwise,
        with the reason."""
        return self.close(program, tools, lambda x: prove(program, x, tools.notify))

    def close(self, program: SemiInfiniteProgram, tools: Tools, prover: Prover) -> Result:
        """Close the gap of ``program``; what is claimed of the decision is what ``prover`` proves of it."""
        return _Run(self, program, tools, prover).solve()


@dataclass(eq=False)
class _Run:
    """One run: the working rows, the two bounds, the weight of the regulariser, and the margin with the least it may
    be."""

    method: Exchange
    program: SemiInfiniteProgram
    tools: Tools
    prover: Prover
    started: float = field(default_factory=time.perf_counter)
    dual: Dual = NO_BOUND
    margin: float = 0.0
    floor: float = 0.0
    slater: bool = True
    history: list[RoundFinished] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.relaxed = RelaxedProgram(self.program, self.tools.solver, self.tools.regulariser)
        self.rows = Rows.none(self.program.n)
        self.idle = np.zeros(0, dtype=int)
        self.epsilon = 0.0 if self.tools.regulariser is None else self.tools.continuation.start
        self.guess: FiniteSolution | None = None
        self.added: tuple[Cut, ...] = ()
        self.dropped: tuple[Cut, ...] = ()

    def solve(self) -> Result:
        for number in range(1, self.method.rounds + 1):
            solution = self._relax()
            if not _usable(solution):
                return self._without_answer(solution)
            separations = separate(self.program, solution.x, self.tools, ALLOWED, number)
            worst = worst_of(separations)
            violated = [_above(family, found) for family, found in separations]
            self._tell(number, solution, worst, separations)
            last = number == self.method.rounds
            if not last and (self._exchange(solution, violated) or self._tighten(violated)):
                continue
            if not last and self._open(solution) and self._sharpen(solution):
                continue
            proofs = self.prover(solution.x)
            witnesses = [
                (p.index[None], np.array([p.row]), p.family)
                for p in proofs
                if p.verdict == "refuted"
                and p.index is not None
                and p.formulation == self.program.family(p.family).formulation
            ]
            if last or not self._exchange(solution, witnesses):
                return self._finished(solution, worst, proofs)
        raise AssertionError("the last round returns")

    def _relax(self) -> FiniteSolution:
        """Solve the relaxed program, with the regulariser as light as it must be for the cost to be exact."""
        solution = self._solved(self.epsilon)
        regu = self.tools.continuation
        while _usable(solution) and self.epsilon > regu.stop and self._open(solution):
            lighter = regu.lighter(self.epsilon)
            candidate = self._solved(lighter)
            if not _usable(candidate):
                break
            changed = abs(self.program.cost(candidate.x) - self.program.cost(solution.x)) > regu.tolerance * max(
                1.0, abs(self.lower)
            )
            self.epsilon, solution = lighter, candidate
            if not changed and self._open(solution):
                self._plain_bound()
        return solution

    def _solved(self, epsilon: float) -> FiniteSolution:
        solution = self.relaxed.solve(self.rows, epsilon, self.margin, self.guess)
        # the margin, not the program, may be at fault: no Slater point
        if solution.status == "infeasible" and self.margin > 0.0:
            self.margin, self.slater = 0.0, False
            solution = self.relaxed.solve(self.rows, epsilon, 0.0, None)
        if _usable(solution):
            self.guess = solution
            self._improve(self.relaxed.lower_bound(self.rows, solution))
            self._set_margin(solution)
        return solution

    def _plain_bound(self) -> FiniteSolution:
        """The unregularised relaxed program: only its multipliers are wanted, for the lower bound."""
        plain = self.relaxed.solve(self.rows, 0.0, self.margin)
        if _usable(plain):
            self._improve(self.relaxed.lower_bound(self.rows, plain))
        return plain

    @property
    def lower(self) -> float:
        return self.dual.bound

    def _improve(self, dual: Dual) -> None:
        self.dual = max(self.dual, dual, key=lambda one: one.bound)

    def _open(self, solution: FiniteSolution) -> bool:
        return self._gap(self.program.cost(solution.x)) > self.method.tolerance

    def _gap(self, upper: float) -> float:
        return relative_gap(self.lower, upper, self.program.cost_scale)

    def _sharpen(self, solution: FiniteSolution) -> bool:
        """The decision is feasible but its gap is open: try what else can close it; ``False`` when nothing is left."""
        if self.epsilon == 0.0:
            return False
        plain = self._plain_bound()
        if not self._open(solution) or not _usable(plain):
            return False
        self.epsilon, self.guess = 0.0, None  # the regulariser is not exact at its lightest: go on without it
        return True

    def _set_margin(self, solution: FiniteSolution) -> None:
        """Tighten the rows as much as a tenth of the tolerated gap pays for."""
        if not self.slater or not self.rows.h.size:
            return
        price = float(self._multipliers(solution) @ np.linalg.norm(self.rows.G, axis=1))
        budget = 0.1 * self.method.tolerance * max(self.program.cost_scale, abs(solution.value))
        reach = np.maximum(np.abs(self.program.finite.lower), np.abs(self.program.finite.upper))
        unit = min(1.0, float(np.where(np.isfinite(reach), reach, 1.0).max()))
        margin = float(
            np.clip(budget / max(price, np.finfo(float).tiny), SMALLEST_MARGIN * unit, LARGEST_MARGIN * unit)
        )
        if self.margin == 0.0 or margin < 0.5 * self.margin:
            self.margin = max(margin, self.floor)

    def _tighten(self, violated: Sequence[tuple[Array, np.ndarray, str]]) -> bool:
        """Imposed rows that are violated nonetheless, by the solver's accuracy: tighten by twice as much; ``False``
        when that does not help."""
        known = {(cut.family, cut.row, cut.index.tobytes()): i for i, cut in enumerate(self.rows.cuts)}
        places = [
            known[key]
            for indices, rows, family in violated
            for i, r in zip(indices, rows, strict=True)
            if (key := (family, int(r), i.tobytes())) in known
        ]
        if not places or not self.slater or self.guess is None or self.floor >= LARGEST_MARGIN:
            return False
        norms = np.maximum(np.linalg.norm(self.rows.G[places], axis=1), np.finfo(float).tiny)
        missed = float(((self.rows.G[places] @ self.guess.x - self.rows.h[places]) / norms).max())
        self.floor = float(np.clip(2.0 * max(missed, self.margin), SMALLEST_MARGIN, LARGEST_MARGIN))
        self.margin = max(self.margin, self.floor)
        return True

    def _multipliers(self, solution: FiniteSolution) -> Array:
        return solution.y[solution.y.size - self.rows.h.size :]

    def _exchange(self, solution: FiniteSolution, violated: Sequence[tuple[Array, np.ndarray, str]]) -> int:
        """Drop the rows that have been slack for a while, add the violated ones; returns how many were new."""
        known, fresh = {(cut.family, cut.row, cut.index.tobytes()) for cut in self.rows.cuts}, Rows.none(self.program.n)
        for indices, rows, family in violated:
            new = np.array(
                [(family, int(r), i.tobytes()) not in known for i, r in zip(indices, rows, strict=True)], dtype=bool
            )
            if new.any():
                fresh = fresh.joined(rows_at(self.program, family, indices[new], rows[new]))
        added = fresh.h.size
        if not added:
            return 0
        y = self._multipliers(solution)
        self.idle = np.where(y > 0.0, 0, self.idle + 1)
        keep = (self.idle < IDLE_ROUNDS) | (len(self.history) > DROPPING_ROUNDS)
        self.added, self.dropped = (
            fresh.cuts,
            tuple(cut for cut, kept in zip(self.rows.cuts, keep, strict=True) if not kept),
        )
        self.rows, self.idle = (
            self.rows.take(keep).joined(fresh),
            np.concatenate([self.idle[keep], np.zeros(added, dtype=int)]),
        )
        fixed = solution.y[: solution.y.size - y.size]
        self.guess = replace(solution, y=np.concatenate([fixed, y[keep], np.zeros(added)]))
        return added

    def _tell(
        self,
        number: int,
        solution: FiniteSolution,
        worst: WorstConstraint,
        found: Sequence[tuple[ConstraintFamily, Separation]],
    ) -> None:
        cost, violated = self.program.cost(solution.x), any(_above(family, one)[1].size for family, one in found)
        event = RoundFinished(
            round=number,
            epsilon=self.epsilon,
            lower_bound=self.lower,
            violation=worst.violation,
            worst_family=worst.constraint,
            upper_bound=np.inf if violated else cost,
            active_indices=self.rows.h.size,
            cuts_added=len(self.added),
            cuts_dropped=len(self.dropped),
            relaxed_programs=self.relaxed.solves,
            seconds=time.perf_counter() - self.started,
            cost=cost,
            decision=frozen(solution.x),
            separations={family.name: one for family, one in found},
            imposed=self.rows.cuts,
            multipliers=frozen(self._multipliers(solution)),
            added=self.added,
            dropped=self.dropped,
        )
        self.added, self.dropped = (), ()
        self.history.append(event)
        self.tools.notify(event)

    def _finished(self, solution: FiniteSolution, worst: WorstConstraint, proofs: Sequence[Proof]) -> Result:
        cost = self.program.cost(solution.x)
        gap = self._gap(cost)
        status, message = verdict(proofs, gap, self.method.tolerance)
        residual = self.program.finite.residual(solution.x)
        if residual > RESIDUAL:
            status, message = (
                "failed",
                f"the decision misses its bounds or equalities by {residual:.1e}: {'; '.join(solution.attempts)}",
            )
        return replace(
            self._result(status, message, solution, cost, witness(self.program, worst, proofs)), proofs=tuple(proofs)
        )

    def _without_answer(self, solution: FiniteSolution) -> Result:
        if solution.status != "infeasible":
            return self._result("failed", "; ".join(solution.attempts) or solution.message, solution, np.nan, None)
        self.rows, solution = irreducible(self.relaxed, self.rows, solution)
        found, worst = infeasible_subsystem(
            self.program, self.rows, self._multipliers(solution), solution.infeasibility
        )
        self.dual = self.relaxed.dual(self.rows, solution.y, solution.mu, solution.z, solution.infeasibility)
        return replace(self._result("infeasible", found.sentence(), solution, np.nan, worst), infeasible=found)

    def _result(
        self, status: Status, message: str, solution: FiniteSolution, cost: float, worst: WorstConstraint | None
    ) -> Result:
        y = self._multipliers(solution) if solution.y.size >= self.rows.h.size else np.zeros(self.rows.h.size)
        cuts = tuple(replace(cut, multiplier=float(m)) for cut, m in zip(self.rows.cuts, y, strict=True) if m > 0.0)
        return Result(
            status=status,
            message=message,
            decision=solution.x if status not in ("infeasible", "failed") else None,
            cost=cost,
            value=solution.value,
            epsilon=self.epsilon,
            lower_bound=np.inf if status == "infeasible" else self.lower,
            upper_bound=cost if status in ("certified", "verified", "undecided") else np.inf,
            worst=worst,
            indices=cuts,
            counts={
                "relaxed_programs": self.relaxed.solves,
                "rounds": len(self.history),
                "active_indices": len(cuts),
                "solver_calls": self.relaxed.counted.calls,
            },
            history=tuple(self.history),
            dual=self.dual,
            seconds=time.perf_counter() - self.started,
        )


def _above(family: ConstraintFamily, found: Separation) -> tuple[Array, np.ndarray, str]:
    """The indices, rows and family of what is violated by more than the search may leave to the proof."""
    violated = found.violations > family.tolerance(ALLOWED)
    return found.indices[violated], found.rows[violated], family.name


def _usable(solution: FiniteSolution) -> bool:
    """Whether a relaxed solution is good for a round: a crude optimiser costs rounds, but no claim rests on its
    accuracy."""
    scale = max(1.0, abs(solution.value))
    return solution.status == "optimal" or (
        solution.status == "failed" and solution.residual <= CRUDE and solution.gap <= CRUDE * scale
    )
