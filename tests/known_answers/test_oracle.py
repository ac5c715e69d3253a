"""Guards tests/support/oracle.py: its two values are close, they hold costs that are known by hand, and a line that is
changed, or a bound that is a little wrong, lies outside."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.known_answers.test_dressed import LINES, dressed, stated
from tests.support.oracle import bounds_of, outside

Config = dict[str, Any]
LOOSE = {"affine, charged its worst", "affine, outputs"}  # enclosed by policies that cost or measure otherwise
FEW = ("fixed", "quadratic", "execution", "zonotope, measurable")


def mission(**more: Any) -> Config:
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [4.0, 0.0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.02, 0.02]},
        "terminal": [{"box": [0.5, 0.3]}],
        **more,
    }
    return {"problem": problem, "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}}}


def slow_but(few: tuple[str, ...], names: Any) -> list[Any]:
    return [pytest.param(name, marks=() if name in few else pytest.mark.slow) for name in names]


def test_a_state_that_is_driven_alone_costs_its_distance() -> None:
    """`x' = u` from 1 to within 0.2 of 0, under |w| <= 0.1 for a time of 1: 0.9 in all, whatever the pieces."""
    config = mission(
        system={"A": [[0]], "B": [[1]]},
        horizon=1.0,
        initial_state=[1.0],
        disturbance={"box": 0.1},
        terminal=[{"box": 0.2}],
    )
    lower, upper = bounds_of(config)
    assert lower <= 0.9 + 1e-9 and upper >= 0.9 - 1e-9
    assert upper - lower < 1e-5


def test_nothing_is_feasible_from_too_far_away() -> None:
    assert bounds_of(mission(initial_state=[40.0, 0.0])) == (np.inf, np.inf)


@pytest.mark.parametrize("name", slow_but(FEW, LINES))
def test_the_two_values_of_a_line_are_close(name: str) -> None:
    lower, upper = bounds_of(stated(name))
    assert lower <= upper + 2e-6
    assert name in LOOSE or upper - lower <= 1e-3 * max(upper, 1e-3)
    if name not in LOOSE:
        assert bounds_of(dressed(stated(name))) == pytest.approx((lower, upper), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("name", slow_but(FEW, [name for name in LINES if name not in LOOSE]))
def test_a_bound_that_is_a_little_wrong_lies_outside(name: str) -> None:
    values = bounds_of(stated(name))
    middle, little = sum(values) / 2, 2e-3 * max(abs(values[1]), 1e-2)
    right = SimpleNamespace(status="certified", lower_bound=middle, upper_bound=middle)
    assert outside(right, values) == []
    assert outside(SimpleNamespace(status="certified", lower_bound=middle, upper_bound=middle - little), values)
    assert outside(
        SimpleNamespace(status="certified", lower_bound=middle + little, upper_bound=middle + little), values
    )
    assert outside(SimpleNamespace(status="infeasible", lower_bound=None, upper_bound=None), values)


def changed(name: str, *keys: Any, to: Any) -> tuple[Config, Config]:
    """A config and the same with one entry changed."""
    config = stated(name)
    other = copy.deepcopy(config)
    place: Any = other["problem"]
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = to
    return config, other


@pytest.mark.parametrize(
    ("name", "keys", "to"),
    [
        ("drift", ("system", "c"), [0, -0.101]),
        ("delay", ("system", "delay"), 0.151),
        ("initial box", ("initial_state", "box"), [0.051, 0.05]),
        ("execution", ("execution",), [0.031]),
        ("zonotope, measurable", ("disturbance", "zonotope", "generators"), [[0.03, 0.01], [0, 0.042], [0.02, -0.01]]),
        ("pieces", ("system", "pieces", 1, "A"), [[0, 1], [-0.51, -0.2]]),
        ("window", ("path", 0, "box"), [None, 0.79]),
        ("step", ("control_step", "box"), 0.49),
        ("quadratic", ("cost", "control", "R"), [[0.06]]),
        ("affine", ("disturbance", "box"), 0.051),
        ("affine, delay", ("system", "delay"), 0.155),
    ],
)
def test_a_line_that_is_changed_has_other_values(name: str, keys: tuple[Any, ...], to: Any) -> None:
    config, other = changed(name, *keys, to=to)
    (low, high), (lower, upper) = bounds_of(config), bounds_of(other)
    assert upper < low or high < lower
