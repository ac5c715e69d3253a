"""Guards checker/flow/units and checker/flow/plant: units in which a system is small, and the flow of one that does not
change with time."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb, ctx
from scipy.linalg import expm

from sparserob_core.checker.arithmetic.series import middles
from sparserob_core.checker.flow.plant import held_about, modes_at
from sparserob_core.checker.flow.units import balanced
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem
from sparserob_core.control.sets.sets import Box
from sparserob_core.sip.expressions.expression import parse_matrix


@pytest.mark.parametrize("time", [0.0, 0.8, 40.0])
def test_what_is_held_is_about_the_exponential_and_its_integral(time: float) -> None:
    Phi, Gamma = held_about(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), time)
    assert Phi == pytest.approx(np.array([[1.0, time], [0.0, 1.0]]))
    assert Gamma == pytest.approx(np.array([[time**2 / 2.0], [time]]))
    A, B = np.random.default_rng(2).normal(size=(3, 3)) / 4.0, np.random.default_rng(3).normal(size=(3, 2))
    Phi, Gamma = held_about(A, B, time)
    assert Phi == pytest.approx(expm(A * time), rel=1e-11, abs=1e-12)
    assert Gamma == pytest.approx(np.linalg.solve(A, expm(A * time) - np.eye(3)) @ B, rel=1e-10, abs=1e-11)


def test_units_that_balance_a_matrix_make_rows_as_large_as_columns():
    rng = np.random.default_rng(3)
    for _ in range(5):
        units = 2.0 ** rng.integers(-20, 20, size=3)
        A = units[:, None] * rng.uniform(0.5, 2.0, size=(3, 3)) / units
        speed = units * rng.uniform(0.5, 2.0, size=3)
        found = balanced(A, 1.0, speed)
        assert (np.log2(found) == np.round(np.log2(found))).all()
        plain = A / found[:, None] * found
        assert np.abs(plain).max() <= 64.0
        # in states that are so many times as large, units are
        again = balanced(A * 1.0, 1.0, speed * 1024.0)
        assert again == pytest.approx(found * 1024.0, rel=1.0)


def test_a_drive_of_nothing_but_rounding_does_not_choose_the_units():
    A, speed = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([np.nextafter(0.0, 1.0), 0.5])
    assert (balanced(A, 4.0, speed) == balanced(A, 4.0, np.array([0.0, 0.5]))).all()


def test_systems_that_take_turns_are_known_at_a_parameter_one_by_one():
    names, box = ("p1",), Box([-0.1], [0.1])
    A, B, c = (
        parse_matrix(name, rows, names)
        for name, rows in (("A", [["0", "1"], ["-2 + p1*cos(p1)", "-0.5 + p1**2"]]), ("B", [["0"], ["1 + sin(p1)"]]),
                           ("c", [["p1"], ["2"]]))
    )  # fmt: skip
    E, turned = np.array([[0.3], [1.0]]), parse_matrix("A", [["1/3", "0"], ["0", "exp(p1)"]], names)
    legs = [LinearSystem(one, B, E, parameters=box, c=c) for one in (A, turned)]
    with ctx.workprec(96):
        first, second = modes_at(SwitchedSystem([(1.0, legs[0]), (2.0, legs[1])]), [0.05])
        assert middles(first["A"])[1] == pytest.approx([-2 + 0.05 * np.cos(0.05), -0.5 + 0.0025])
        assert middles(first["B"]) == pytest.approx(np.array([[0.0, 0.05], [1.0 + np.sin(0.05), 2.0]]))
        assert (middles(second["E"]) == E).all()
        assert second["A"][1, 1].overlaps(arb(0.05).exp()) and float(second["A"][1, 1].rad()) < 1e-25
        near = Box([1.0], [2.0])
        with pytest.raises(Unchecked, match="not finite"):
            modes_at(LinearSystem(parse_matrix("A", [["1/p1"]], names), np.ones((1, 1)), parameters=near), [0.0])
