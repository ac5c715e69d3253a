"""Guards names and units of a problem, and plants of other packages: they reach every text and change no number."""

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.figures.clash import clash_strips

A, B = [[0.0, 1.0], [-2.0, -0.5]], [[0.0], [1.0]]
NAMES = sr.Names(states=["height", "speed"], controls=["thrust"], state_units=["m", "m/s"], time="s")


def problem(names: sr.Names, noise: float = 0.06) -> sr.OptimalControlProblem:
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(A, B),
        horizon=5.0,
        initial_state=[-1.0, 1.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-noise, -noise], [noise, noise]),
        path=[sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), 0.3)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
        names=names,
    )


def test_a_reason_says_the_names_and_without_them_the_same():
    named = sr.solve(problem(NAMES, 0.09), control={"name": "piecewise_constant", "pieces": 20})
    plain = sr.solve(problem(sr.Names(), 0.09), control={"name": "piecewise_constant", "pieces": 20})
    assert named.status == plain.status == "infeasible"
    assert "speed(5) by 0.3947 m/s" in named.message and "allows 0.3 m/s" in named.message
    without = named.message.replace(" m/s", "").replace(" m", "")
    assert without.replace("height", "x1").replace("speed", "x2") == plain.message.replace(" m", "")


def test_the_strips_of_a_clash_are_in_their_units_and_show_what_misses_what():
    named = sr.solve(problem(NAMES, 0.09), control={"name": "piecewise_constant", "pieces": 20})
    strip = next(one for one in clash_strips(named.model.program, named) if one.label.startswith("speed(5)"))
    assert strip.unit == "m/s"
    left, right = strip.view
    assert left < strip.best - strip.sigma_low < strip.low < strip.high < strip.best + strip.sigma_high < right
    far = replace(strip, reach_low=-1e3, reach_high=1e3)
    assert far.view == pytest.approx(strip.view, abs=2.0 * (right - left))


def test_names_change_no_number():
    options = {"control": {"name": "piecewise_constant", "pieces": 20}}
    named, plain = sr.solve(problem(NAMES), **options), sr.solve(problem(sr.Names()), **options)
    assert named.cost == plain.cost
    np.testing.assert_array_equal(named.decision, plain.decision)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({"states": ["a"]}, "names.states: expected 2, one for each of the states, got 1: a"),
        ({"states": ["a", "a"]}, "names: the name 'a' occurs twice, in states"),
        ({"states": ["a", "b"], "controls": ["b"]}, "names: the name 'b' occurs twice, in controls and in states"),
        ({"states": "ab"}, "names.states: expected a list of texts, got 'ab'"),
        ({"states": ["a", " "]}, "names.states: expected names that are not empty, got ['a', ' ']"),
        ({"control_units": ["N", "N"]}, "names.units.controls: expected 1, one for each of the controls, got 2: N, N"),
        ({"time": 3}, "names.units.time: expected a text such as s, got 3"),
    ],
)
def test_a_wrong_name_says_where(names, said):
    with pytest.raises(sr.InputError) as caught:
        problem(sr.Names(**names))
    assert str(caught.value) == said


def test_a_plant_of_scipy_is_a_system():
    signal = pytest.importorskip("scipy.signal")
    system = sr.LinearSystem.from_statespace(signal.StateSpace(A, B, np.eye(2), np.zeros((2, 1))), E=[[0.0], [1.0]])
    assert (system.states, system.controls, system.disturbances) == (2, 1, 1)
    for found, given in zip(system.phases[0].matrices(np.zeros((1, 0))), (A, B, [[0.0], [1.0]]), strict=True):
        np.testing.assert_array_equal(found[0], given)


def test_a_plant_of_python_control_is_a_system():
    control = pytest.importorskip("control")
    system = sr.LinearSystem.from_statespace(control.ss(A, B, np.eye(2), np.zeros((2, 1))))
    found = system.phases[0].matrices(np.zeros((1, 0)))
    np.testing.assert_array_equal(found[0][0], A)
    np.testing.assert_array_equal(found[1][0], B)
    np.testing.assert_array_equal(found[2][0], np.eye(2))
    with pytest.raises(
        sr.InputError, match=r"expected a system in continuous time: .* got a sampled one, its step 0.1"
    ):
        sr.LinearSystem.from_statespace(control.ss(A, B, np.eye(2), np.zeros((2, 1)), 0.1))


def test_a_discrete_plant_is_refused_with_a_sentence():
    signal = pytest.importorskip("scipy.signal")
    for step, said in ((0.1, "0.1"), (True, "not given")):
        with pytest.raises(sr.InputError, match=f"got a sampled one, its step {said}"):
            sr.LinearSystem.from_statespace(signal.dlti(A, B, np.eye(2), np.zeros((2, 1)), dt=step))


def test_what_is_no_state_space_model_is_refused_in_words():
    signal = pytest.importorskip("scipy.signal")
    transfer = signal.TransferFunction([1.0], [1.0, 0.5, 2.0])
    with pytest.raises(sr.InputError, match=r"plant: expected a state-space model .* got a TransferFunctionContinuous"):
        sr.LinearSystem.from_statespace(transfer)
    with pytest.raises(sr.InputError, match="C and D of a plant have no place here"):
        sr.LinearSystem(*signal.tf2ss([1.0], [1.0, 0.5, 2.0]))
