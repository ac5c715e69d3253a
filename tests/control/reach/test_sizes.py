"""Guards control.reach.sizes: the size of a row is what a user can read off the constraint and the trajectory."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sparserob_core as sr
from sparserob_core.control.reach.sizes import nominal_sizes, row_sizes, widths
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.program import TOLERANCE

H = np.array([[1.0, 0.0], [-2.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
h = np.array([0.7, 1.0, 0.0, -3.0])


def test_the_width_is_that_to_the_opposite_row_in_the_rows_own_numbers() -> None:
    assert widths(H, h) == pytest.approx([1.2, 2.4, np.inf, np.inf])


def test_the_size_of_a_row_is_its_bound_or_its_width() -> None:
    assert row_sizes(H, h) == pytest.approx([1.2, 2.4, 0.0, 3.0])


def prepared(disturbance: sr.ConvexSet | None = None, **more: object):
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [2, -0.5]], [[0], [1]]),
        horizon=2.0,
        initial_state=[0.3, -0.2],
        control=sr.Box([-1], [1]),
        disturbance=disturbance,
        **more,  # type: ignore[arg-type]
    )
    indicators = sr.Dictionary.indicators(np.linspace(0.0, 2.0, 9))
    return prepare(problem, indicators, indicators)


def trajectory(control: np.ndarray, w: float = 0.0) -> np.ndarray:
    state, seen = np.array([0.3, -0.2]), [np.array([0.3, -0.2])]
    for u in control:
        push = np.array([w, u + w])
        found = solve_ivp(
            lambda t, x, b=push: np.array([[0, 1], [2, -0.5]]) @ x + b, (0, 0.25), state, rtol=1e-12, atol=1e-14
        )
        state = found.y[:, -1]
        seen.append(state)
    return np.array(seen)


def test_what_a_row_does_is_its_largest_value_along_the_nominal_trajectory() -> None:
    control = np.array([1.0, -1.0, 0.5, 0.0, -0.3, 0.9, -0.7, 0.2])
    found = nominal_sizes(prepared().functionals, control, H)
    assert found == pytest.approx(np.abs(trajectory(control) @ H.T).max(axis=0), rel=1e-9)


def test_the_disturbance_is_at_the_middle_of_its_set_and_adds_nothing_else() -> None:
    control, bound = np.full(8, -0.4), sr.Box([0.0, 0.0], [0.2, 0.2])
    found = nominal_sizes(prepared(bound).functionals, control, np.eye(2))
    assert found == pytest.approx(np.abs(trajectory(control, 0.1)).max(axis=0), rel=1e-9)


def test_rows_that_look_at_the_control_add_it() -> None:
    control, G = np.linspace(-1.0, 1.0, 8), np.array([[2.0], [0.0], [0.0], [1.0]])
    found = nominal_sizes(prepared().functionals, control, H, G)
    values = trajectory(control) @ H.T + np.append(control, control[-1])[:, None] @ G.T
    assert found == pytest.approx(np.abs(values).max(axis=0), rel=1e-9)


@pytest.mark.parametrize("share", [1.0, 2.0**-10])
def test_a_row_of_no_bound_is_judged_by_what_it_does(share: float) -> None:
    """``x1 + x2 <= 0``: the plant could bring it to 13 times what a small control does."""
    row = sr.Polytope(H=[[1.0, 1.0]], h=[0.0])
    model = prepared(terminal=[row])
    (family,) = model.program.families
    control = share * np.ones(8)
    size = np.abs(trajectory(control) @ np.ones(2)).max()
    assert family.allowed(control) == pytest.approx(TOLERANCE * min(1.0, size), rel=1e-9)


def test_a_row_that_is_larger_than_its_unit_is_judged_by_that() -> None:
    (family,) = prepared(terminal=[sr.Box([-3.0, -3.0], [3.0, 3.0])]).program.families
    assert family.allowed(np.ones(8)) == TOLERANCE
