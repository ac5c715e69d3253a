"""Guards `control.transcription.steps`: what is refused is contradicted by multipliers, and nothing feasible is."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.transcription import steps
from sparserob_core.control.transcription.transcribe import transcribe
from sparserob_core.errors import InputError

AXIS = np.array([[1.0], [-1.0]])


def problem(step: sr.ConvexSet, control: sr.ConvexSet, before: list[float]) -> sr.OptimalControlProblem:
    """A particle that is pushed, with a control before time 0."""
    m = control.dimension
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(np.zeros((1, 1)), np.ones((1, m))),
        initial_state=[0.0],
        horizon=1.0,
        control=control,
        control_step=step,
        initial_control=before,
    )


def pieces(count: int) -> sr.Dictionary:
    return sr.Dictionary.indicators(np.linspace(0.0, 1.0, count + 1))


@pytest.mark.parametrize(("size", "refused"), [(0.3, True), (0.499, True), (0.501, False), (1.0, False)])
@pytest.mark.parametrize("kind", ["box", "ball"])
def test_a_first_step_that_is_too_short_is_refused(kind: str, size: float, refused: bool) -> None:
    """From 1.5 to within 1 of 0 it takes a step of 0.5."""
    step = sr.Box([-size], [size]) if kind == "box" else sr.NormBall(2.0, size, dimension=1)
    stated = problem(step, sr.Box([-1.0], [1.0]), [1.5])
    if refused:
        with pytest.raises(InputError, match="no control that stays in its set and begins at"):
            transcribe(stated, pieces(4))
    else:
        transcribe(stated, pieces(4))


@pytest.mark.parametrize(("size", "refused"), [(0.99, True), (1.01, False)])
def test_of_curved_sets_tangents_refuse(size: float, refused: bool) -> None:
    """From (0.6, 0.8) times 2 to the disc of radius 1 it takes a step of length 1."""
    stated = problem(sr.NormBall(2.0, size, dimension=2), sr.NormBall(2.0, 1.0, dimension=2), [1.2, 1.6])
    if refused:
        with pytest.raises(InputError, match="no control that stays in its set and begins at"):
            transcribe(stated, pieces(3))
    else:
        transcribe(stated, pieces(3))


def test_steps_that_must_all_rise_end_beyond_the_set() -> None:
    """Steps of at least 0.7 lead from -1 to 1 in two of them, and there are three."""
    control = sr.Box([-1.0], [1.0])
    stated = problem(sr.Box([0.7], [0.9]), control, [-1.5])
    transcribe(stated, pieces(3))
    with pytest.raises(InputError, match="no control that stays in its set"):
        transcribe(stated, pieces(4))


@pytest.mark.parametrize("wrong", [0.9, 1.0, 1.1])
def test_only_multipliers_that_cancel_contradict(wrong: float) -> None:
    """``u <= -1`` and ``-u <= 0.99`` with ``|u| <= 3``: other multipliers leave a slope, which ``u`` makes up for."""
    heights, reach = np.array([-1.0, 0.99]), np.array([3.0])
    assert steps._contradict(AXIS, heights, np.array([1.0, wrong]), reach) == (wrong == 1.0)
    assert not steps._contradict(AXIS, np.array([-1.0, 1.0]), np.array([1.0, 1.0]), reach)
