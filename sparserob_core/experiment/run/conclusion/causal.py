"""What no causal policy can do, beside what a policy does: sought after a run, and derived without rounding."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.experiment.directory.artefacts import finite
from sparserob_core.experiment.directory.certificate import causal_data
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.method import Tools
from sparserob_core.sip.result import Result

if TYPE_CHECKING:
    from sparserob_core.control.studies.causal import CausalBound, CausalSearch

SECONDS = 20.0  # for a bound in ball arithmetic
WORDS = "; nor does any other causal policy with this dictionary exist: {} signals of the disturbance prove it"


def with_causal(result: ControlResult, tools: Tools) -> ControlResult:
    """The result with a bound against every causal policy, where it has a policy and costs what absolute
    values do; a run that was stopped seeks none."""
    model = result.model
    if model.feedback is None or result.status == "failed" or result.stopped or tools.deadline.passed:
        return result
    from sparserob_core.control.studies.causal import CausalBound, Limits

    charge = model.feedback.charge
    if not charge.causal_signals or not model.problem.cost.is_linear:
        return result
    try:
        search = searched(model, result.decision, active(model, result))
        limits = Limits.of(charge, [result], model.program.n, lambda: tools.deadline.passed)
        cost = result.cost if result.status in ("certified", "verified") else np.inf
        for hides in (True, False):  # what a noise hides may be more than balls can show of a plant that grows fast
            found = search.least_cost(cost, limits, hides)
            nothing = replace(result, causal=CausalBound(-np.inf, ended=limits.ended))
            if found is None:
                return nothing
            tree, grown, none = found
            stated = search.bound(tree, grown, np.inf if none else grown.value, model.problem.disturbance, limits.ended)
            derived = proven(model, model.problem, stated, tools.deadline)
            if derived is not None or not stated.outputs:
                break
    except KeyboardInterrupt as error:
        tools.deadline.interrupt(error)
        return result
    if derived is None:
        return nothing
    if not stated.rows:  # no control costs less than nothing: news where the policy costs as little
        return replace(result, causal=CausalBound(0.0, ended=limits.ended)) if cost == 0.0 else nothing
    if none:
        said = WORDS.format(len(stated.signals)) if result.status == "infeasible" else ""
        return replace(result, causal=replace(stated, lower=np.inf), message=result.message + said)
    return replace(result, causal=replace(stated, lower=min(derived, cost)))


def _from(rest: Array, signal: Array) -> Array:
    """The deviations of a disturbance ``(mw, blocks)``; ``rest`` has those of the initial state after it."""
    found: Array = signal.T.ravel() - rest[: signal.size]
    return found


def active(model: Transcription, result: Result) -> list[tuple[str, float, Array | None]]:
    """Names, times and deviations of the constraints that the bound of a result rests on."""
    rest, found = model.answering.loop.spread.middle, []
    for cut, said in zip(result.dual.cuts, model.explained(result.dual.cuts), strict=True):
        if said is not None:
            signal = None if model.answering.loop.measurable is not None else said.disturbance
            found.append((cut.family, said.time, None if signal is None else _from(rest, np.asarray(signal))))
    return found


def searched(
    model: Transcription, decision: Array | None, rests: list[tuple[str, float, Array | None]]
) -> CausalSearch:
    """The search for a bound, beside a policy's ``decision`` and what its own bound ``rests`` on. Of measurable
    disturbances those are looked at that are constant on the pieces of the grid: what no policy can do against these,
    none can do against all."""
    from sparserob_core.control.studies.causal import CausalSearch

    if model.answering.loop.measurable is None:
        return CausalSearch(model, decision, rests)
    pieces = Dictionary.indicators(model.response.grid.breakpoints)
    problem = replace(model.problem, disturbance_class="piecewise_constant")
    return CausalSearch(prepare(problem, model.control, pieces, policy=model.answering.policy), None, rests)


def proven(
    model: Transcription, problem: OptimalControlProblem, stated: CausalBound, deadline: Deadline | None = None
) -> float | None:
    """The lower bound of the cost that the multipliers prove, rounded downwards; where none is to exist, by how much
    every policy misses their sum. ``None`` where that is not positive, and where it is not derived."""
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import derived_causal_bound
    from sparserob_core.checker.outcome import Broken, Clock, Unchecked

    policy, none = model.answering.policy, stated.lower == np.inf
    try:
        case = Case(
            problem,
            model.control,
            model.disturbance,
            {},
            Clock((deadline or Deadline()).at_most(SECONDS)),
            policy=policy,
        )
        derived = derived_causal_bound(case, finite(causal_data(stated)), priced=not none)
    except (Broken, Unchecked, ZeroDivisionError):
        return None
    return None if none and not derived > 0.0 else derived
