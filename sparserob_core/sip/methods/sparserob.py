"""The paper's algorithm SparseRob(x0, epsilon): the value ``g`` of the relaxed program, maximised over tuples of
indices.

Its theorem (the paper's, after Das, Aravind, Cherukuri and Chatterjee 2022, theorem 1): with as many indices as
decision variables the maximum of ``g`` over tuples is the value of the semi-infinite program, and its optimiser there
an optimiser. A search that has not met the maximum leaves constraints violated: by a little that tightened rows pay
for, so that a decision beside it is proven, or by more, so that it is refuted. The lower bound comes from multipliers.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator

from sparserob_core.errors import InputError
from sparserob_core.options import Options, part
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import DECIDING, EvaluationsFinished, forward_events, frozen, ignore
from sparserob_core.sip.evidence import Dual
from sparserob_core.sip.limits.deadline import LAST_STEP_SECONDS, Deadline, OutOfTime
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.methods.driver import drive
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.branch_and_bound import prove
from sparserob_core.sip.proof.verdict import include_found_violation, worst_of
from sparserob_core.sip.relaxed.batches import Batches, Oracle
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
from sparserob_core.sip.relaxed.tuples import TupleValue, imposed_program
from sparserob_core.sip.result import Result, SearchTrace
from sparserob_core.sip.rules import InnerStop, Metropolis, OptimisersSettle, OuterStep, OuterStop, Schedule, Selection
from sparserob_core.sip.search.search import Rules, Target, maximise
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.ledger import CheckedAnswer, Found, Ledger, prover_of
from sparserob_core.sip.working.plain import PlainRows
from sparserob_core.sip.working.tightening import back_off

# Of a limit, what a search leaves to the proof of what it has found. With a tenth of it a limit of
# some seconds leaves nothing proven; ten times as much is no search.
PROOF_SHARE_OF_LIMIT = 0.1
MAX_PROOF_SECONDS = 1.0
"""Seconds at most that it leaves, and that an interrupt waits for what was found. With a tenth of it nothing is proven
at an interrupt; ten times as many, and a key seems not to have been pressed."""

MORE_EVALUATIONS = "more evaluations (maximiser.budget) or indices (method.indices) would help"


class SparseRob(Method, Options):
    """Maximise ``g(epsilon; xi^1, ..., xi^D)`` for smaller and smaller ``epsilon``.

    ``formulation``: ``literal`` indices ``(t, Beta, p)`` as in the paper, or ``reduced`` ones ``(t, p)``, at which the
    worst ``Beta`` is in closed form. ``indices``: D, by default the number of decision variables. The four rules are
    the paper's user-defined pieces: ``regu`` gives the next weight, ``sc1`` ends the outer iteration, ``sc2`` a search,
    ``slcr`` is what a maximiser that walks accepts; each is a rule of `sparserob_core.sip.rules` or a function with the
    same arguments. ``tolerance``: relative gap at which the bounds have met. Raises `InputError` for a formulation that
    a family does not have, for a missing maximiser, and for weights that do not decrease.
    """

    searches: ClassVar[bool] = True

    formulation: Literal["reduced", "literal"] = "reduced"
    """What an index is: (t, p), the worst disturbance in closed form; or the paper's (t, Beta, p)."""

    indices: int | None = Field(default=None, ge=1, strict=True)
    """How many indices a tuple has; null: as many as there are decision variables (m N), which the theorem asks for."""

    regu: Any = part("rule", Schedule)
    """``Regu``: the next weight of the regulariser; null: the factor of ``continuation``."""

    sc1: Any = part("rule", OuterStop)
    """``SC1``: when the outer iteration stops, at the last weight of ``continuation`` at the latest; null:
    `optimisers_settle`."""

    sc2: Any = part("rule", InnerStop)
    """``SC2``: when a search stops, at the maximiser's budget at the latest; null: only then."""

    slcr: Any = part("rule", Selection)
    """``SlCr``: whether a maximiser that walks accepts a candidate; null: `metropolis`."""

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    @field_validator("regu", "sc1", "sc2", "slcr")
    @classmethod
    def _check_rule(cls, rule: object) -> object:
        """A rule, a function, or what the registry makes a rule of."""
        if rule is None or callable(rule) or (isinstance(rule, Mapping) and "name" in rule):
            return rule
        raise InputError(expected="the name of a rule, a mapping with a name, or a function", got=repr(rule))

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """`certified`, `verified`, or `refuted` with the uncertainty that breaks the decision of a search that ends too
        far from the maximum to be backed off; `infeasible` where ``g`` is infinite."""
        if tools.maximiser is None:
            raise InputError("maximiser: expected one, got none; the method sparserob is a search")
        if not program.families:
            raise InputError(
                "families: the method sparserob searches their indices, but the program has none; expected the method"
                " exchange"
            )
        imposed = imposed_program(program, self.formulation)
        relaxed = RelaxedProgram(imposed, tools.solver, tools.regulariser, deadline=tools.deadline)
        ledger = Ledger(program, relaxed, tools, self.tolerance)
        g = TupleValue(imposed, relaxed, self.indices or program.n)
        epsilon = 0.0 if tools.regulariser is None else tools.continuation.start
        outer = _OuterIteration(self, g, ledger, epsilon, tools.rng.uniform(g.domain.lower, g.domain.upper))
        result = drive(tools.deadline, outer.step, lambda error: ledger.stopped(error, prover_of(program, tools)))
        trace = SearchTrace.joined(outer.parts) if outer.parts else None
        evaluations = 0 if trace is None else int(trace.value.size)
        counts = {**result.counts, "rounds": len(outer.steps), "evaluations": evaluations}
        return replace(result, trace=trace, counts=counts)


