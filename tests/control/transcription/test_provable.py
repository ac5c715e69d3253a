"""Guards control/transcription/provable: what can never be proven is known before anything is solved, and what hinders
a proof is named."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.inner_loop import NO_INNER_LOOP, InnerLoop
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.sets.sets import Ellipsoid
from sparserob_core.control.transcription.provable import growth, hindrance, unprovable
from sparserob_core.sip.convex_set import Box

ROUND = Ellipsoid([0.0, 0.0], np.eye(2))
FLAT = Box([-1.0, -1.0], [1.0, 1.0])
KNOWN = LinearSystem([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]])


def uncertain(A, most=1.5):
    return LinearSystem(A, [[0.0], [1.0]], parameters=Box([0.5], [most]))


def stiff(p):
    return np.array([[0.0 * p[0], 1.0], [-p[0], 0.0]])


OSCILLATOR = uncertain(stiff)


def problem(system=KNOWN, kind="measurable", **more):
    return OptimalControlProblem(
        system=system,
        horizon=1.0,
        initial_state=[0.0, 0.0],
        control=Box([-1.0], [1.0]),
        disturbance=Box([-0.1, -0.1], [0.1, 0.1]),
        disturbance_class=kind,
        **{"terminal": [FLAT], **more},
    )


@pytest.mark.parametrize(
    ("made", "named"),
    [
        (lambda: problem(uncertain(stiff, 1e7)), "uncertain parameters out of reach"),
        (lambda: problem(uncertain(lambda p: np.eye(2) * (p[0] > 1))), "uncertain parameters out of reach"),
        (lambda: problem(OSCILLATOR, terminal=[ROUND]), "curved"),
        (lambda: problem(OSCILLATOR, path=[ROUND]), "curved"),
        (lambda: problem(uncertain(lambda p: np.eye(2) * (p[0] > 1)), "piecewise_constant"), "branch"),
    ],
)
def test_what_can_never_be_proven_is_known_at_once(made, named):
    reason = unprovable(made())
    assert reason is not None
    assert named in reason


@pytest.mark.parametrize(
    "made",
    [
        problem,
        lambda: problem(KNOWN, "piecewise_constant", terminal=[ROUND]),
        lambda: problem(terminal=[ROUND], path=[ROUND]),
        lambda: problem(OSCILLATOR, "piecewise_constant"),
        lambda: problem(OSCILLATOR),
    ],
)
def test_nothing_stands_against_other_proofs(made):
    assert unprovable(made()) is None


def response(system, horizon, breakpoints=(0.0, 0.5, 1.0), inner=NO_INNER_LOOP):
    times = horizon * np.array(breakpoints)
    return Response(system, merge_grids(times, times), np.zeros(system.states), inner=inner)


def test_growth_over_the_horizon_is_named_where_it_matters():
    fast = LinearSystem([[3.0]], [[1.0]])
    assert growth(fast, 5.0) == pytest.approx(15.0)
    assert growth(KNOWN, 100.0) <= 1e-12
    assert not hindrance(response(KNOWN, 100.0), 100.0)
    assert "e^15" in hindrance(response(fast, 5.0), 5.0)


@pytest.mark.parametrize(
    ("more", "is_offered"),
    [({}, True), ({"delay": 0.1}, False), ({"parameters": Box([0.0], [1e-9])}, False)],
)
def test_an_inner_loop_is_advised_only_for_plants_that_it_is_built_for(more, is_offered):
    system = LinearSystem((lambda p: np.array([[3.0 + p[0]]])) if "parameters" in more else [[3.0]], [[1.0]], **more)
    advice = hindrance(response(system, 5.0), 5.0)
    assert "e^15" in advice and ("prestabilise" in advice) == is_offered


@pytest.mark.parametrize(
    ("breakpoints", "grown"),
    [((0.0, 0.5, 1.0), "e^7.5"), ((0.0, 0.2, 1.0), "e^12.0"), (np.linspace(0.0, 1.0, 16), "e^1.0"), (40, "")],
)
def test_beside_an_inner_loop_more_pieces_are_advised_where_the_plant_grows_between_its_answers(breakpoints, grown):
    times = np.linspace(0.0, 1.0, breakpoints) if isinstance(breakpoints, int) else breakpoints
    inner = InnerLoop(np.full((len(times) - 1, 1, 1), -4.0), np.ones(1))
    advice = hindrance(response(LinearSystem([[3.0]], [[1.0]]), 5.01, times, inner), 5.01)
    assert (grown in advice and "more pieces" in advice and "prestabilise" not in advice) if grown else not advice
