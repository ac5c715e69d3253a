"""Fixed final states that rounding alone leaves open: enclosed in ball arithmetic, which leaves out no rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.control.transcription.record import Transcription
from sparserob_core.sip.proof.verdict import verdict
from sparserob_core.sip.result import Result

ENCLOSURE_SECONDS = 20.0  # for an enclosure in ball arithmetic
OUTWARDS = 1.0 + 1e-12  # factor of the errors, so that a check with another precision derives no larger ones


def with_final_states(model: Transcription, result: Result, tolerance: float | None) -> Result:
    """Return the result with closer bounds of the errors of its fixed final states, and the status that these allow.

    Parameters
    ----------
    model : Transcription
        The problem on its dictionaries.
    result : Result
        A result in the user's units. It is returned as it is unless the errors of fixed final states keep it open.
    tolerance : float or None
        The relative gap at which the bounds have met.

    Returns
    -------
    Result
        The same decision; certified or verified where the final states are proven to hold.
    """
    errors = result.errors
    if errors is None or errors.kept or result.decision is None or result.status != "undecided":
        return result
    error_bounds = _enclose_errors(model, result)
    if error_bounds is None:
        return result
    improved = replace(result, errors=replace(errors, missed=np.minimum(errors.missed, error_bounds)))
    assert improved.errors is not None
    if not improved.errors.kept:
        return improved
    upper, lower = result.cost, min(result.lower_bound, result.cost)
    bounded = replace(improved, upper_bound=upper, lower_bound=lower)
    status, message = verdict(result.proofs, bounded.gap, tolerance or 0.0)
    return replace(bounded, status=status, message=message)


def _enclose_errors(model: Transcription, result: Result) -> np.ndarray | None:
    """Return the largest errors of the fixed final states ``(e,)``, in the user's units; ``None`` where they are not
    found."""
    from flint import ctx

    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import precision_of
    from sparserob_core.checker.claims.constraints import compute_residuals
    from sparserob_core.checker.outcome import Broken, Clock, Unchecked

    assert result.decision is not None
    theta = model.nominal(result.decision).reshape(model.problem.system.controls, -1)
    case = Case(model.stated, model.control, model.disturbance, {"decision": theta.tolist()}, Clock(ENCLOSURE_SECONDS))
    try:
        with ctx.workprec(precision_of(case)):
            error_bounds = [float(error_bound.upper()) * OUTWARDS for error_bound, _ in compute_residuals(case)]
    except (Broken, Unchecked, ZeroDivisionError):
        return None
    return np.array(error_bounds) if np.isfinite(error_bounds).all() else None
