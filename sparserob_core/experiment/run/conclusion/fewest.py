"""How little any admissible control must act: the interval that a run reports beside its own control."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.control.problem.cost import by_time
from sparserob_core.control.sets.curved import NormBall
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.control.transcription.rounding import rounded_down
from sparserob_core.experiment.assemble import ControlExperiment
from sparserob_core.sip.evidence import Activity
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.fewest import LeastCount, is_vertex, multiple
from sparserob_core.sip.methods.own_units import solve_in_own_units
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import Result
from sparserob_core.sip.working.counting import count, share_of, whole

INWARDS = 1e-9  # of a bound, so that whoever derives it with another rounding does not find less
ROUNDS, CELLS = 30, 64
"""Rounds, and cells of a proof, that the other program may take where the run's own took fewer. Of ten times fewer
rounds, a control in a ball is not met (it takes some twenty tangents); of ten times fewer cells, a vertex of a problem
whose own control hardly moves is not proven; of ten times more, cells of parameters, which take long, are examined for
longer than the run took."""
ENDED, PROVEN = ("infeasible", "failed"), ("certified", "verified")


def with_activity(experiment: ControlExperiment, result: Result, tools: Tools) -> Result:
    """The result with what is proven of the least share of time that any admissible control of the dictionary must act.

    Below by the lower bound of the cost where the convex cost below the count is a multiple of it, above by the control
    that is returned, where that is proven. Where it is no multiple, or that control no vertex, by a program of its own,
    which begins with the constraints that the result rests on, and by a vertex of it. That takes no more rounds, and
    proofs of no more cells, than the run itself, whatever there is to be gained: where it ends early, its lower bound
    holds as far as it came, and the upper one is that of the run's own control. A run that was stopped solves nothing
    more.
    """
    program, proven = experiment.program, result.status in PROVEN
    if result.status in ENDED or program.activity is None or result.decision is None:
        return result
    base = program.finite
    norm = base.P is None and base.blocks is None and not base.q.any()
    if result.sparsest is not None and result.sparsest.letters is None:  # its own bounds are those of the count
        upper = _share(program, result.cost) if proven else None
        return replace(result, activity=Activity(_share(program, result.lower_bound) or 0.0, upper, norm=norm))
    # the number of a sample tells nobody else
    told = result.sparsest is None and all(cut.formulation != "sampled" for cut in result.dual.cuts)
    factor = _factor(experiment) if told else None
    least = -np.inf if factor is None else _safe(program, factor * result.lower_bound)
    most, other = count(program, np.asarray(result.decision)) if proven else np.inf, None
    if factor is None or (proven and not is_vertex(program, result)):
        other = _other(experiment, result, tools, most)
    if other is not None:  # the relaxed programs of the method are what they were
        result = replace(result, solved_by=result.charged([other]).solved_by)
    activity = Activity(_share(program, least) or 0.0, _share(program, most), norm=norm)
    if other is not None and _safe(program, other.lower_bound) > least:
        least = _safe(program, other.lower_bound)
        activity = replace(activity, lower=_share(program, least) or 0.0, dual=other.dual)
    if other is not None and other.decision is not None and _admissible(program, other, most):
        most = count(program, other.decision)
        activity = replace(activity, upper=_share(program, most), decision=other.decision, proofs=other.proofs)
    lower = activity.lower if activity.upper is None else min(activity.lower, activity.upper)
    return replace(result, activity=replace(activity, lower=lower))


def _admissible(program: SemiInfiniteProgram, other: Result, most: float) -> bool:
    """Whether another decision counts less than ``most`` and is proven, family by family."""
    proven = other.status in PROVEN and len(other.proofs) == len(program.families)
    return proven and np.isfinite(most) and count(program, np.asarray(other.decision)) < most * (1.0 - INWARDS)


def _factor(experiment: ControlExperiment) -> float | None:
    """The count is at least this times the cost; with vectors of channels that act together by the longest that each
    can be, at the highest of its weights, for ``[u != 0] >= |u| / max |u|``. ``None`` where the cost says nothing."""
    program, cost = experiment.program, experiment.problem.cost
    if program.finite.blocks is None or cost.is_quadratic or not cost.l1:
        return multiple(program)
    channels = experiment.problem.system.controls
    taken = {channel for block in cost.blocks for channel in block}
    groups = [*cost.blocks, *((channel,) for channel in range(channels) if channel not in taken)]
    lengths = [longest(experiment.problem.control, group) for group in groups]
    counts, highest = experiment.problem.counts, by_time(experiment.problem.weights)[1].max(axis=0)
    shares = [
        len(group) * float(counts[group[0]]) / (cost.l1 * float(highest[group[0]]) * size)
        for group, size in zip(groups, lengths, strict=True)
        if size > 0.0 and highest[group[0]] > 0.0
    ]
    return min(shares) * (1.0 - INWARDS) if shares else None


def longest(bound: ConvexSet, channels: Sequence[int]) -> float:
    """At least how long the vector of some channels can be: exact for a box and for a Euclidean ball."""
    reach = float(np.linalg.norm(bound.reach(np.eye(bound.dimension))[list(channels)]))
    if isinstance(bound, NormBall) and bound.p == 2.0:
        return min(reach, bound.radius + float(np.linalg.norm(bound.centre[list(channels)])))
    return reach


def _safe(program: SemiInfiniteProgram, least: float) -> float:
    return whole(program, least - INWARDS * abs(least)) if np.isfinite(least) else -np.inf


def _share(program: SemiInfiniteProgram, counted: float) -> float | None:
    return share_of(program, counted) if np.isfinite(counted) else None


def _other(experiment: ControlExperiment, result: Result, tools: Tools, most: float) -> Result | None:
    """The program whose cost is below the count, solved; ``None`` where it gives nothing."""
    if result.stopped or tools.deadline.passed:
        return None
    try:
        known = [*result.dual.cuts, *result.indices]
        beaten, rounds = most if np.isfinite(most) else 0.0, max(ROUNDS, len(result.history))
        cells = {proof.family: max(CELLS, proof.cells) for proof in result.proofs}
        method = LeastCount(known, beaten, rounds, cells)
        found = solve_in_own_units(method, experiment.program, tools)
    except KeyboardInterrupt as error:
        tools.deadline.interrupt(error)
        return None
    return None if found.status in ENDED else rounded_down(experiment.transcription, found, None)
