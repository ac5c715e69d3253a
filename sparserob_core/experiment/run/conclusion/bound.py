"""The lower bound that a run writes: reduced by its rounding errors, or derived without any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.control.transcription.provable import add_assumptions
from sparserob_core.control.transcription.rounding import SMALL_GAP, reduce_bound
from sparserob_core.experiment.assemble import ControlExperiment, counting
from sparserob_core.experiment.directory.artefacts import finite
from sparserob_core.experiment.directory.certificate import certificate
from sparserob_core.experiment.run.conclusion.final_states import with_final_states
from sparserob_core.sip.evidence import NO_BOUND
from sparserob_core.sip.inner.solve import ADVICE
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.program import TOLERANCE
from sparserob_core.sip.proof.verdict import verdict
from sparserob_core.sip.result import MEANING, Result

BOUND_SECONDS = 10.0  # for a bound in ball arithmetic, where another bound holds too; where none does there is no limit
NO_TIME = "there was no time to see what the multipliers prove without rounding"
DERIVED_COST_ROUNDING = 1e-12  # of a cost
CROSSED = (
    "the lower bound {:.12g} that its multipliers prove is above the cost {:.12g} of a decision that was proven, by"
    " more than the tolerances of the proofs allow: one of the two is wrong, and neither is claimed; {}"
)
# Share of the bound that is taken off, so that a check with another precision derives no smaller one
BOUND_ALLOWANCE = 1e-13


def bounded(experiment: ControlExperiment, result: Result, deadline: Deadline) -> Result:
    """Return a result with the lower bound that its multipliers prove, and with the notes on what is not proven of it.

    The status is that of the new bound. It is ``failed`` where the bound is above the cost by more than the tolerances
    of the proofs allow.
    """
    model = experiment.transcription
    if result.status == "undecided" and not np.isfinite(result.dual.bound):
        result = replace(result, lower_bound=0.0)  # no term of a cost is negative, and nothing else is proven
    proven = with_final_states(model, result, experiment.gap_tolerance)
    return add_assumptions(model, _derive_bound(experiment, proven, deadline))


def unbounded(result: Result) -> Result:
    """Return a result without multipliers, for a run that has no time to see what they prove.

    The lower bound is 0, as no term of a cost is negative. An infeasible result becomes ``undecided``, a certified one
    ``verified``. The message of a claim names the gap that is left.
    """
    bare = replace(result, dual=NO_BOUND, lower_bound=0.0)
    if result.status == "infeasible":
        return replace(bare, status="undecided", message=NO_TIME, infeasible=None, decision=None)
    if result.status in ("certified", "verified"):
        message = f"{MEANING['verified']} (gap {bare.gap:.1e}); {NO_TIME}"
        ending = result.message.partition("; ")[2] if result.status == "verified" else ""
        return replace(bare, status="verified", message="; ".join(filter(None, [message, ending])))
    return bare


def _derive_bound(experiment: ControlExperiment, result: Result, deadline: Deadline) -> Result:
    """Return a result with the lower bound that its multipliers prove.

    Running bounds of rounding errors are cheap. Where multipliers are large, as those of nearly parallel rows are,
    these bounds may be all that keeps the gap open. The bound is then derived from the same multipliers in ball
    arithmetic, which omits no rounding error, nor any in the rows.

    Ball arithmetic is also used in three cases in which running bounds omit an error. The first: support points of sets
    that are no boxes give the worst deviations of a policy. No running bound has the error of these points. The second:
    there are errors of execution, whose integrals a running bound estimates by shares. The third: an inner loop acts
    beside the decision, and the rows of a running bound are those of the plant with it. No other bound is reported in
    these cases, however long it takes; undecided results have one, too. Raises
    `sparserob_core.sip.limits.deadline.OutOfTime` where the time of the run is over before.
    """
    tolerance = experiment.gap_tolerance
    weights = None if any(counting(experiment.loaded)) else experiment.program.finite.weights
    rounded = reduce_bound(experiment.transcription, result, tolerance, weights)
    feedback = experiment.transcription.feedback
    exact = experiment.problem.delivery is None and (
        feedback is None or (feedback.loop.spread.is_box and not feedback.loop.inner.acts)
    )
    is_claimed = result.status in ("certified", "verified")
    is_written = is_claimed or (result.status == "undecided" and not exact)
    if not is_written or tolerance is None or result.stopped:
        return rounded
    if exact and rounded.gap <= tolerance + SMALL_GAP:
        return rounded
    data = certificate(experiment, rounded)
    if data is None:
        return rounded
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import derived_bound
    from sparserob_core.checker.outcome import Broken, Clock, Unchecked

    arguments = experiment.problem, experiment.control, experiment.disturbance
    try:
        clock = Clock(deadline.at_most(BOUND_SECONDS if exact else np.inf))
        derived = derived_bound(Case(*arguments, finite(data), clock, policy=experiment.transcription.policy))
    except (Broken, Unchecked, ZeroDivisionError):
        if not exact:
            deadline.check()
        return rounded
    if is_claimed and derived - result.cost > _compute_allowance(result):
        return replace(rounded, status="failed", message=CROSSED.format(derived, result.cost, ADVICE))
    lowered = min(derived - BOUND_ALLOWANCE * abs(derived), result.cost)
    if not np.isfinite(lowered) or (lowered <= rounded.lower_bound if exact else lowered == rounded.lower_bound):
        return rounded
    improved = replace(rounded, lower_bound=lowered, dual=replace(rounded.dual, bound=lowered))
    if not is_claimed:
        return improved
    status, message = verdict(result.proofs, improved.gap, tolerance)
    ending = result.message.partition("; ")[2]  # why the method came to an end
    message = f"{message}; {ending}" if ending and status != "certified" else message
    return replace(improved, status=status, message=message)


def _compute_allowance(result: Result) -> float:
    """Return by how much the lower bound may be above the cost: the sum of multiplier times tolerance over all rows.

    `sip.working.ledger.alarm` has judged the bound before, in the program's own units.
    """
    units = {proof.family: proof.units for proof in result.proofs}
    allowed = np.inf if result.dual.mu.size else DERIVED_COST_ROUNDING * abs(result.cost)
    for cut in result.dual.cuts:
        row_units = units.get(cut.family)
        allowed += np.inf if row_units is None else cut.multiplier * TOLERANCE * float(row_units[cut.row])
    return allowed
