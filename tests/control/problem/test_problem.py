"""Guards control/problem/problem: problems: what is legal, and what the `linear` keys of a config make of
themselves."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.sets.sets import Box, Ellipsoid, Equality, NormBall, Polytope
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.problems import LinearProblem
from tests.control.sets.test_sets import ByItsSupport

SYSTEM = LinearSystem([[0, 1], [0, 0]], [[0], [1]])
UNIT = Box([-1.0], [1.0])
SQUARE = Box([-1.0, -1.0], [1.0, 1.0])


def problem(**changes) -> OptimalControlProblem:
    return OptimalControlProblem(
        **{"system": SYSTEM, "horizon": 5.0, "initial_state": [1, 1], "control": UNIT, **changes}
    )


def test_weights_windows_and_lists_are_filled_in() -> None:
    made = problem(path=SQUARE, terminal=[SQUARE, Equality([np.nan, 0.0])])
    np.testing.assert_array_equal(made.weights, [1.0])
    (window,) = made.path
    assert (window.start, window.stop, window.set) == (0.0, 5.0, SQUARE)
    assert len(made.terminal) == 2


def test_the_control_before_time_0_is_told_or_is_not() -> None:
    assert problem().initial_control is None
    np.testing.assert_array_equal(problem(initial_control=0.5).initial_control, [0.5])


def test_constraints_that_restrict_nothing_are_dropped() -> None:
    free = Box([-np.inf, -np.inf], [np.inf, np.inf])
    made = problem(path=[free], terminal=[free, Equality([np.nan, np.nan])])
    assert made.path == () and made.terminal == ()


def test_an_initial_state_outside_the_path_set_is_legal() -> None:
    assert problem(initial_state=[9, 9], path=[SQUARE]).path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": 3}, "system: expected a LinearSystem"),
        ({"horizon": 0.0}, "horizon: expected a positive"),
        ({"horizon": np.inf}, "horizon: expected a positive"),
        ({"horizon": "soon"}, "horizon: expected a number"),
        ({"initial_state": [1, 2, 3]}, "initial_state: expected 2 finite numbers"),
        ({"initial_state": [1, np.inf]}, "initial_state: expected 2 finite numbers"),
        ({"initial_control": [1, 2]}, "initial_control: expected 1 finite numbers, one per control"),
        ({"initial_control": [np.nan]}, "initial_control: expected"),
        ({"control": SQUARE}, "control: expected a set of dimension 1, the number of controls"),
        ({"control": Box([-np.inf], [1.0])}, "control: the set must be bounded"),
        ({"control": 1.0}, "control: expected a convex set"),
        ({"weights": [0.0]}, "weights: expected 1 positive"),
        ({"weights": [1.0, 2.0]}, "weights: expected 1 numbers"),
        ({"disturbance": UNIT}, "disturbance: expected a set of dimension 2, the number of columns of E"),
        ({"disturbance": Box([0, 0], [np.inf, 1])}, "disturbance: the set must be bounded"),
        ({"disturbance_class": "white"}, "disturbance_class: expected one of piecewise_constant, measurable, l1_ball"),
        (
            {"disturbance": ByItsSupport(SQUARE), "disturbance_class": "measurable"},
            "disturbance: expected a box, polytope, ellipsoid, ball or zonotope, or another set that states its",
        ),
        ({"disturbance": Box([0.0, 0.0], [1.0, 1.0]), "disturbance_class": "l1_ball"}, "symmetric"),
        ({"disturbance": NormBall(2, 1, dimension=2), "disturbance_class": "l1_ball"}, "symmetric"),
        ({"path": [PathConstraint(SQUARE, 3.0, 2.0)]}, r"path\.0: expected 0 <= from <= to <= 5"),
        ({"path": [SQUARE, PathConstraint(SQUARE, 0.0, 6.0)]}, r"path\.1: expected"),
        ({"path": [Equality([1.0, 2.0])]}, r"path\.0: an equality is allowed in terminal only"),
        ({"path": [UNIT]}, r"path\.0: expected a set of dimension 2"),
        ({"path": 3}, "path: expected a list of sets"),
        ({"terminal": [Equality([1.0])]}, r"terminal\.0: expected 2 values"),
        ({"terminal": [UNIT]}, r"terminal\.0: expected a set of dimension 2"),
    ],
)
def test_a_problem_at_fault_names_the_argument_and_what_was_expected(changes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        problem(**changes)


CONFIG = {
    "system": {
        "A": [[0, 1], ["-2 + p1", "-0.5 + p2"]],
        "B": [[0], ["1 + p3"]],
        "parameters": {"p1": [-0.1, 0.1], "p2": [-0.1, 0.1], "p3": [-0.1, 0.1]},
    },
    "horizon": 5.0,
    "initial_state": [-1, 1],
    "control": {"box": 1.0},
    "disturbance": {"box": [0.05, 0.05]},
    "path": [{"box": [0.7, None], "from": 0.3}],
    "terminal": [{"box": [0.3, 0.3]}, {"equals": [None, 0]}],
}


def linear(**changes) -> OptimalControlProblem:
    return LinearProblem(**{**CONFIG, **changes}).build()


def test_the_documented_config_is_the_documented_problem() -> None:
    made = linear()
    A, B, E = made.system.phases[0].matrices(np.array([[0.1, -0.1, 0.05]]))
    np.testing.assert_allclose(A[0], [[0, 1], [-1.9, -0.6]])
    np.testing.assert_allclose(B[0], [[0], [1.05]])
    np.testing.assert_array_equal(E[0], np.eye(2))
    (window,) = made.path
    assert (window.start, window.stop) == (0.3, 5.0)
    np.testing.assert_array_equal(window.set.upper, [0.7, np.inf])
    np.testing.assert_array_equal(made.terminal[1].values, [np.nan, 0.0])


def test_every_kind_of_set_is_built() -> None:
    made = linear(
        control={"box": {"lower": -2, "upper": [1]}},
        disturbance={"ellipsoid": {"shape": [[0.04, 0.0], [0.0, 0.01]]}},
        path=[{"box": [1, None], "norm": {"p": 2, "radius": 3, "centre": [1, 1]}, "to": 2}],
        terminal=[
            {"polytope": {"H": [[1, 1], [-1, -1]], "h": 1}},
            {"norm": {"p": "inf", "radius": 1}},
            {"ellipsoid": {"shape": 0.25}},
        ],
    )
    np.testing.assert_array_equal([made.control.lower, made.control.upper], [[-2], [1]])
    assert isinstance(made.disturbance, Ellipsoid)
    assert [type(window.set) for window in made.path] == [Box, NormBall] and made.path[1].stop == 2.0
    polytope, norm, ellipsoid = made.terminal
    assert isinstance(polytope, Polytope) and norm.halfspaces() is not None
    assert ellipsoid.support(np.array([[1.0, 0.0]]))[0] == pytest.approx(0.5)


def test_flat_keys_of_a_control_set_intersect() -> None:
    made = linear(
        system={"A": [[0, 1], [0, 0]], "B": [[1, 0], [0, 1]]}, control={"box": 1.0, "norm": {"p": 1, "radius": 1.5}}
    )
    assert made.control.support(np.array([[1.0, 1.0]]))[0] == pytest.approx(1.5)


def test_parameters_may_come_as_a_named_polytope() -> None:
    made = linear(
        system={
            **CONFIG["system"],
            "parameters": {
                "names": ["p1", "p2", "p3"],
                "polytope": {"H": np.vstack([np.eye(3), -np.eye(3)]).tolist(), "h": 0.1},
            },
        }
    )
    assert made.system.parameters.support(np.ones((1, 3)))[0] == pytest.approx(0.3)


def test_the_options_survive_being_written_and_read() -> None:
    plain = LinearProblem(**CONFIG).model_dump(mode="json", by_alias=True)
    assert plain["path"] == [{"box": [0.7, None], "from": 0.3}]
    assert LinearProblem(**plain).model_dump(mode="json", by_alias=True) == plain


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control": {"box": "abc"}}, r"half-width, a list of half-widths \(null where free\), or \{lower"),
        ({"control": {}}, "expected a set: box, ellipsoid, norm, polytope"),
        ({"control": {"box": [1, 2]}}, r"control\.box: expected 1 number, got 2"),
        ({"control": {"box": -1}}, "half-widths must be at least 0"),
        ({"control": {"box": [None]}}, "control: the set must be bounded"),
        ({"control": {"box": 1, "ellipsoid": {"shape": 1}}}, "curved set cannot be intersected"),
        ({"initial_state": [1, 2, 3]}, "initial_state: expected 2 numbers, one per state, got 3"),
        ({"path": [{"box": 1}, {"box": 1, "from": 6}]}, r"path\.1: expected from <= to <= 5"),
        ({"path": [{"box": 1}, {"box": [1, 2, 3]}]}, r"path\.1\.box: expected 2 numbers, got 3"),
        ({"terminal": [{"equals": [0]}]}, r"terminal\.0\.equals: expected 2 numbers"),
        (
            {"terminal": [{"ellipsoid": {"shape": [[1, 2], [2, 1]]}}]},
            r"terminal\.0\.ellipsoid: shape must be symmetric positive definite",
        ),
        (
            {"terminal": [{"polytope": {"H": [[1]], "h": 1}}]},
            r"terminal\.0\.polytope: every row of H must have 2 numbers",
        ),
        ({"disturbance": {"polytope": {"H": [[1, 0], [-1, 0]], "h": [-1, -1]}}}, r"disturbance\.polytope: empty"),
        ({"system": {"A": [[0, 1]], "B": [[1]]}}, r"system\.A: expected a square matrix"),
        ({"system": {"A": [[0]], "B": [[1], [2]]}}, r"system\.B: expected 1 rows, as A has"),
        (
            {"system": {"A": [["a"]], "B": [[1]]}},
            r"system\.A\.0\.0: expression 'a': unknown name 'a'; known parameters: none",
        ),
        (
            {"system": {"A": [["1/a"]], "B": [[1]], "parameters": {"a": [0, 1]}}, "initial_state": 0},
            "A is not finite at a = 0",
        ),
        ({"system": {"A": [["pi"]], "B": [[1]], "parameters": {"pi": [0, 1]}}}, "'pi' cannot name a parameter"),
        (
            {"system": {"A": [["a"]], "B": [[1]], "parameters": {"a": [1, 0]}}},
            r"system\.parameters\.a: expected \[lower, upper\]",
        ),
        ({"system": {"A": [["a"]], "B": [[1]], "parameters": {"a": 1}}}, r"expected an interval \[lower, upper\]"),
        ({"system": {"A": [[None]], "B": [[1]]}}, "expected a number or an expression"),
    ],
)
def test_a_config_at_fault_names_the_key_and_what_was_expected(changes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        linear(**changes)


@pytest.mark.parametrize("horizon", [True, "5"])
def test_truth_values_and_texts_are_no_numbers(horizon: object) -> None:
    system = LinearSystem(np.zeros((1, 1)), np.ones((1, 1)))
    with pytest.raises(InputError, match="horizon: expected a number"):
        OptimalControlProblem(system=system, horizon=horizon, initial_state=[1.0], control=Box([-1.0], [1.0]))


def test_a_state_space_model_spread_over_the_arguments_is_refused_in_words() -> None:
    with pytest.raises(InputError, match=r"parameters: expected a convex set.*C and D"):
        LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