@dataclass(eq=False)
class _OuterIteration:
    """The outer iteration: the weight ``epsilon`` and the best ``point`` so far, (t_0, Beta_0) to begin with; its
    ``steps``, and the ``parts`` of the search."""

    method: SparseRob
    g: TupleValue
    ledger: Ledger
    epsilon: float
    point: Array
    steps: list[OuterStep] = field(default_factory=list)
    parts: list[SearchTrace] = field(default_factory=list)

    def step(self, number: int) -> Result | None:
        """Iteration ``j``, counted from 0; its result where it is the last."""
        method, g, ledger, epsilon, j = self.method, self.g, self.ledger, self.epsilon, number - 1
        program, tools = ledger.program, ledger.tools

        # Maximise: g(epsilon; .) over tuples, from the best so far, until SC2; walks accept by SlCr.
        self.point = _search_tuples(method, g, ledger, self.parts, self.point, epsilon, j)
        value, x = g.at(self.point), g.solution.x
        answer = CheckedAnswer(g.solution, g.rows(), epsilon, value)
        self.steps.append(OuterStep(j, epsilon, value, program.cost(x), ledger.lower, x))
        if np.isfinite(value):
            separations = separate(program, x, tools, number=number)
            _prove_answer(ledger, answer, separations, tools)
            ledger.tell(number, answer, separations, np.inf, kept=int((answer.multipliers > 0).sum()))

        # No optimiser: g is infinite where nothing meets the constraints at the tuple.
        if g.solution.status == "infeasible" or not np.isfinite(x).all():
            return ledger.without(answer)

        # Regu: the next weight, unless SC1: when the optimisers of successive weights are near one another.
        sc1 = method.sc1 or OptimisersSettle()
        if epsilon > tools.continuation.stop and not sc1(self.steps):
            self.epsilon = tools.continuation.lighter(epsilon, number, method.regu)
            return None

        # Terminate: judge the last one like any other.
        plain = ledger.relaxed.solve(answer.rows, 0.0)
        if plain.status == "optimal":
            ledger.improve(ledger.relaxed.lower_bound(answer.rows, plain))
        proofs = prove(program, x, tools.notify, deadline=tools.deadline)
        separations = separate(program, x, tools)
        worst_proofs = include_found_violation(proofs, separations)
        short = MORE_EVALUATIONS if any(proof.verdict == "refuted" for proof in worst_proofs) else ""
        result = ledger.judged(answer, worst_of(separations), worst_proofs, tools.deadline.reason or short)
        return _choose_result(ledger, result, answer)


