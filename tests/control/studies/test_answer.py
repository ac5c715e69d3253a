"""Guards the answer to a control problem as functions of time: control, tube, worst cases; pickled, shown, printed."""

import pickle

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.response.varying.expansion import Expansion, Flow
from sparserob_core.control.studies.answer import supports
from sparserob_core.control.transcription.transcribe import prepare
from tests.support.plants import uniform

A, B = [[0.0, 1.0], [-2.0, -0.5]], [[0.0], [1.0]]


def problem(**changes: object) -> sr.OptimalControlProblem:
    given = {
        "system": sr.LinearSystem(A, B),
        "horizon": 5.0,
        "initial_state": [-1.0, 1.0],
        "control": sr.Box([-1], [1]),
        "disturbance": sr.Box([-0.06, -0.06], [0.06, 0.06]),
        "path": [sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), 0.3)],
        "terminal": [sr.Box([-0.3, -0.3], [0.3, 0.3])],
    }
    return sr.OptimalControlProblem(**{**given, **changes})


@pytest.fixture(scope="module")
def result() -> sr.ControlResult:
    return sr.solve(problem(), control={"name": "piecewise_constant", "pieces": 50})


def test_the_control_is_a_function_of_time(result):
    control = result.control
    assert control.values.shape == (1, 50)
    assert control(0.0).shape == (1,)
    np.testing.assert_array_equal(control(control.breakpoints[:-1]), control.values)
    np.testing.assert_array_equal(control(5.0), control.values[:, -1])
    assert np.abs(control.values).sum() * 0.1 == pytest.approx(result.cost, rel=1e-12)
    for wrong, said in ((5.1, "got 5.1"), (-1e-9, "got -1e-09"), ([[0.0]], "from 0 to 5"), ("a", "expected numbers")):
        with pytest.raises(sr.InputError, match=said):
            control(wrong)


