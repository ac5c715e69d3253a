"""Guards what the checker excuses: never a share of more than a user can read, and never too large a size."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flint import ctx

import sparserob_core as sr
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.constraints import _is_at_rest
from sparserob_core.checker.claims.units import nominal_sizes, units_of
from sparserob_core.checker.outcome import RESOLVED
from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.program import TOLERANCE, EqualityErrors

PIECES = 8


def case_of(decision: Any, **more: Any) -> Case:
    """Two chains that nothing couples: ``x1' = 9 x2 + u1, x2' = x1``, and ``x3' = x4, x4' = u2``."""
    A = np.zeros((4, 4))
    A[0, 1], A[1, 0], A[2, 3] = 9.0, 1.0, 1.0
    B = np.zeros((4, 2))
    B[0, 0] = B[3, 1] = 1.0
    keywords: dict[str, Any] = {
        "initial_state": [0.5, 0.1, 0.0, 0.0],
        "terminal": [sr.Equality([None, None, 0.0, None])],
    }
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A, B, c=more.pop("drift", None)),
        horizon=8.0,
        control=sr.Box([-1, -1], [1, 1]),
        **{**keywords, **more},
    )
    grid = sr.Dictionary.indicators(np.linspace(0.0, 8.0, PIECES + 1))
    return Case(problem, grid, grid, {"decision": np.asarray(decision, dtype=float).tolist()})


IDLE = np.vstack([np.full(PIECES, 0.3), np.zeros(PIECES)])


def test_a_state_rests_where_it_begins_at_0_and_nothing_moves_it() -> None:
    pushed = IDLE.copy()
    pushed[1, 3] = 1e-12
    with ctx.workprec(96):
        assert _is_at_rest(case_of(IDLE), 2) and not _is_at_rest(case_of(IDLE), 0)
        assert not _is_at_rest(case_of(pushed), 2)
        assert not _is_at_rest(case_of(IDLE, initial_state=[0.5, 0.1, 0.0, 1e-12]), 2)
        assert not _is_at_rest(case_of(IDLE, drift=[0.0, 0.0, 0.0, 1e-12]), 2)
        assert not _is_at_rest(case_of(IDLE, initial_control=[0.0, 1e-12]), 2)


def test_a_size_is_never_more_than_the_state_has() -> None:
    """With few bits the balls of the trajectory are wide, and a size is what they all have at least."""
    rows, none = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [1, -3, 0, 0]]), np.zeros((3, 0))
    with ctx.workprec(400):
        true = nominal_sizes(case_of(IDLE), rows, none)
    for bits in (20, 30, 53):
        with ctx.workprec(bits):
            found = nominal_sizes(case_of(IDLE), rows, none)
        assert (found <= true * (1.0 + 1e-12)).all() and (found >= 0.0).all()
    assert found == pytest.approx(true, rel=0.05)


def test_what_is_resolved_of_a_curved_set_is_never_more_than_what_its_states_do() -> None:
    ball = sr.Ellipsoid(np.zeros(4), np.eye(4))
    case = case_of(np.zeros((2, PIECES)), initial_state=[1e-9, -1e-9 / 3.0, 0.0, 0.0], terminal=[ball])
    with ctx.workprec(200):
        (window,) = case.windows
        units = units_of(case, window)
        seen = nominal_sizes(case, np.eye(4), np.zeros((4, 0)))
        assert (RESOLVED * units.sums > seen).any()  # e^24 of what a control of 1 adds up to
        floors = np.array([units.least(axis, 1.0) for axis in np.eye(4)])
        assert (floors <= seen).all()
        assert floors == pytest.approx(np.minimum(RESOLVED * units.sums, seen))


def test_equalities_hold_where_every_one_does() -> None:
    allowed = np.array([1e-9, 1e-9])
    assert EqualityErrors(np.array([1e-9, 0.0]), allowed).kept
    assert not EqualityErrors(np.array([0.0, 1.1e-9]), allowed).kept
    assert not EqualityErrors(np.array([1.1e-9, 0.0]), allowed).kept


@pytest.mark.parametrize("unit", [0.5, 1.0, 4.0, 1024.0])
def test_a_curved_set_in_a_unit_above_its_width_excuses_less(unit: float) -> None:
    """The state stays at 0.01 of the ball, so that its width of 1 is what counts."""
    ball = sr.Ellipsoid(np.zeros(2), np.eye(2))
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]]),
        horizon=2.0,
        initial_state=[0.01, 0.0],
        control=sr.Box([-1], [1]),
        terminal=[ball],
    )
    grid = sr.Dictionary.indicators(np.linspace(0.0, 2.0, 5))
    (constraint,) = prepare(problem, grid, grid).constraints
    assert isinstance(constraint, CurvedConstraint)
    scale = constraint.divided(np.array([unit])).scale(np.zeros(4))
    assert min(1.0, scale) == pytest.approx(min(1.0, 1.0 / unit))
    family = prepare(problem, grid, grid).program.families[0]
    assert family.allowed(np.zeros(4)) == TOLERANCE
