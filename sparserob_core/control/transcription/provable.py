"""Obstacles to a proof, in words: known before anything is solved, or noticed where a proof does not advance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.reach.support import WITHOUT_PROOF
from sparserob_core.control.response.orbit import NOTABLE, growth
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response
from sparserob_core.control.sets.strangers import strangers
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.terms.in_time import within_reach
from sparserob_core.control.transcription.terms.superposed import parameters_as_states
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.expressions.taylor import TaylorSpace
from sparserob_core.sip.result import Result

# That the search takes for a problem that cannot be proven, unless a limit is given: for a witness
UNPROVABLE_SECONDS = 30.0
# Exponent of what a plant grows by between two answers of an inner loop, from which more pieces are advised: random
# plants are decided below it, and some are not at three times as much
GROWS_BETWEEN = 1.0
PROBED_CELL_SHARE = 1e-6  # of the parameters: a cell on which a system that can be enclosed at all will be


def unprovable(problem: OptimalControlProblem) -> str | None:
    """Return the reason why no control of a problem can ever be certified, whatever the method; ``None`` where no
    obstacle is known.

    Nothing is solved: this takes milliseconds.
    """
    problem = parameters_as_states(problem)  # parameters beside the time are no obstacle
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
            mode.taylor(space, parameters.interior_point(), PROBED_CELL_SHARE * (box.upper - box.lower) / 2)
    except NotEnclosable as error:
        return str(error)
    return None


def announce(why: str, limited: bool) -> str:
    """Return the message at the beginning of a run that cannot end with a certificate."""
    ends = (
        ""
        if limited
        else f"; the search for a witness ends after {UNPROVABLE_SECONDS:g} s, unless limits.seconds is given"
    )
    return f"{why}{ends}"


def add_assumptions(model: Transcription, result: Result) -> Result:
    """Return the same result with what its reader has to know beside it.

    A claim gets its unproven assumptions, and what rounding does to a control in open loop. A result without a claim
    gets the property of the plant that may be the reason. Nothing is added twice.
    """
    if result.status in ("certified", "verified"):
        remarks = [unproven_assumptions(model.problem), *promised(model)]
    else:
        advice = hindrance(model.response, model.problem.horizon)
        remarks = [] if result.status == "infeasible" or advice in result.message else [advice]
    added = [text for text in remarks if text and text not in result.message]
    return replace(result, message="; ".join([result.message, *added])) if added else result


def unproven_assumptions(problem: OptimalControlProblem) -> str:
    """Return the unproven assumptions of a claim about a problem; empty where there are none. They are the properties
    that sets of plugins state of themselves."""
    kinds = sorted({convex.kind for convex in strangers(problem)})
    return f"what sets of the kind {', '.join(kinds)} say of themselves is believed" if kinds else ""


def promised(model: Transcription) -> list[str]:
    """Return what a control in open loop can promise on a plant that amplifies: where the last digits of doubles move
    the end. Nothing is returned under feedback, and for plants that amplify little."""
    problem = model.problem
    if model.acting.answers_by is not None or growth(problem.system, problem.horizon) < NOTABLE:
        return []
    d, middle = problem.system.states, model.parameters.middle
    weights = model.response.weights(np.full(d, problem.horizon), np.eye(d), np.tile(middle, (d, 1))).control
    reach = problem.control.reach(np.eye(problem.system.controls))
    moved = np.abs(weights[..., : reach.size]).sum(axis=1) @ reach * np.finfo(float).eps / 2.0
    state = int(np.argmax(moved))
    name, units = problem.names.state(state), problem.names.state_units
    distance = f"{moved[state]:.1g} {units[state]}" if state < len(units) else f"{moved[state]:.1g}"
    digits = f"in open loop an error in the last digit of the control ends up to {distance} off in {name}"
    return [
        f"{digits}; feedback with prestabilise does not let it grow" if _takes_inner_loop(problem.system) else digits
    ]


def hindrance(response: Response, horizon: float) -> str:
    """Return the property of a plant that keeps the bounds of a cell wide however small the cell is, and what would
    help; empty where the plant is not the cause."""
    system, grid = response.system, response.grid
    exponent = growth(system, horizon)
    if exponent < NOTABLE:
        return ""
    if response.inner.acts:
        between = growth(system, float(np.bincount(grid.control_piece, grid.lengths).max()))
        statement = f"between two answers of the inner loop the plant amplifies by e^{between:.1f}"
        return f"{statement}; more pieces of the control would help" if between >= GROWS_BETWEEN else ""
    size = f"e^{exponent:.0f} = {np.exp(min(exponent, 700.0)):.1g}"
    remedies = "a shorter horizon or wider sets"
    if _takes_inner_loop(system):
        remedies = "a shorter horizon, wider sets, or feedback with policy.prestabilise: auto"
    return (
        f"the plant amplifies by {size} over the horizon, and double precision resolves {np.finfo(float).eps:.0e} of"
        f" that; {remedies} would help"
    )


def _takes_inner_loop(system: System) -> bool:
    """Return whether feedback with an inner loop is built for a system: a known one, without entries in time and
    without a delay."""
    return not (system.parameter_count or system.varies or system.delay)
