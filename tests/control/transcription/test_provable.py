"""Guards control/transcription/provable: what can never be proven is known before anything is solved, and what hinders
a proof is named."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem
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


def test_growth_over_the_horizon_is_named_where_it_matters():
    assert growth(LinearSystem([[3.0]], [[1.0]]), 5.0) == pytest.approx(15.0)
    assert growth(KNOWN, 100.0) <= 1e-12
    assert not hindrance(KNOWN, 100.0)
    assert "e^15" in hindrance(LinearSystem([[3.0]], [[1.0]]), 5.0)
