"""Guards checker/problem/time_varying: systems that take turns, act late or are uncertain become one in the time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.checker.problem.time_varying import make_time_varying
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem
from sparserob_core.sip.expressions.expression import parse_matrix


def system(text: str) -> LinearSystem:
    A, c = (parse_matrix(name, rows, ("p1",)) for name, rows in (("A", [[text]]), ("c", [["p1"]])))
    return LinearSystem(A, np.array([[2.0]]), np.array([[3.0]]), sr.Box([0.5], [0.75]), ("p1",), c)


def problem(plant: Any, **more: Any) -> sr.OptimalControlProblem:
    return sr.OptimalControlProblem(
        **{"system": plant, "horizon": 2.0, "initial_state": [1.0], "control": sr.Box([-1.0], [1.0]), **more}
    )


def test_laws_in_turns_are_those_of_the_systems_that_take_turns() -> None:
    turns = SwitchedSystem([(0.75, system("-p1")), (2.0, system("p1^2"))])
    found = make_time_varying(problem(turns, execution=np.array([0.1]))).system
    assert found.varies and found.horizon == 2.0
    assert [phase.begin for phase in found.phases] == [0.0, 0.75]
    assert found.parameters is not None and found.parameters.bounding_box().upper.tolist() == [0.75]
    for law, expected in zip(found.phases, (-0.625, 0.625**2), strict=True):
        at = np.array([0.8, 0.625])
        assert [float(np.asarray(law.entry(name)(at) if callable(law.entry(name)) else law.entry(name)).item())
                for name in ("A", "B", "E", "c")] == [expected, 2.0, 3.0, 0.625]  # fmt: skip


@pytest.mark.parametrize(
    ("plant", "more", "changed"),
    [
        (LinearSystem(-np.eye(1), np.eye(1)), {"execution": np.array([0.1])}, False),
        (LinearSystem(-np.eye(1), np.eye(1), delay=0.25), {"execution": np.array([0.1])}, False),
        (SwitchedSystem([(0.75, system("1")), (2.0, system("2"))]), {"execution": np.array([0.1])}, True),
        (LinearSystem(-np.eye(1), np.eye(1), delay=0.25), {}, False),
        (system("-p1"), {"execution": np.array([0.1])}, True),
        (system("-p1"), {}, False),
    ],
)
def test_only_what_is_followed_in_time_is_changed(plant: Any, more: dict[str, Any], changed: bool) -> None:
    given = problem(plant, **more)
    found = make_time_varying(given)
    assert (found is not given) == changed == found.system.varies
    assert found.system.delay == plant.delay
