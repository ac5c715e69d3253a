"""Above which factor on the disturbance no causal policy exists, beside the margin of a policy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sparserob_core.control.studies.causal import Ended, Limits
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.experiment.margin.scaling import Scaling
from sparserob_core.experiment.run.conclusion.causal import active, proven, searched
from sparserob_core.sip.events import Notify
from sparserob_core.sip.method import Tools
from sparserob_core.sip.result import Result

BEYOND = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)  # of a factor: how far above the largest that is not excluded one is tried


def causal_upper(
    model_at: Callable[[float], Transcription],
    scaling: Scaling,
    results: dict[float, Result],
    tools: Tools,
    notify: Notify,
) -> tuple[float, Ended | None]:
    """A factor at which, and above which, no causal policy exists, by checked multipliers, NaN where none was found;
    and why the search for it ended, ``None`` where there was none.

    A policy for a set serves every smaller one, so that what is excluded at a factor is excluded above. ``model_at``
    transcribes the problem at a factor, ``results`` are the policy's own runs by their factor.
    """
    from sparserob_core.experiment.run.events import StudyProgress

    known = [factor for factor, result in results.items() if factor > 0.0 and result.decision is not None]
    base = max(known, default=1.0)
    model = model_at(base)
    charge, result = model.answering.charge, results.get(base)
    if not charge.causal_signals:
        return np.nan, None
    notify(StudyProgress(text=f"looking for the factor of {scaling.of} above which no causal policy exists"))
    refused = [one for factor, one in results.items() if one.status == "infeasible" and factor > 0.0]
    rests = [] if result is None else active(model, result)
    rests += [at for one in refused for at in active(model, one)]
    search = searched(model, None if result is None else result.decision, rests)
    limits = Limits.of(charge, list(results.values()), model.program.n, lambda: tools.deadline.passed)
    found = search.largest_factor(scaling.highest / base, limits)
    if found is None:
        return np.nan, limits.ended
    tree, grown = found
    for step in BEYOND:
        factor = base * grown.value * (1.0 + step)
        if not 0.0 < factor <= scaling.highest:
            break
        problem = scaling.at(factor)
        stated = search.bound(tree, grown, np.inf, problem.disturbance, limits.ended, factor / base)
        if proven(model, problem, stated, tools.deadline) is not None:
            return factor, limits.ended
    return np.nan, limits.ended