def test_the_nominal_states_begin_at_the_centre_and_are_pushed_by_the_middle_of_the_disturbances(tmp_path):
    lopsided = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": {"centre": [1, 0], "box": {"lower": [-0.1, 0.0], "upper": [0.3, 0.0]}},
        "control": {"box": 1.0},
        "disturbance": {"box": {"lower": [0.0, 0.0], "upper": [0.2, 0.0]}},
        "terminal": [{"box": [5, 5]}],
    }
    config = {
        "problem": lopsided,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
        "observers": [],
    }
    outcome = sr.run(config, out=tmp_path / "run", quiet=True, figures=False)
    tube = outcome.tube([0.0, 2.0])
    np.testing.assert_allclose(tube.nominal, [[1.1, 1.1 + 0.1 * 2.0], [0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(tube.upper + tube.lower, 2 * tube.nominal, atol=1e-9)


def test_the_tube_is_what_the_worst_disturbance_does(result):
    times = np.array([0.0, 1.234, 5.0])
    tube = result.tube(times)
    assert tube.nominal.shape == tube.lower.shape == tube.upper.shape == (2, 3)
    np.testing.assert_array_equal(tube.nominal[:, 0], [-1.0, 1.0])
    np.testing.assert_allclose(tube.upper[:, 0] - tube.lower[:, 0], 0.0, atol=1e-15)
    # a box of disturbances is symmetric, so that the nominal states are in the middle
    np.testing.assert_allclose(tube.upper + tube.lower, 2 * tube.nominal, atol=1e-12)
    assert np.abs([tube.lower[:, -1], tube.upper[:, -1]]).max() <= 0.3 + 1e-9
    # integrated on the pieces of 0.1, the disturbances at the bounds: sigma_i = 0.06 sum_l |int e_i' e^{A s} ds|_1
    linalg = pytest.importorskip("scipy.linalg")
    whole = linalg.expm(np.block([[np.array(A), np.eye(2)], [np.zeros((2, 4))]]) * 0.1)
    flow, driven = whole[:2, :2], whole[:2, 2:]
    sigma = 0.06 * sum(np.abs(np.linalg.matrix_power(flow, k) @ driven) for k in range(50)).sum(axis=1)
    np.testing.assert_allclose(tube.upper[:, -1] - tube.nominal[:, -1], sigma, rtol=1e-12)


def test_the_worst_case_of_a_constraint_is_asked_for_by_name(result):
    worst = result.adversary("terminal")
    assert worst.time == 5.0
    assert worst.violation == pytest.approx(0.0, abs=1e-8)
    state = result.tube([5.0])
    reached = np.where(worst.direction > 0, state.upper[:, 0], state.lower[:, 0])
    assert worst.direction @ reached - worst.bound == pytest.approx(worst.violation, abs=1e-12)
    with pytest.raises(sr.InputError, match="constraint: expected one of path, terminal, got 'the end'"):
        result.adversary("the end")


def test_without_a_decision_there_is_one_clear_error():
    nothing = sr.solve(problem(terminal=[sr.Box([-0.01] * 2, [0.01] * 2)]), control="piecewise_constant")
    assert nothing.status == "infeasible"
    with pytest.raises(sr.InputError, match="there is no control: the result is infeasible: 2 separate reasons"):
        _ = nothing.control


def test_a_result_can_be_pickled_and_is_said_in_five_lines(result):
    again = pickle.loads(pickle.dumps(result))
    assert repr(again) == repr(result)
    assert len(repr(result).splitlines()) == 5
    assert "certified" in repr(result)
    np.testing.assert_array_equal(again.control.values, result.control.values)
    np.testing.assert_array_equal(again.tube([1.0]).upper, result.tube([1.0]).upper)


CONFIG = {
    "title": "A <b> of two",
    "problem": {
        "name": "linear",
        "system": {"A": A, "B": B},
        "horizon": 5.0,
        "initial_state": [-1.0, 1.0],
        "control": {"box": 1.0},
        "disturbance": {"box": 0.06},
        "terminal": [{"box": 0.3}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 20}},
    "observers": [],
}


def test_expressions_of_parameters_can_be_pickled_too(tmp_path):
    system = {"A": [["-1 + 0.1*p", 0.5], [0, -1]], "B": [[0], ["1 + p"]], "parameters": {"p": [-0.1, 0.1]}}
    uncertain = {**CONFIG, "problem": {**CONFIG["problem"], "system": system, "disturbance": None}}
    outcome = sr.run(uncertain, out=tmp_path / "run", quiet=True, figures=False)
    again = pickle.loads(pickle.dumps(outcome.result))
    np.testing.assert_array_equal(again.tube([2.0]).upper, outcome.tube([2.0]).upper)
    at = np.array([[0.05]])
    for mine, other in zip(
        outcome.problem.system.phases[0].matrices(at), again.problem.system.phases[0].matrices(at), strict=True
    ):
        np.testing.assert_array_equal(mine, other)


@pytest.mark.slow
def test_an_outcome_is_an_object_too(tmp_path):
    outcome = sr.run(CONFIG, out=tmp_path / "run", quiet=True)
    assert isinstance(outcome.result, sr.ControlResult)
    np.testing.assert_array_equal(outcome.result.control.values, outcome.control)
    np.testing.assert_array_equal(outcome.tube([2.0]).lower, outcome.result.tube([2.0]).lower)
    assert outcome.worst("terminal").name == "terminal"
    assert len(repr(outcome).splitlines()) == 5
    html = outcome._repr_html_()
    assert "A &lt;b&gt; of two" in html
    assert "certified" in html
    assert html.count("<img") == 1
    again = pickle.loads(pickle.dumps(outcome))
    assert (again.status, again.directory) == (outcome.status, outcome.directory)
    assert repr(again) == repr(outcome)
    np.testing.assert_array_equal(again.tube([2.0]).lower, outcome.tube([2.0]).lower)


def test_a_program_of_another_kind_has_no_states(tmp_path):
    family = sr.ConstraintFamily(
        name="above", index_set=sr.Box([0.0], [1.0]), rows=lambda t: (-np.ones((len(t), 1, 1)), -t)
    )
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], lower=-10.0, upper=10.0, families=[family]))
    assert not isinstance(result, sr.ControlResult)
    assert result.cost == pytest.approx(1.0, abs=1e-7)


def test_the_outline_of_a_tube_of_a_varying_system_is_integrated_once_for_all_its_directions(monkeypatch):
    asked: list[int] = []
    flow = Expansion.flow

    def counted(self: Expansion, starts: np.ndarray, stops: np.ndarray) -> Flow:
        asked.append(starts.size)
        return flow(self, starts, stops)

    monkeypatch.setattr(Expansion, "flow", counted)
    bound = sr.Box([-0.1], [0.1])
    turning = sr.VaryingSystem.of(
        [["0", "cos(t)"], ["-cos(t)", "0"]], [["0"], ["1 + gain"]], 2.0, parameters=bound, names=["gain"]
    )
    posed = sr.OptimalControlProblem(
        system=turning,
        horizon=2.0,
        initial_state=[1, 0],
        control=sr.Box([-1], [1]),
        terminal=[sr.Box([-2, -2], [2, 2])],
    )
    model = prepare(posed, uniform(4, 2.0), uniform(4, 2.0))
    times, angles = np.linspace(0.0, 2.0, 40), np.linspace(0.0, 6.0, 24)
    directions = np.zeros((angles.size, model.problem.system.states))
    directions[:, :2] = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    together = supports(model, np.ones(4), times, directions)
    assert len(asked) <= 3  # the pieces, and the times, of which rounding may make two sets
    alone = [supports(model, np.ones(4), times, one[None])[0] for one in directions]
    np.testing.assert_array_equal(together, alone)
