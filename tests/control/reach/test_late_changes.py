"""Guards control/reach/execution where changes of the control come late: exact, and enclosed on cells of time, under a
constant plant and one that changes with time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.transcribe import prepare
from tests.support.enclosed import assert_bounded_on_cells

A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.2, 0.0], [1.0, -0.7]])
CONTROL = np.array([[0.0, 0.8, -0.8, 0.0], [0.5, 0.5, 0.0, -0.2]])
JITTER, ENDS = 0.3, np.linspace(0.0, 3.0, 5)
PLANTS: dict[str, Any] = {
    "constant": sr.LinearSystem(A, B),
    "in t": sr.LinearSystem(A, B).in_time(3.0),
    "pieces": sr.SwitchedSystem([(0.85, sr.LinearSystem(A, B)), (3.0, sr.LinearSystem(A, B))]).in_time(3.0),
}


@pytest.fixture(scope="module", params=PLANTS)
def model(request: pytest.FixtureRequest) -> Transcription:
    problem = sr.OptimalControlProblem(
        system=PLANTS[request.param],
        horizon=3.0,
        initial_state=[-1.0, 0.3],
        control=sr.Box([-1.0, -1.0], [1.0, 1.0]),
        path=[sr.PathConstraint(sr.Polytope([[1.0, -0.4]], [0.7]), start=0.4)],
        jitter=JITTER,
    )
    dictionary = sr.Dictionary.indicators(ENDS)
    return prepare(problem, dictionary, dictionary)


def added(c: np.ndarray, time: float) -> float:
    """What late changes add to ``c'x(t)``, by quadrature between the zeros of each kernel."""
    total = 0.0
    for channel, k in np.ndindex(2, 3):
        begin, end = ENDS[k + 1], min(ENDS[k + 1] + JITTER, time)
        half = abs(CONTROL[channel, k + 1] - CONTROL[channel, k]) / 2.0
        if begin < end:
            kernel = lambda s, j=channel: abs(float(c @ expm(A * (time - s)) @ B[:, j]))  # noqa: E731
            total += half * quad(kernel, begin, end, limit=200, epsabs=1e-10)[0]
    return total


@pytest.mark.parametrize("time", [0.5, 0.9, 1.7, 3.0])
def test_what_late_changes_add_is_the_integral_over_the_time_in_which_they_are_late(
    model: Transcription, time: float
) -> None:
    execution, c = model.functionals.execution, np.array([1.0, -0.4])
    assert execution is not None
    command = model.functionals.control(model.functionals.decided_by(CONTROL))
    low, high = execution.enclosed(command, np.array([time]), c[None])[0]
    wanted = added(c, time)
    assert low - 1e-9 <= wanted <= high + 1e-9 and high - low <= 1e-8
    G, offset = model.functionals.rows(np.array([time]), c[None], np.zeros((1, 0)))
    x = model.functionals.decided_by(CONTROL)
    value = model.functionals.values(x, np.array([time]), c[None], np.zeros((1, 0)))
    assert G @ x + offset == pytest.approx(value, abs=1e-9)


def test_cells_hold_the_worst_delays_and_little_more(model: Transcription) -> None:
    (constraint,) = model.constraints
    assert isinstance(constraint, FlatConstraint)
    assert_bounded_on_cells(constraint, model.functionals.decided_by(CONTROL))
