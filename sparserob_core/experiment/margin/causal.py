"""The factor on the disturbance above which no causal policy exists, reported with the margin of a policy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sparserob_core.control.studies.causal import CausalLimits, CausalSearch, Ended
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.experiment.margin.scaling import Scaling
from sparserob_core.experiment.run.conclusion.causal import active, proven
from sparserob_core.sip.events import Notify
from sparserob_core.sip.method import Tools
from sparserob_core.sip.result import Result

BEYOND = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)  # relative distances above the largest factor that is not excluded


def causal_upper(
    model_at: Callable[[float], Transcription],
    scaling: Scaling,
    results: dict[float, Result],
    tools: Tools,
    notify: Notify,
) -> tuple[float, Ended | None]:
    """Return a factor from which on no causal policy exists, proven by checked multipliers.

    A policy for a set also serves every smaller one, so that a factor that is excluded excludes all larger ones.

    Parameters
    ----------
    model_at : callable
        The transcription of the problem at a factor.
    scaling : Scaling
        The problem as a function of the factor.
    results : dict
        The runs of the policy, by their factor.
    tools : Tools
        The solver and the deadline.
    notify : callable
        A function that receives `StudyProgress`.

    Returns
    -------
    factor : float
        The factor; NaN where none was found.
    ended : str or None
        The reason for which the search ended; ``None`` where there was none.
    """
    from sparserob_core.experiment.run.events import StudyProgress

    factors = [factor for factor, result in results.items() if factor > 0.0 and result.decision is not None]
    base = max(factors, default=1.0)
    model = model_at(base)
    charge, result = model.answering.charge, results.get(base)
    if not charge.causal_signals:
        return np.nan, None
    notify(StudyProgress(text=f"looking for the factor of {scaling.of} above which no causal policy exists"))
    infeasible = [entry for factor, entry in results.items() if entry.status == "infeasible" and factor > 0.0]
    constraints = [] if result is None else active(model, result)
    constraints += [constraint for entry in infeasible for constraint in active(model, entry)]
    search = CausalSearch(model, None if result is None else result.decision, constraints)
    limits = CausalLimits.of(charge, list(results.values()), model.program.n, lambda: tools.deadline.passed)
    solved_tree = search.largest_factor(scaling.highest / base, limits)
    if solved_tree is None:
        return np.nan, limits.ended
    tree, solution = solved_tree
    for step in BEYOND:
        factor = base * solution.value * (1.0 + step)
        if not 0.0 < factor <= scaling.highest:
            break
        problem = scaling.at(factor)
        causal_bound = search.bound(tree, solution, np.inf, problem.disturbance, limits.ended, factor / base)
        if proven(model, problem, causal_bound, tools.deadline) is not None:
            return factor, limits.ended
    return np.nan, limits.ended
