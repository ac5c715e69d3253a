"""Guards plugins/sparserob_minimum_attention: minimum attention: the augmented problem."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_minimum_attention import MinimumAttention

CONFIG = {
    "system": {"A": [[0, 1], ["-2 + p1", -0.5]], "B": [[0, 1], ["1 + p1", 0]], "parameters": {"p1": [-0.1, 0.1]}},
    "horizon": 5.0,
    "initial_state": [-1, 1],
    "rate": {"box": 2.0},
    "disturbance": {"box": 0.05},
}


def build(**changes) -> sr.OptimalControlProblem:
    return MinimumAttention(**{**CONFIG, **changes}).build()


def test_the_augmented_system_integrates_the_rate_into_the_control() -> None:
    A, B, E = build().system.phases[0].matrices(np.array([[0.1]]))
    np.testing.assert_allclose(A[0], [[0, 1, 0, 1], [-1.9, -0.5, 1.1, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    np.testing.assert_array_equal(B[0], [[0, 0], [0, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(E[0], [[1, 0], [0, 1], [0, 0], [0, 0]])


def test_the_control_starts_where_it_is_told_and_ends_at_zero() -> None:
    made = build(initial_control=[0.5, -0.5])
    np.testing.assert_array_equal(made.initial_state, [-1, 1, 0.5, -0.5])
    np.testing.assert_array_equal(made.terminal[-1].values, [np.nan, np.nan, 0, 0])
    np.testing.assert_array_equal(build().initial_state, [-1, 1, 0, 0])


def test_sets_of_the_state_leave_the_control_free_and_its_own_bounds_are_a_path_constraint() -> None:
    made = build(
        control={"box": [1.0, 2.0]},
        path=[{"box": [0.7, None], "from": 1.0}],
        terminal=[{"box": 0.3}, {"equals": [0, None]}, {"ellipsoid": {"shape": 1.0}}],
    )
    state, control = made.path
    assert (state.start, state.stop, control.start, control.stop) == (1.0, 5.0, 0.0, 5.0)
    assert state.set.contains(np.array([0.7, 9, 9, 9])) and not state.set.contains(np.array([0.8, 0, 0, 0]))
    assert control.set.contains(np.array([9, 9, 1, -2])) and not control.set.contains(np.array([0, 0, 0, 2.1]))
    box, equality, ellipsoid, end = made.terminal
    assert box.contains(np.array([0.3, -0.3, 9, 9])) and ellipsoid.contains(np.array([0.6, 0.8, 9, 9]), 1e-9)
    np.testing.assert_array_equal(equality.values, [0, np.nan, np.nan, np.nan])
    assert end.fixed.tolist() == [2, 3]


def test_the_rate_is_the_control_of_the_augmented_problem() -> None:
    made = build(rate={"norm": {"p": 1, "radius": 2}}, weights=[1, 2])
    assert made.control.support(np.array([[1.0, 1.0]]))[0] == pytest.approx(2.0)
    np.testing.assert_array_equal(made.weights, [1, 2])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initial_control": [0, 0, 0]}, "initial_control: expected 2 numbers, one per control, got 3"),
        ({"rate": {"box": [1, 2, 3]}}, r"rate\.box: expected 2 numbers, got 3"),
        ({"control": {"ellipsoid": {"shape": 1}}}, "control: expected a set with flat sides"),
        ({"rate": {}}, "expected a set"),
    ],
)
def test_options_that_do_not_fit_say_so(changes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(**changes)


def test_the_rate_has_no_default() -> None:
    with pytest.raises(ValueError, match="rate"):
        MinimumAttention(**{key: value for key, value in CONFIG.items() if key != "rate"})
