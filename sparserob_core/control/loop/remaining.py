"""Remaining problem from one breakpoint of the control on: the same constraints on a shorter horizon."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.combinations import refuse_cases
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.windows import MixedConstraint
from sparserob_core.control.response.time_grid import SAME_TIME
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.terms.accumulated import combine_states
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.convex_set import Array


def refuse_remaining(model: Transcription) -> None:
    """Raise `InputError` for a problem whose remaining horizon is no problem of the same kind, in one sentence."""
    problem, classes = model.problem, model.problem.classes
    cases = {
        "few functions of the control": not model.control.is_indicators,
        "few functions of the disturbance": "l1_ball" in classes
        or (classes == {"piecewise_constant"} and not model.disturbance.is_complete),
        "two classes": len(classes) > 1,
        "budget": problem.has_budget,
        "pieces of their own": problem.disturbance_breakpoints is not None,
        "integral": any(
            model.feedback is not None or np.any(entry.H) for entry in combine_states(model.stated).integral
        ),
        "delay": problem.system.delay > 0.0,
        "outputs": model.feedback is not None and problem.measurements is not None,
        "control_step and repeat": bool(problem.repeat)
        and problem.control_step is not None
        and (problem.control_step.halfspaces() is None or model.feedback is not None),
    }
    refuse_cases("resolve", cases)


def remaining_problem(
    model: Transcription,
    piece: int,
    state: Array,
    before: Array | None,
    alone: bool = False,
    again: Array | None = None,
) -> Transcription:
    """Return the problem that remains where piece ``piece`` of the control begins in ``state (d,)``, transcribed as the
    ``model`` was; its times begin at 0.

    The parameters may be any of their set, also those of a system that depends on time as well. The latter add nothing
    to a state that is measured, and begin to act from the measurement on. Every remaining piece of the disturbance may
    take any value of its own, also the rest of a piece that has begun. This covers at least everything that can happen.

    Parameters
    ----------
    model : Transcription
        The transcription of the whole problem.
    piece : int
        The piece of the control that begins now.
    state : array (d,)
        The measured state.
    before : array (m,) or None
        The last control, from which the first one takes a step where the problem has a ``control_step``.
    alone : bool
        True for the nominal control and state alone, without disturbance and without feedback.
    again : array (m,), optional
        Of a plan that repeats, the control with which the next period begins. The last control takes a step of
        ``control_step`` to it.
    """
    problem, begin = model.problem, float(model.control.breakpoints[piece])
    control = _restrict_dictionary(model.control, begin, problem.horizon)
    disturbance = control if alone else _restrict_dictionary(model.disturbance.merged(), begin, problem.horizon)
    horizon = control.horizon
    windows = [
        entry.remaining(begin, horizon, name=name)
        for entry, name in zip(problem.windows, problem.called("path"), strict=True)
    ]
    remainder = problem.remaining(
        begin,
        horizon,
        initial_state=state,
        initial_set=None,
        initial_control=before if problem.control_step is not None else None,
        path=[*filter(None, windows), *_build_seam(problem, control, again)],
        repeat=False,  # the return is among the windows
        **({"disturbance": None} if alone else {}),
    )
    assert remainder is not None
    return prepare(remainder, control, disturbance, policy=None if alone else model.policy)


def _restrict_dictionary(dictionary: Dictionary, begin: float, horizon: float) -> Dictionary:
    """Return the dictionary of the remaining pieces after ``begin``, with one indicator function for each piece."""
    slack = SAME_TIME * horizon
    later = dictionary.breakpoints[dictionary.breakpoints > begin + slack] - begin
    later[-1] = horizon - begin
    return Dictionary(np.concatenate([[0.0], later]), np.eye(later.size))


def _build_seam(problem: OptimalControlProblem, control: Dictionary, again: Array | None) -> list[MixedConstraint]:
    """Return the constraint on the last control, from which the first control of the next period is a step. The list is
    empty for a plan that does not repeat, and for a ``control_step`` without flat sides."""
    flat = None if problem.control_step is None else problem.control_step.halfspaces()
    if not problem.repeat or again is None or flat is None:
        return []
    (H, h), begin = flat, float(control.breakpoints[-2])
    zeros = np.zeros((h.size, problem.system.states))
    return [MixedConstraint(zeros, -H, h - H @ again, begin, control.horizon, name="seam")]
