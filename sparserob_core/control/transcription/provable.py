"""Obstacles to a proof, in words: known before anything is solved, or noticed where a proof does not advance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.reach.support import WITHOUT_PROOF
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.sets.strangers import strangers
from sparserob_core.control.transcription.terms.in_time import within_reach
from sparserob_core.control.transcription.terms.superposed import superposed
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.expressions.taylor import TaylorSpace
from sparserob_core.sip.result import Result

SECONDS = 30.0  # that the search takes for a problem that cannot be proven, unless a limit is given: for a witness
TINY = 1e-6  # of the parameters: a cell on which a system that can be enclosed at all will be
NOTABLE = 10.0  # logarithm of a growth from which rounding may be what hinders a proof


def unprovable(problem: OptimalControlProblem) -> str | None:
    """Return the reason why no control of a problem can ever be certified, whatever the method; ``None`` where no
    obstacle is known.

    Nothing is solved: this takes milliseconds.
    """
    problem = superposed(problem)  # parameters beside the time are no obstacle
    if problem.measurable is not None and problem.system.parameter_count:
        paths = [entry.set for entry in problem.windows]
        is_out_of_reach = not problem.system.varies
        if is_out_of_reach or any(convex.halfspaces() is None for convex in (*paths, *problem.terminal_sets)):
            over = (
                f"uncertain parameters out of reach ({within_reach(problem)})"
                if is_out_of_reach
                else "sets with curved sides"
            )
            return (
                f"{WITHOUT_PROOF}; this problem has {over}. With disturbance_class piecewise_constant it can be proven"
            )
    parameters = problem.system.parameters
    if parameters is None:
        return None
    box = ParameterIndex(parameters).box
    try:
        space = TaylorSpace(problem.system.parameter_count, 1)
        for mode in problem.system.forced.modes:
            mode.taylor(space, parameters.interior_point(), TINY * (box.upper - box.lower) / 2)
    except NotEnclosable as error:
        return str(error)
    return None


def announced(why: str, limited: bool) -> str:
    """Return the message at the beginning of a run that cannot end with a certificate."""
    ends = "" if limited else f"; the search for a witness ends after {SECONDS:g} s, unless limits.seconds is given"
    return f"{why}{ends}"


def remarked(problem: OptimalControlProblem, result: Result) -> Result:
    """Return the same result with a note on the unproven assumptions of its claim. Nothing is added where there is no
    claim, or no such assumption."""
    assumptions = remark(problem)
    if not assumptions or assumptions in result.message or result.status not in ("certified", "verified"):
        return result
    return replace(result, message=f"{result.message}; {assumptions}")


def remark(problem: OptimalControlProblem) -> str:
    """Return the unproven assumptions of a claim about a problem; empty where there are none. They are the properties
    that sets of plugins state of themselves."""
    kinds = sorted({convex.kind for convex in strangers(problem)})
    return f"what sets of the kind {', '.join(kinds)} say of themselves is believed" if kinds else ""


def growth(system: System, horizon: float) -> float:
    """Return the exponent of ``e`` by which the state can grow over the horizon: the largest real part of an eigenvalue
    of ``A(p)``, at a lattice of parameters, times the horizon; 0 where nothing grows."""
    points = ParameterIndex(system.parameters).lattice()[0]
    rate = max(float(np.linalg.eigvals(mode.matrices(points)[0]).real.max()) for mode in system.modes)
    return max(0.0, rate * horizon)


def hindrance(system: System, horizon: float) -> str:
    """Return the property of a system that keeps the bounds of a cell wide however small the cell is, and what would
    help; empty where the system is not the cause."""
    exponent = growth(system, horizon)
    if exponent < NOTABLE:
        return ""
    size = f"e^{exponent:.0f} = {np.exp(min(exponent, 700.0)):.1g}"
    return (
        f"the plant amplifies by {size} over the horizon, and double precision resolves {np.finfo(float).eps:.0e} of"
        " that; a shorter horizon, wider sets, or a plant that is stabilised before would help"
    )
