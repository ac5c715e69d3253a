"""Guards roots of models where their argument reaches 0: balls that contain every value, sharp at 0, and none where the
argument is negative; and the bounds of models by Bernstein's form."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb

from sparserob_core.checker.arithmetic.models import Frame, Model, find_highest, measure_steepness
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.outcome import Unchecked

FRAME = Frame(Monomials(1, 4), 4)


def axes(lower: tuple[float, float], upper: tuple[float, float]) -> tuple[Model, Model]:
    """Return the two coordinates of a box as models."""
    ends = [(arb(low), arb(high)) for low, high in zip(lower, upper, strict=True)]
    middles = [((low + high) / 2, (high - low) / 2) for low, high in ends]
    return FRAME.time(*middles[0]), FRAME.parameter(0, *middles[1])


def value_at(model: Model, r: float, s: float) -> arb:
    """Return the ball of a model's value at one time and parameter."""
    total = arb(0)
    for exponents, part in zip(FRAME.monomials.exponents, model.parts, strict=True):
        if part is not None:
            total += part(arb(r)) * arb(s) ** sum(exponents)
    return total


@pytest.mark.parametrize("power", [0.5, 0.3, 1.5, 4.25])
@pytest.mark.parametrize("width", [1.0, 1e-3])
def test_a_power_contains_its_values_from_zero_on(power: float, width: float) -> None:
    x, y = axes((0.0, 0.0), (width, 2.0))
    rng = np.random.default_rng(0)
    for model, function in ((x**power, lambda p, q: p), ((x * y) ** power, lambda p, q: p * q)):
        for r, s in [*rng.uniform(-1.0, 1.0, (60, 2)), (-1.0, -1.0), (-1.0, 0.0), (1.0, 1.0), (1.0 - 2.0**-40, -1.0)]:
            argument = function(arb(width) * (1 + arb(r)) / 2, 1 + arb(s))
            exact = arb(0) if argument.is_zero() else argument ** arb(power)
            assert value_at(model, r, s).overlaps(exact)
    assert find_highest(x**0.5) == pytest.approx(find_highest(x.sqrt()), rel=1e-12)


def test_a_root_is_sharp_at_zero_and_its_bound_is_attained() -> None:
    x, _ = axes((0.0, 0.0), (1.0, 1.0))
    assert float(value_at(x.sqrt(), -1.0, 0.0).lower()) == pytest.approx(0.0, abs=1e-8)
    assert float(value_at(x.sqrt(), -1.0, 0.0).upper()) == pytest.approx(0.25, abs=1e-8)
    assert float(value_at(x**1.5, -1.0, 0.0).upper()) == pytest.approx(0.0, abs=1e-8)
    assert find_highest(x - x.sqrt()) == pytest.approx(0.0, abs=1e-8)


def test_a_negative_argument_has_no_root() -> None:
    for low in (-1e-9, -1.0):
        x, _ = axes((low, 0.0), (1.0, 1.0))
        for function in (Model.sqrt, lambda model: model**0.5, lambda model: model**1.5):
            with pytest.raises(Unchecked):
                function(x)
    x, _ = axes((0.0, 0.0), (1.0, 1.0))
    for function in (lambda model: (-model).sqrt(), lambda model: model**-0.5, Model.log, lambda model: model**model):
        with pytest.raises(Unchecked):
            function(x)
    x, _ = axes((1.0, 0.0), (4.0, 1.0))
    assert value_at(x.sqrt(), 1.0, 0.0).contains(arb(2))


def test_a_model_is_below_its_highest_value_and_changes_most_along_its_steepest_axis() -> None:
    x, y = axes((-1.0, -1.0), (1.0, 1.0))
    model = 2.0 * x * y - x * x + 0.25 * y
    largest = max(float(value_at(model, r, s).upper()) for r in np.linspace(-1, 1, 41) for s in np.linspace(-1, 1, 41))
    assert largest - 1e-12 <= find_highest(model) <= largest + 0.3
    assert measure_steepness(model).tolist() == [4.0, 2.25]
    assert find_highest(FRAME.number(arb(3))) == pytest.approx(3.0)
    assert find_highest(FRAME.number(arb("inf"))) == np.inf