def _choose_result(ledger: Ledger, result: Result, answer: CheckedAnswer) -> Result:
    """The result of the last ``answer``, or that of the decision that is proven in its place, with what that one is."""
    if result.status not in ("refuted", "undecided") or ledger.proven is None:
        return result
    proven_answer, separations, proofs = ledger.proven
    origin = f"is that of an earlier weight, epsilon = {proven_answer.epsilon:g}"
    if proven_answer.epsilon == answer.epsilon:
        origin = "keeps away from the constraints by as much as that of the search misses them by"
    ending = f"the decision {origin} ({result.message})"
    return ledger.judged(proven_answer, worst_of(separations), proofs, ledger.tools.deadline.reason or ending)


def _prove_answer(ledger: Ledger, answer: CheckedAnswer, found: Found, tools: Tools) -> None:
    """Keep an answer, and prove it or one that is backed off by the little that it misses the constraints by."""
    ledger.keep(answer, found)
    idle = np.zeros(answer.rows.h.size, dtype=int)
    working = PlainRows(ledger.program, rows=answer.rows, epsilon=answer.epsilon, idle=idle)
    back_off(working, ledger, prover_of(ledger.program, tools), answer, found)


def _search_tuples(
    method: SparseRob, g: TupleValue, ledger: Ledger, parts: list[SearchTrace], point: Array, epsilon: float, j: int
) -> Array:
    """The best tuple that one search for the maximum of ``g`` finds from ``point``; of every value that is the best so
    far the multipliers are turned into a lower bound. An interrupt leaves the optimiser of the best tuple with the
    ledger, proven or backed off where it can be, and goes on; so the search ends a little before a limit."""
    tools, start = ledger.tools, time.perf_counter() - ledger.started
    lower_bounds: list[float] = []
    g.epsilon = epsilon
    oracle = None if tools.rebuild is None else Oracle(tools.rebuild, method.formulation, g.layout.count)
    batches = Batches(g, oracle, tools.executor, tools.budget, watched=tools.notify is not ignore)

    def tell(value: float, bound: Dual | None) -> None:
        if bound is not None:
            ledger.improve(bound)
        lower_bounds.append(ledger.lower)

    def values(points: Array) -> Array:
        return batches.values(points, tell)

    def completed(event: EvaluationsFinished) -> EvaluationsFinished:
        deciding = frozen(g.deciding(batches.taken(event.count), DECIDING))
        lower = ledger.lower
        return replace(
            event, round=j + 1, epsilon=epsilon, lower_bound=lower, coordinates=g.coordinates, deciding=deciding
        )

    assert tools.maximiser is not None
    rules = Rules(method.sc2, method.slcr or Metropolis(), tools.polish)
    target = Target(values, g.domain, g.gradient, g.block, g.linear, g.acting)
    notify = forward_events(tools.notify, EvaluationsFinished, completed)
    early_deadline = tools.deadline.sooner(
        min(MAX_PROOF_SECONDS, PROOF_SHARE_OF_LIMIT * (tools.deadline.seconds or 0.0))
    )
    ledger.relaxed.deadline = early_deadline
    report = maximise(target, tools.maximiser, tools.budget, tools.rng, rules, notify, point)
    ledger.relaxed.deadline = tools.deadline
    parts.append(SearchTrace.of(j, epsilon, report.trace, np.array(lower_bounds[: report.evaluations]), start))
    if report.interrupted:
        _save_interrupted(g, ledger, report.best_point, report.best_value, epsilon)
        raise (OutOfTime if early_deadline.passed else KeyboardInterrupt)(
            report.stopped
        )  # of which only one was pressed
    return report.best_point


def _save_interrupted(g: TupleValue, ledger: Ledger, point: Array, value: float, epsilon: float) -> None:
    """Leave the optimiser of the best tuple with the ledger, proven or backed off if that takes no more than a moment,
    in which nothing is told and another interrupt ends it."""
    ledger.relaxed.deadline = Deadline()  # one last program
    if np.isfinite(value) and np.isfinite(g.at(point)):
        answer = CheckedAnswer(g.solution, g.rows(), epsilon, value)
        grace = Deadline(max(LAST_STEP_SECONDS, ledger.tools.deadline.at_most(MAX_PROOF_SECONDS)))
        ledger.keep(answer)
        tools, ledger.relaxed.deadline = replace(ledger.tools, deadline=grace, notify=ignore), grace
        with suppress(KeyboardInterrupt), grace.enforced():
            _prove_answer(ledger, answer, separate(ledger.program, answer.solution.x, tools), tools)
    ledger.relaxed.deadline = ledger.tools.deadline
