"""Guards boxes with a budget: worst signals beside linear and conic programs, units, scaling, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.sets.budget import BudgetedSignals
from tests.support.oracle import Signals, support

RNG = np.random.default_rng(4)


@pytest.mark.parametrize("p", [1, 2])
@pytest.mark.parametrize("share", [0.02, 0.4, 0.95, 2.0])
def test_the_worst_signal_is_that_of_a_linear_or_conic_program(p: int, share: float) -> None:
    upper, lengths = np.array([1.0, 0.3]), np.array([0.2, 0.5, 0.1, 0.7])
    size = share * float((upper**p).sum() * lengths.sum())
    box = sr.BudgetedBox(-upper, upper, p, size)
    c = np.vstack([RNG.normal(size=(5, 8)), np.ones((1, 8)), np.eye(8)[:1], np.zeros((1, 8))])
    signals = box.of_signals(lengths)
    points = signals.support_point(c)
    np.testing.assert_allclose(signals.support(c), (c * points).sum(axis=1), atol=1e-14)
    assert (signals.gauge(points) <= 1.0 + 1e-14).all()
    piece_by_piece = c.reshape(-1, 2, 4).swapaxes(1, 2).reshape(-1, 8)
    np.testing.assert_allclose(signals.support(c), support(Signals(box, lengths), piece_by_piece), atol=3e-7)


@pytest.mark.parametrize("p", [1, 2])
def test_a_signal_that_is_moved_inside_keeps_its_budget_in_exact_numbers(p: int) -> None:
    from fractions import Fraction

    radii, costs = RNG.uniform(0.5, 1.0, 30), RNG.uniform(0.1, 0.2, 30)
    signals = BudgetedSignals(radii, costs, p, 1.0)
    for point in signals.inside(signals.support_point(RNG.normal(size=(20, 30)))):
        spent = sum(Fraction(h) * abs(Fraction(x)) ** p for h, x in zip(costs.tolist(), point.tolist(), strict=True))
        assert 1 - Fraction(1e-12) < spent <= 1


@pytest.mark.parametrize("p", [1, 2])
def test_other_units_and_a_factor_change_the_worst_signal_by_exactly_that(p: int) -> None:
    box, lengths, c = sr.BudgetedBox([-1.0, -3.0], [1.0, 3.0], p, 0.7), np.array([0.5, 0.25]), RNG.normal(size=4)
    units, time = np.array([4.0, 0.5]), 8.0
    other = box.in_units(units).in_units_of_time(time).of_signals(lengths / time)
    assert other.support(c * np.repeat(units, 2)) == pytest.approx(box.of_signals(lengths).support(c), rel=1e-14)
    assert box.scaled(1.7).of_signals(lengths).support(c) == pytest.approx(1.7 * box.of_signals(lengths).support(c))


def test_random_signals_keep_the_budget_and_use_it() -> None:
    signals = sr.BudgetedBox([-1.0], [1.0], 1, 0.5).of_signals(np.full(6, 0.5))
    gauge = signals.gauge(signals.sample(300, RNG))
    assert gauge.max() <= 1.0 + 1e-14
    assert gauge.max() > 0.95


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (([-1.0], [2.0], 1, 1.0), "box"),
        (([-np.inf], [np.inf], 1, 1.0), "box"),
        (([-1.0], [1.0], 3, 1.0), "budget.p"),
        (([-1.0], [1.0], 1, 0.0), "budget.size"),
        (([-1.0], [1.0], 1, float("nan")), "budget.size"),
    ],
)
def test_what_is_no_budget_is_refused_by_its_key(arguments: tuple[object, ...], key: str) -> None:
    with pytest.raises(sr.InputError) as raised:
        sr.BudgetedBox(*arguments)
    assert ".".join(map(str, raised.value.path)) == key
