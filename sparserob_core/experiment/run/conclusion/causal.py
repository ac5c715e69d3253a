"""The bound for every causal policy: searched after a run under feedback, and derived without rounding errors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.experiment.directory.artefacts import finite
from sparserob_core.experiment.directory.certificate import causal_data
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.method import Tools
from sparserob_core.sip.result import Result

if TYPE_CHECKING:
    from sparserob_core.control.studies.causal import CausalBound

CAUSAL_BOUND_SECONDS = 20.0  # for a bound in ball arithmetic
WORDS = "; nor does any other causal policy with this dictionary exist: {} signals of the disturbance prove it"


def with_causal(result: ControlResult, tools: Tools) -> ControlResult:
    """Return a result with a lower bound of the cost of every causal policy.

    The bound is searched where the result has a policy and its cost is that of absolute values. Otherwise the result is
    returned as it is. So is that of a run that failed, was stopped, or has no time left.
    """
    model = result.model
    if model.feedback is None or result.status == "failed" or result.stopped or tools.deadline.passed:
        return result
    from sparserob_core.control.studies.causal import CausalBound, CausalLimits, CausalSearch

    charge = model.feedback.charge
    if not charge.causal_signals or not model.problem.cost.is_linear:
        return result
    try:
        search = CausalSearch(model, result.decision, active(model, result))
        limits = CausalLimits.of(charge, [result], model.program.n, lambda: tools.deadline.passed)
        cost = result.cost if result.status in ("certified", "verified") else np.inf
        solved_tree = search.least_cost(cost, limits)
        no_bound = replace(result, causal=CausalBound(-np.inf, ended=limits.ended))
        if solved_tree is None:
            return no_bound
        tree, solution, excludes_all = solved_tree
        causal_bound = search.bound(
            tree, solution, np.inf if excludes_all else solution.value, model.problem.disturbance, limits.ended
        )
        derived = proven(model, model.problem, causal_bound, tools.deadline)
    except KeyboardInterrupt as error:
        tools.deadline.interrupt(error)
        return result
    if derived is None:
        return no_bound
    if not causal_bound.rows:  # every cost is at least 0: worth reporting only where the cost of the policy is 0
        return replace(result, causal=CausalBound(0.0, ended=limits.ended)) if cost == 0.0 else no_bound
    if excludes_all:
        note = WORDS.format(len(causal_bound.signals)) if result.status == "infeasible" else ""
        return replace(result, causal=replace(causal_bound, lower=np.inf), message=result.message + note)
    return replace(result, causal=replace(causal_bound, lower=min(derived, cost)))


def _subtract_rest(rest: Array, signal: Array) -> Array:
    """Return the deviations of a disturbance ``signal (mw, blocks)`` from its rest, as one vector.

    ``rest`` holds the values at rest of the disturbance, followed by those of the initial state.
    """
    deviations: Array = signal.T.ravel() - rest[: signal.size]
    return deviations


def active(model: Transcription, result: Result) -> list[tuple[str, float, Array | None]]:
    """Return the name, the time and the deviations of each constraint that the lower bound of a result rests on."""
    middle, constraints = model.answering.loop.spread.middle, []
    for cut, explanation in zip(result.dual.cuts, model.explained(result.dual.cuts), strict=True):
        if explanation is not None:
            signal = explanation.disturbance
            deviations = None if signal is None else _subtract_rest(middle, np.asarray(signal))
            constraints.append((cut.family, explanation.time, deviations))
    return constraints


def proven(
    model: Transcription, problem: OptimalControlProblem, causal_bound: CausalBound, deadline: Deadline | None = None
) -> float | None:
    """Return the number that the multipliers of a causal bound prove, rounded downwards.

    Parameters
    ----------
    model : Transcription
        The problem on its dictionaries.
    problem : OptimalControlProblem
        The problem for which the bound is derived.
    causal_bound : CausalBound
        The bound, with its signals and multipliers.
    deadline : Deadline, optional
        The end of the time; the check takes at most `CAUSAL_BOUND_SECONDS`.

    Returns
    -------
    float or None
        The lower bound of the cost. Where no policy is claimed to exist: the amount by which every policy violates the
        sum of the constraints, or ``None`` where that is not positive. ``None`` also where nothing was derived.
    """
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import derived_causal_bound
    from sparserob_core.checker.outcome import Broken, Clock, Unchecked

    policy, excludes_all = model.answering.policy, causal_bound.lower == np.inf
    try:
        case = Case(
            problem,
            model.control,
            model.disturbance,
            {},
            Clock((deadline or Deadline()).at_most(CAUSAL_BOUND_SECONDS)),
            policy=policy,
        )
        derived = derived_causal_bound(case, finite(causal_data(causal_bound)), priced=not excludes_all)
    except (Broken, Unchecked, ZeroDivisionError):
        return None
    return None if excludes_all and not derived > 0.0 else derived
