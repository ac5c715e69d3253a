"""The least time of action: bounds of it over all admissible controls, reported with the control of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.control.problem.cost import by_time
from sparserob_core.control.sets.curved import NormBall
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.control.transcription.rounding import reduce_bound
from sparserob_core.experiment.assemble import ControlExperiment
from sparserob_core.sip.evidence import Activity
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.fewest import LeastCount, is_vertex, multiple
from sparserob_core.sip.methods.own_units import solve_in_own_units
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import Result
from sparserob_core.sip.working.counting import count, round_up_count, share_of

# Share of a bound that is taken off, so that a check with another rounding derives no smaller one
COUNT_ALLOWANCE = 1e-9
ROUNDS, CELLS = 30, 64
"""Rounds, and cells of a proof, that the other program may take where the run's own took fewer. With ten times fewer
rounds a control in a ball is not reached, as it takes some twenty tangents. With ten times fewer cells a vertex is not
proven where the control of the run hardly moves. With ten times more, cells of parameters, which are slow, are examined
for longer than the run took."""
ENDED, PROVEN = ("infeasible", "failed"), ("certified", "verified")


def with_activity(experiment: ControlExperiment, result: Result, tools: Tools) -> Result:
    """Return a result with bounds of the least share of time for which any admissible control of the dictionary must
    act.

    The lower bound comes from that of the cost, where the convex cost that underestimates the count is a multiple of
    it. The upper bound comes from the control of the result, where this is proven. Where the cost is no such multiple,
    or the control is no vertex, a second program gives the lower bound and one of its vertices the upper one. This
    program begins with the constraints that the result rests on.

    The second program takes no more rounds than the run did, and its proofs no more cells, or `ROUNDS` and `CELLS`
    where these are more. Where it ends early, its lower bound holds as far as it was proven, and the upper bound is
    that of the run's control. It is not solved for a run that was stopped.
    """
    program, proven = experiment.program, result.status in PROVEN
    if result.status in ENDED or program.activity is None or result.decision is None:
        return result
    base = program.finite
    norm = base.P is None and base.blocks is None and not base.q.any()
    if result.sparsest is not None and result.sparsest.letters is None:  # its own bounds are those of the count
        upper = _compute_share(program, result.cost) if proven else None
        return replace(result, activity=Activity(_compute_share(program, result.lower_bound) or 0.0, upper, norm=norm))
    # a cut of a sample is known by its number only, from which a check cannot derive its row
    is_checkable = result.sparsest is None and all(cut.formulation != "sampled" for cut in result.dual.cuts)
    factor = _compute_factor(experiment) if is_checkable else None
    lower_count = -np.inf if factor is None else _round_down(program, factor * result.lower_bound)
    upper_count, count_result = count(program, np.asarray(result.decision)) if proven else np.inf, None
    if factor is None or (proven and not is_vertex(program, result)):
        count_result = _minimise_count(experiment, result, tools, upper_count)
    if count_result is not None:  # only the account of the solver changes, not the relaxed programs of the method
        result = replace(result, solved_by=result.charged([count_result]).solved_by)
    activity = Activity(_compute_share(program, lower_count) or 0.0, _compute_share(program, upper_count), norm=norm)
    if count_result is not None and _round_down(program, count_result.lower_bound) > lower_count:
        lower_count = _round_down(program, count_result.lower_bound)
        activity = replace(activity, lower=_compute_share(program, lower_count) or 0.0, dual=count_result.dual)
    if (
        count_result is not None
        and count_result.decision is not None
        and _is_proven_better(program, count_result, upper_count)
    ):
        upper_count = count(program, count_result.decision)
        activity = replace(
            activity,
            upper=_compute_share(program, upper_count),
            decision=count_result.decision,
            proofs=count_result.proofs,
        )
    lower = activity.lower if activity.upper is None else min(activity.lower, activity.upper)
    return replace(result, activity=replace(activity, lower=lower))


def _is_proven_better(program: SemiInfiniteProgram, other: Result, count_limit: float) -> bool:
    """Return whether another decision counts less than ``count_limit`` and is proven for every family of
    constraints."""
    proven = other.status in PROVEN and len(other.proofs) == len(program.families)
    return (
        proven
        and np.isfinite(count_limit)
        and count(program, np.asarray(other.decision)) < count_limit * (1.0 - COUNT_ALLOWANCE)
    )


def _compute_factor(experiment: ControlExperiment) -> float | None:
    """Return a factor such that the count is at least this factor times the cost; ``None`` where the cost gives no
    bound.

    For vectors of channels that act together it comes from ``[u != 0] >= |u| / max |u|``: the largest norm of each
    vector, at the highest of its weights.
    """
    program, cost = experiment.program, experiment.problem.cost
    if program.finite.blocks is None or cost.is_quadratic or not cost.l1:
        return multiple(program)
    channels = experiment.problem.system.controls
    grouped_channels = {channel for block in cost.blocks for channel in block}
    groups = [*cost.blocks, *((channel,) for channel in range(channels) if channel not in grouped_channels)]
    lengths = [longest(experiment.problem.control, group) for group in groups]
    counts, highest = experiment.problem.counts, by_time(experiment.problem.weights)[1].max(axis=0)
    shares = [
        len(group) * float(counts[group[0]]) / (cost.l1 * float(highest[group[0]]) * size)
        for group, size in zip(groups, lengths, strict=True)
        if size > 0.0 and highest[group[0]] > 0.0
    ]
    return min(shares) * (1.0 - COUNT_ALLOWANCE) if shares else None


def longest(bound: ConvexSet, channels: Sequence[int]) -> float:
    """Return an upper bound of the norm of the vector of some channels; it is exact for a box and a Euclidean ball."""
    reach = float(np.linalg.norm(bound.reach(np.eye(bound.dimension))[list(channels)]))
    if isinstance(bound, NormBall) and bound.p == 2.0:
        return min(reach, bound.radius + float(np.linalg.norm(bound.centre[list(channels)])))
    return reach


def _round_down(program: SemiInfiniteProgram, least: float) -> float:
    return round_up_count(program, least - COUNT_ALLOWANCE * abs(least)) if np.isfinite(least) else -np.inf


def _compute_share(program: SemiInfiniteProgram, counted: float) -> float | None:
    return share_of(program, counted) if np.isfinite(counted) else None


def _minimise_count(experiment: ControlExperiment, result: Result, tools: Tools, count_limit: float) -> Result | None:
    """Return the result of the program whose cost is below the count; ``None`` where it gives nothing."""
    if result.stopped or tools.deadline.passed:
        return None
    try:
        cuts = [*result.dual.cuts, *result.indices]
        beaten, rounds = count_limit if np.isfinite(count_limit) else 0.0, max(ROUNDS, len(result.history))
        cells = {proof.family: max(CELLS, proof.cells) for proof in result.proofs}
        method = LeastCount(cuts, beaten, rounds, cells)
        count_result = solve_in_own_units(method, experiment.program, tools)
    except KeyboardInterrupt as error:
        tools.deadline.interrupt(error)
        return None
    return None if count_result.status in ENDED else reduce_bound(experiment.transcription, count_result, None)
