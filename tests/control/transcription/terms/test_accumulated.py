"""Guards what a problem with bounds of integrals becomes, what people see of it, and what is refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.transcription.terms.accumulated import integrals_as_states

SPRING = sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]])


def problem(*integrals: sr.IntegralConstraint, **more: Any) -> sr.OptimalControlProblem:
    given = {"system": SPRING, "horizon": 5.0, "initial_state": [-1, 1], "control": sr.Box([-1], [1]), **more}
    return sr.OptimalControlProblem(integral=integrals, **given)


def test_one_that_begins_at_0_leaves_a_single_system_and_others_make_pieces() -> None:
    first, later = (sr.IntegralConstraint(G=[[1]], upper=1, start=start, stop=4.0) for start in (0.0, 1.0))
    assert integrals_as_states(problem(first)).system.switches == ()
    assert integrals_as_states(problem(first, later)).system.switches == (1.0, 4.0)


def test_states_that_are_added_up_have_the_names_and_units_of_what_they_add_up() -> None:
    names = sr.Names(
        states=["p", "v"],
        controls=["u"],
        state_units=["m", "m/s"],
        control_units=["kg/s"],
        time="s",
        plane=["p", "v"][:0],
    )
    fuel = sr.IntegralConstraint(G=[[1]], upper=1, name="fuel")
    both = sr.IntegralConstraint(H=[[1, 0], [0, 1]], lower=[0, None], upper=[None, 1])
    found = integrals_as_states(problem(fuel, both, names=names)).names
    assert list(found.states) == ["p", "v", "fuel", "integral[1] 1", "integral[1] 2"]
    assert list(found.state_units) == ["m", "m/s", "kg", "m s", "m"]


def test_the_states_of_the_problem_are_those_that_were_stated() -> None:
    given = problem(sr.IntegralConstraint(G=[[1]], upper=1), terminal=[sr.Box([-0.5, -0.5], [0.5, 0.5])])
    result = sr.solve(given, control={"name": "piecewise_constant", "pieces": 5})
    controller = sr.controller(result)
    assert controller.step(0.0, [-1, 1]).shape == (1,)
    with pytest.raises(sr.InputError):
        controller.step(1.0, [-1, 1, 0])


def test_a_controller_that_solves_anew_knows_what_it_has_spent() -> None:
    """Of two controls the cheap one has a budget, which is not there anew at every step."""
    given = problem(
        sr.IntegralConstraint(G=[[1, 0]], upper=1.5),
        system=sr.LinearSystem([[0]], [[1, 1]]),
        initial_state=[0],
        control=sr.Box([-1, -1], [1, 1]),
        weights=[1, 3],
        disturbance=sr.Box([-0.05], [0.05]),
        terminal=[sr.Box([2.4], [4.0])],
    )
    controller = sr.controller(sr.solve(given, control={"name": "piecewise_constant", "pieces": 5}), resolve=True)
    state, spent = np.zeros(1), 0.0
    for k in range(5):
        u = controller.step(float(k), state)
        spent, state = spent + float(u[0]), state + u.sum() - 0.03
    assert any(step.resolved for step in controller.steps)
    assert 1.0 < spent <= 1.5 + 1e-7


REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "nothing to integrate": ({}, {}, "integral.0"),
    "a row of zeros": ({"H": [[0, 0]]}, {}, "integral.0"),
    "too many columns": ({"G": [[1, 1]]}, {}, "integral.0.G"),
    "rows that differ": ({"H": [[1, 0], [0, 1]], "G": [[1]]}, {}, "integral.0"),
    "no bound": ({"G": [[1]], "upper": None}, {}, "integral.0"),
    "one row without a bound": ({"H": np.eye(2), "upper": [1, None]}, {}, "integral.0"),
    "bounds that cross": ({"G": [[1]], "lower": 2}, {}, "integral.0"),
    "bounds for other rows": ({"G": [[1]], "upper": [1, 2]}, {}, "integral.0.upper"),
    "no window": ({"G": [[1]], "start": 2.0, "stop": 2.0}, {}, "integral.0"),
    "a window beyond the horizon": ({"G": [[1]], "stop": 6.0}, {}, "integral.0"),
    "a control that never acts": (
        {"G": [[1]]},
        {"system": sr.LinearSystem([[0]], [[1]], delay=0.5), "initial_state": [0]},
        "integral.0.to",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_none_is_refused_with_its_key(name: str) -> None:
    integral, more, path = REFUSED[name]
    with pytest.raises(sr.InputError) as refused:
        problem(sr.IntegralConstraint(**{"upper": 1, **integral}), **more)
    assert ".".join(map(str, refused.value.path)) == path


def test_what_is_no_integral_is_refused() -> None:
    with pytest.raises(sr.InputError):
        sr.OptimalControlProblem(
            system=SPRING, horizon=5.0, initial_state=[0, 0], control=sr.Box([-1], [1]), integral=[sr.Box([0], [1])]
        )
