"""The factor at which a scaled problem ceases to be feasible.

It is found by one convex program where the factor enters linearly, and as a root of the slack otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.margin.scaling import Scaling
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.sip.events import Notify
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.relaxed.parametric import ParametricProgram, extreme_program, slack_program
from sparserob_core.sip.working.ledger import prove_nothing
from sparserob_core.sip.working.scaled import largest_factor, least_slack

SLACK_BOUND = 1e3  # bounds of the slack, in units of the violation without control
MAX_FACTORS = 80  # largest number of factors at which the slack is computed


@final
@dataclass(frozen=True)
class Critical:
    """The critical factor, without proof.

    Parameters
    ----------
    status : {"found", "always", "never", "unknown"}
        ``found``: the factor is between ``good`` and ``bad``. ``always``, ``never``: the problem seems feasible at
        every factor, or at none. ``unknown``: nothing was found.
    good, bad : float
        A factor that seems feasible, and one that seems infeasible.
    message : str, default ""
        The message of the program that was solved.
    cuts : sequence of Cut, default ()
        The constraints that were active, in the user's units.
    """

    status: Literal["found", "always", "never", "unknown"]
    good: float = np.nan
    bad: float = np.nan
    message: str = ""
    cuts: Sequence[Cut] = ()


def critical_factor(
    programs: ParametricProgram,
    joined: ParametricProgram | None,
    scaling: Scaling,
    tools: Tools,
    width: float,
    notify: Notify,
    unproven_answers: dict[float, str],
) -> Critical:
    """Find the critical factor to about ``width``; ordinary runs prove it afterwards.

    Parameters
    ----------
    programs : ParametricProgram
        The programs by their factor.
    joined : ParametricProgram or None
        The programs in units that do not depend on the factor, where it enters linearly.
    scaling : Scaling
        The problem as a function of the factor.
    tools : Tools
        The solver and the deadline.
    width : float
        The accuracy.
    notify : callable
        A function that receives `StudyProgress`.
    unproven_answers : dict
        The factors that were tried; the answer at each is added here.

    Returns
    -------
    Critical
        The factor.
    """
    if joined is not None:
        critical = _solve_one_program(joined, scaling, tools, width)
        if critical.status != "unknown" or not scaling.nested:
            return critical
    if scaling.of == "disturbance":
        critical = _solve_scaled_gains(programs, scaling, tools)
        if critical.status != "unknown":
            return critical
    return _search_by_slack(programs, scaling, tools, width, notify, unproven_answers)


def _solve_scaled_gains(programs: ParametricProgram, scaling: Scaling, tools: Tools) -> Critical:
    """Find the factor under feedback by one program, linear in the factor and in the product of gains and factor."""
    program = programs.program(1.0)
    program = program if program.own_units is None else program.own_units.program
    factor = largest_factor(program, tools, scaling.highest)
    if factor is None:
        return Critical("unknown")
    if factor >= (1.0 - 1e-6) * scaling.highest:
        return Critical("always", good=scaling.highest)
    return Critical("found", factor, factor)


def _solve_one_program(programs: ParametricProgram, scaling: Scaling, tools: Tools, width: float) -> Critical:
    """Find the factor as a decision variable of one program, whose two bounds meet at the critical factor."""
    program = extreme_program(programs, scaling.sense, scaling.highest)
    result = Exchange(tolerance=max(0.05 * width, 1e-9)).solve(program, replace(tools, regulariser=None))
    tools.deadline.check()
    if result.status == "infeasible":
        return Critical("never", message=result.message)
    if result.decision is None or not np.isfinite(result.lower_bound):
        return Critical("unknown", message=result.message)
    good, bad = float(result.decision[-1]), abs(result.lower_bound)
    if scaling.sense == "largest" and good >= (1.0 - 1e-6) * scaling.highest:
        return Critical("always", good=scaling.highest)
    if scaling.sense == "smallest" and good <= width:
        return Critical("always", good=0.0)
    bad = max(good, bad) if scaling.sense == "largest" else min(good, max(result.lower_bound, 0.0))
    return Critical("found", good, bad, cuts=_convert_to_user_units(programs.program(1.0), result.indices))


def _convert_to_user_units(program: SemiInfiniteProgram, cuts: Sequence[Cut]) -> list[Cut]:
    """Return the ``cuts`` of a program in its own units in those of the user."""
    units = {family.name: 1.0 if family.index_units is None else family.index_units for family in program.families}
    return [replace(cut, index=cut.index * units[cut.family]) for cut in cuts]


def _search_by_slack(
    programs: ParametricProgram,
    scaling: Scaling,
    tools: Tools,
    width: float,
    notify: Notify,
    unproven_answers: dict[float, str],
) -> Critical:
    """Find a bracket of the factor at which the least relaxation for feasibility changes its sign."""

    def slack(factor: float) -> float:
        value = _compute_slack(programs, factor, tools)
        answer = "feasible" if value <= 0 else "infeasible"
        unproven_answers[factor] = answer
        notify(StudyProgress(text=f"{scaling.of} at {factor:.9g}: {answer}"))
        return value

    good, bad = (0.0, 1.0) if scaling.sense == "largest" else (scaling.highest, 0.0)
    at_good = slack(good)
    if at_good > 0.0:
        return Critical("never")
    at_bad = slack(bad)
    while at_bad <= 0.0 and scaling.sense == "largest" and bad < scaling.highest:
        good, at_good, bad = bad, at_bad, min(2.0 * bad, scaling.highest)
        at_bad = slack(bad)
    if at_bad <= 0.0:
        return Critical("always", good=bad)
    return _bracket_root(slack, (good, at_good), (bad, at_bad), width)


def _compute_slack(programs: ParametricProgram, factor: float, tools: Tools) -> float:
    """Return the least relaxation of the rows that makes the program feasible.

    It is infinite where bounds or equalities cannot hold at all, or where the system is not defined.
    """
    try:
        program = programs.program(factor)
        program = program if program.own_units is None else program.own_units.program
        if program.spread is not None:
            return least_slack(program, tools)
        bounds = _bound_slack(program)
        result = Exchange(tolerance=1e-9).close(
            slack_program(program, *bounds), replace(tools, regulariser=None), prove_nothing
        )
    except InputError:
        if factor in (0.0, 1.0):
            raise
        return np.inf
    tools.deadline.check()
    return np.inf if result.decision is None else float(result.decision[-1])


def _bound_slack(program: SemiInfiniteProgram) -> tuple[float, float]:
    origin = np.zeros(program.n)
    violations = [
        float(family.worst(origin).violations.max()) for family in program.families if family.worst is not None
    ]
    size = SLACK_BOUND * (1.0 + max(map(abs, violations), default=0.0))
    return -size, size


def _bracket_root(
    slack: Callable[[float], float], good: tuple[float, float], bad: tuple[float, float], width: float
) -> Critical:
    """Return a bracket of the root of the slack, by the rule of false position.

    Each point is moved beyond the root, by a fifth of the width, towards the end that is further away. The interval is
    halved where this stalls.
    """
    stalled = 0
    for _ in range(MAX_FACTORS):
        span = abs(bad[0] - good[0])
        if span <= 0.5 * width:
            break
        (low, at_low), (high, at_high) = sorted([good, bad])
        share = abs(at_low) / (abs(at_low) + abs(at_high)) if np.isfinite(at_low) and np.isfinite(at_high) else 0.5
        share = 0.5 if stalled >= 2 or not 0.0 < share < 1.0 else share
        aim = low + share * span
        aim += 0.2 * width if aim - low < high - aim else -0.2 * width
        aim = float(np.clip(aim, low + 0.1 * min(width, span), high - 0.1 * min(width, span)))
        value = slack(aim)
        good, bad = ((aim, value), bad) if value <= 0.0 else (good, (aim, value))
        stalled = stalled + 1 if abs(bad[0] - good[0]) > 0.5 * span else 0
    return Critical("found", good[0], bad[0])
