"""The paper's algorithm SparseRob(x0, epsilon): the value ``g`` of the relaxed program, maximised over tuples of
indices.

Its theorem (the paper's, after Das, Aravind, Cherukuri and Chatterjee 2022, theorem 1): with as many indices as
decision variables the maximum of ``g`` over tuples is the value of the semi-infinite program, and its optimiser there
an optimiser. A search that has not met the maximum leaves constraints violated; so every decision is proven or refuted
like any other, and the lower bound comes from multipliers.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from sparserob_core.errors import InputError
from sparserob_core.options import Options, part
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import EvaluationsFinished, RoundFinished, forwarded, frozen
from sparserob_core.sip.evidence import NO_BOUND, Cut, Dual, Proof
from sparserob_core.sip.maximiser import Report
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.program import SemiInfiniteProgram, WorstConstraint
from sparserob_core.sip.proof.branch_and_bound import prove
from sparserob_core.sip.proof.irreducible import irreducible
from sparserob_core.sip.proof.verdict import infeasible_subsystem, verdict, witness, worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows
from sparserob_core.sip.relaxed.tuples import TupleValue, imposed_program
from sparserob_core.sip.result import Result, SearchTrace, Status, relative_gap
from sparserob_core.sip.rules import Metropolis, OptimisersSettle, OuterStep
from sparserob_core.sip.search.search import Rules, Target, maximise
from sparserob_core.sip.separation.separation import separate


class SparseRob(Method, Options):
    """Maximise ``g(epsilon; xi^1, ..., xi^D)`` for smaller and smaller ``epsilon``.

    ``formulation``: ``literal`` indices ``(t, Beta, p)`` as in the paper, or ``reduced`` ones ``(t, p)``, at which the
    worst ``Beta`` is in closed form. ``indices``: D, by default the number of decision variables. The four rules are
    the paper's user-defined pieces: ``regu`` gives the next weight, ``sc1`` ends the outer iteration, ``sc2`` a search,
    ``slcr`` is what a maximiser that walks accepts; each is a rule of `sparserob_core.sip.rules` or a function with the
    same arguments. ``tolerance``: relative gap at which the bounds have met. Raises `InputError` for a formulation that
    a family does not have, for a missing maximiser, and for weights that do not decrease.
    """

    formulation: Literal["reduced", "literal"] = "reduced"
    """What an index is: (t, p), the worst disturbance in closed form; or the paper's (t, Beta, p)."""

    indices: int | None = Field(default=None, ge=1, strict=True)
    """How many indices a tuple has; null: as many as there are decision variables (m N), which the theorem asks for."""

    regu: Any = part("schedule")
    """``Regu``: the next weight of the regulariser; null: the factor of ``continuation``."""

    sc1: Any = part("outer_stop")
    """``SC1``: when the outer iteration stops, at the last weight of ``continuation`` at the latest; null:
    `optimisers_settle`."""

    sc2: Any = part("inner_stop")
    """``SC2``: when a search stops, at the maximiser's budget at the latest; null: only then."""

    slcr: Any = part("selection")
    """``SlCr``: whether a maximiser that walks accepts a candidate; null: `metropolis`."""

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    @field_validator("regu", "sc1", "sc2", "slcr")
    @classmethod
    def _rule(cls, rule: object) -> object:
        """A rule, a function, or what the registry makes a rule of."""
        if rule is None or callable(rule) or (isinstance(rule, Mapping) and "name" in rule):
            return rule
        raise InputError(f"expected the name of a rule, a mapping with a name, or a function, got {rule!r}")

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """`certified`, `verified` or, as a rule, `refuted` with the uncertainty that breaks the decision; `infeasible`
        where ``g`` is infinite."""
        if tools.maximiser is None:
            raise InputError("maximiser: expected one, got none; the method sparserob is a search")
        if not program.families:
            raise InputError(
                "families: the method sparserob searches their indices, but the program has none; expected the method"
                " exchange"
            )
        return _Run(self, program, tools).solve()


