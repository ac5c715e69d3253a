"""Guards signals with a budget in balls: bounds by weak duality hold, are sharp, and no signal beyond the budget is
admitted."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.known import admit, known, sum_supports
from sparserob_core.control.sets.budget import BudgetedBox, BudgetedSignals

RNG = np.random.default_rng(7)


def draw(p: int) -> BudgetedSignals:
    q = int(RNG.integers(1, 9))
    radii, costs = RNG.uniform(0.1, 2.0, q), RNG.uniform(0.1, 1.0, q)
    return BudgetedSignals(radii, costs, p, float(RNG.uniform(0.05, 1.2) * (costs * radii**p).sum()))


@pytest.mark.parametrize("p", [1, 2])
def test_the_support_is_enclosed_tightly_also_where_many_are_equally_good(p: int) -> None:
    for trial in range(40):
        signals = draw(p)
        c = np.ones(signals.dimension) * signals.costs if trial % 2 else RNG.normal(size=signals.dimension)
        value, ball = signals.support(c), known(signals).support(balls(c))
        assert float(ball.lower()) <= value * (1 + 1e-14)
        assert value * (1 - 1e-14) <= float(ball.upper())
        assert float(ball.rad()) <= 1e-12 * (1.0 + value)


@pytest.mark.parametrize("p", [1, 2])
def test_a_linear_bound_holds_on_all_of_its_range_and_is_sharp_at_a_point(p: int) -> None:
    for trial in range(120):
        signals = draw(p)
        value = RNG.normal(size=(1, signals.dimension))
        spread = RNG.uniform(0.0, 0.3, value.shape) * (trial % 2)
        w, excess = known(signals).bound(value, spread)
        inside = value + spread * RNG.uniform(-1.0, 1.0, (200, signals.dimension))
        corners = value + spread * RNG.choice([-1.0, 1.0], (200, signals.dimension))
        over = (signals.support(np.vstack([inside, corners])) - np.vstack([inside, corners]) @ w[0] - excess).max()
        assert over <= 1e-13
        assert trial % 2 or over >= -1e-11


@pytest.mark.parametrize(("p", "order"), [(1, 1.0), (2, 2.0)])
def test_a_linear_bound_loses_nothing_or_a_square_where_the_best_signal_stays(p: int, order: float) -> None:
    signals = BudgetedSignals(np.ones(4), np.ones(4), p, 1.5)
    value, direction = np.array([[4.0, 3.0, 2.0, 1.0]]), np.array([[1.0, 1.0, 0.5, 0.2]])
    losses = []
    for width in (0.1, 0.01):
        w, excess = known(signals).bound(value, width * direction)
        losses.append(float((value @ w[0] + excess - signals.support(value))[0]))
    assert losses[1] <= 1e-11 or losses[1] <= 1.5 * losses[0] / 10**order


@pytest.mark.parametrize("p", [1, 2])
def test_a_signal_is_admitted_within_its_budget_only(p: int) -> None:
    box, lengths = BudgetedBox([-1.0], [1.0], p, 1.0), np.full(4, 0.5)
    worst = box.of_signals(lengths).support_point(np.array([3.0, 1.0, 2.0, 1.0])).reshape(1, 4)
    assert admit(box, lengths, worst * (1 - 1e-12))
    assert not admit(box, lengths, worst * (1 + 1e-9))
    barely = worst * (1 + 4e-16)
    if not known(box.of_signals(lengths)).holds(balls(barely.ravel())):
        with pytest.raises(Unchecked):
            admit(box, lengths, barely)


def test_sums_over_pieces_are_coupled_channel_by_channel() -> None:
    box, lengths = BudgetedBox([-1.0, -1.0], [1.0, 1.0], 1, 0.5), np.array([0.5, 0.25])
    rows = [balls([1.0, 5.0]), balls([4.0, 2.0])]
    # per unit of the budget: 2, 10 on the first piece, 16, 8 on the second
    assert float(sum_supports(box, lengths, rows).mid()) == pytest.approx(0.25 * 16 + 0.25 * 10)