@dataclass(eq=False)
class _Run:
    """One run: ``g``, the best tuple so far, the lower bound."""

    method: SparseRob
    program: SemiInfiniteProgram
    tools: Tools
    started: float = field(default_factory=time.perf_counter)
    dual: Dual = NO_BOUND
    history: list[RoundFinished] = field(default_factory=list)
    steps: list[OuterStep] = field(default_factory=list)
    parts: list[SearchTrace] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.imposed = imposed_program(self.program, self.method.formulation)
        self.relaxed = RelaxedProgram(self.imposed, self.tools.solver, self.tools.regulariser)
        self.g = TupleValue(self.imposed, self.relaxed, self.method.indices or self.program.n)

    def solve(self) -> Result:
        sc1 = self.method.sc1 or OptimisersSettle()
        epsilon = 0.0 if self.tools.regulariser is None else self.tools.continuation.start
        point = self.tools.rng.uniform(self.g.domain.lower, self.g.domain.upper)  # (t_0, Beta_0)
        j = 0
        while True:
            point = self._search(point, epsilon, j)
            if self.g.solution.status == "infeasible" or not np.isfinite(self.g.solution.x).all():
                return self._without_answer(epsilon)
            if epsilon <= self.tools.continuation.stop or sc1(self.steps):
                return self._finished(epsilon)
            j += 1
            epsilon = self.tools.continuation.lighter(epsilon, j, self.method.regu)

    @property
    def lower(self) -> float:
        """The best lower bound proven so far."""
        return self.dual.bound

    def improve(self, dual: Dual) -> None:
        """Keep the better of two bounds."""
        self.dual = max(self.dual, dual, key=lambda one: one.bound)

    def _search(self, point: Array, epsilon: float, j: int) -> Array:
        """Maximise ``g`` from the best tuple so far; ``g`` is left at the tuple that is returned."""
        g, began = self.g, time.perf_counter() - self.started
        g.epsilon, bounds = epsilon, _Bounds(self)
        rules = Rules(self.method.sc2, self.method.slcr or Metropolis(), self.tools.polish)
        target = Target(bounds, g.domain, g.gradient, g.block)
        assert self.tools.maximiser is not None
        notify = forwarded(self.tools.notify, EvaluationsFinished, lambda event: self._completed(event, j, epsilon))
        report = maximise(target, self.tools.maximiser, self.tools.budget, self.tools.rng, rules, notify, point)
        self._record(report, bounds, epsilon, j, began)
        if report.interrupted:
            raise KeyboardInterrupt
        value = g.at(report.best_point)
        cost = self.program.cost(g.solution.x)
        self.steps.append(OuterStep(j, epsilon, value, cost, self.lower, g.solution.x))
        if np.isfinite(value):
            self._tell(j, epsilon)
        return report.best_point

    def _record(self, report: Report, bounds: _Bounds, epsilon: float, j: int, began: float) -> None:
        self.parts.append(
            SearchTrace.of(j, epsilon, report.trace, np.array(bounds.proven[: report.evaluations]), began)
        )

    def _completed(self, event: EvaluationsFinished, j: int, epsilon: float) -> EvaluationsFinished:
        return replace(event, round=j + 1, epsilon=epsilon, lower_bound=self.lower)

    def _tell(self, j: int, epsilon: float) -> None:
        found, rows = separate(self.program, self.g.solution.x, self.tools, number=j + 1), self.g.rows()
        worst = worst_of(found)
        added, dropped = _change(self.history[-1].imposed if self.history else (), rows.cuts)
        event = RoundFinished(
            round=j + 1,
            epsilon=epsilon,
            lower_bound=self.lower,
            upper_bound=np.inf,
            violation=worst.violation,
            worst_family=worst.constraint,
            active_indices=int((self.g.imposed.multipliers > 0).sum()),
            relaxed_programs=self.relaxed.solves,
            seconds=time.perf_counter() - self.started,
            cuts_added=len(added),
            cuts_dropped=len(dropped),
            cost=self.program.cost(self.g.solution.x),
            decision=frozen(self.g.solution.x),
            separations={family.name: one for family, one in found},
            imposed=rows.cuts,
            multipliers=frozen(self.g.imposed.multipliers),
            added=added,
            dropped=dropped,
        )
        self.history.append(event)
        self.tools.notify(event)

    def _worst(self) -> WorstConstraint:
        """The most violated constraint of the whole family, whatever the tuple."""
        return worst_of(separate(self.program, self.g.solution.x, self.tools))

    def _finished(self, epsilon: float) -> Result:
        rows, x = self.g.rows(), self.g.solution.x
        plain = self.relaxed.solve(rows, 0.0)
        if plain.status == "optimal":
            self.improve(self.relaxed.lower_bound(rows, plain))
        cost = self.program.cost(x)
        proofs: tuple[Proof, ...] = prove(self.program, x, self.tools.notify)
        status, message = verdict(
            proofs, relative_gap(self.lower, cost, self.program.cost_scale), self.method.tolerance
        )
        return replace(
            self._result(status, message, rows, cost, epsilon, witness(self.program, self._worst(), proofs)),
            proofs=proofs,
        )

    def _without_answer(self, epsilon: float) -> Result:
        rows, solution = self.g.rows(), self.g.solution
        if solution.status != "infeasible":
            return self._result("failed", "; ".join(solution.attempts) or solution.message, rows, np.nan, epsilon, None)
        rows, solution = irreducible(self.relaxed, rows, solution)
        y = solution.y[solution.y.size - rows.h.size :]
        found, worst = infeasible_subsystem(self.imposed, rows, y, solution.infeasibility)
        self.dual = self.relaxed.dual(rows, solution.y, solution.mu, solution.z, solution.infeasibility)
        rows = replace(rows, cuts=tuple(replace(cut, multiplier=float(m)) for cut, m in zip(rows.cuts, y, strict=True)))
        return replace(self._result("infeasible", found.sentence(), rows, np.nan, epsilon, worst), infeasible=found)

    def _result(
        self, status: Status, message: str, rows: Rows, cost: float, epsilon: float, worst: WorstConstraint | None
    ) -> Result:
        cuts = tuple(cut for cut in rows.cuts if cut.multiplier > 0.0)
        trace = SearchTrace.joined(self.parts)
        return Result(
            status=status,
            message=message,
            decision=self.g.solution.x if status not in ("infeasible", "failed") else None,
            cost=cost,
            value=self.steps[-1].value,
            epsilon=epsilon,
            lower_bound=np.inf if status == "infeasible" else self.lower,
            upper_bound=cost if status in ("certified", "verified", "undecided") else np.inf,
            worst=worst,
            indices=cuts,
            counts={
                "relaxed_programs": self.relaxed.solves,
                "rounds": len(self.steps),
                "active_indices": len(cuts),
                "solver_calls": self.relaxed.counted.calls,
                "evaluations": int(trace.value.size),
            },
            history=tuple(self.history),
            trace=trace,
            dual=self.dual,
            seconds=time.perf_counter() - self.started,
        )


class _Bounds:
    """``g`` for the maximiser; of every value that is the best so far the multipliers are turned into a lower bound."""

    def __init__(self, run: _Run) -> None:
        self.run, self.best = run, -np.inf
        self.proven: list[float] = []

    def __call__(self, points: Array) -> Array:
        return np.array([self._value(point) for point in points])

    def _value(self, point: Array) -> float:
        run = self.run
        value = run.g.at(point)
        if np.isfinite(value) and value > self.best:
            self.best = value
            run.improve(run.relaxed.lower_bound(run.g.rows(), run.g.solution))
        self.proven.append(run.lower)
        return value


def _change(before: Sequence[Cut], now: Sequence[Cut]) -> tuple[tuple[Cut, ...], tuple[Cut, ...]]:
    """The constraints that were added and those that were dropped."""
    old, new = ({(cut.family, cut.index.tobytes(), cut.row): cut for cut in cuts} for cuts in (before, now))
    return tuple(cut for key, cut in new.items() if key not in old), tuple(
        cut for key, cut in old.items() if key not in new
    )
